"""The benchmark: that its parts do the work they promise, side by side. Not what they measure."""

import json
import sys
from functools import partial

import gymnasium
import jax
import pytest
from tiny_runs import CONFIG, with_fields

from taic_jax import envs
from taic_jax.config import PPOConfig
from taic_jax.config.files import to_yaml
from taic_jax.experiments.benchmark import peers, processes, throughput
from taic_jax.experiments.benchmark.loops import WORK, Training, options_config
from taic_jax.experiments.benchmark.peers import brax_ppo
from taic_jax.experiments.benchmark.processes import Sweep, starts, sweep_costs
from taic_jax.experiments.benchmark.scaling import SAVED, SMALLEST, Widened, saving_loop, scaling, shares
from taic_jax.experiments.benchmark.throughput import share_text
from taic_jax.experiments.benchmark.timing import Loop, Speeds, interleave
from taic_jax.options.execution import IdentityExecutor
from taic_jax.runtime.checkpoint import Checkpoints

TINY = PPOConfig(num_envs=2, rollout_length=16, epochs=2, minibatch_size=16, hidden_sizes=(4,))
TICKS, STEPS = 32, 4
SMALL = [
    "--training.num-envs", "2", "--training.rollout-length", "16", "--training.epochs", "2",
    "--training.minibatch-size", "16", "--training.hidden-sizes", "4", "--num-envs", "4", "--rollout-length", "16",
    "--rounds", "1", "--steps", "2", "--rules", "fixed", "predict", "--decoders", "open",
]  # fmt: skip


def test_the_work_is_the_one_promised():
    ticks = WORK.num_envs * WORK.rollout_length
    assert (ticks, WORK.epochs, ticks / WORK.minibatch_size, WORK.hidden_sizes) == (64 * 256, 10, 32, (64, 64))


def test_loops_take_turns():
    calls: list[str] = []
    speeds = interleave({name: Loop(lambda name=name: calls.append(name), 10) for name in "ab"}, 3)
    assert "".join(calls) == "ab" * 4
    assert len(speeds["a"].rounds) == 3


def test_a_ratio_is_the_median_of_the_rounds():
    assert Speeds([1.0, 8.0, 9.0], 0.0).ratio(Speeds([1.0, 2.0, 3.0], 0.0)) == 3.0
    assert Speeds([1.0, 8.0, 9.0], 0.0).ratio(Speeds([2.0], None)) == 4.0


@pytest.mark.parametrize("seeds", [1, 2])
def test_training_makes_the_ticks_and_gradient_steps(seeds):
    training = Training(envs.make_env("nav2d"), IdentityExecutor(2), TINY, seeds)
    training()
    training()
    counts = [leaf for leaf in jax.tree.leaves(training.state.optimizer) if leaf.dtype == jax.numpy.int32]
    assert (training.ticks, int(counts[0].reshape(-1)[0])) == (seeds * TICKS, 2 * STEPS)


def test_seeds_apart_make_the_ticks_and_tell_how_long_options_last():
    apart = processes.SeedsApart(partial(envs.make_env, "nav2d"), TINY, 3, options_config("fixed", "open", 2))
    apart()
    apart()
    assert apart.ticks == 3 * TICKS and 4.0 < apart.duration < 6.0  # a rollout ends in the middle of an option


def test_seeds_apart_that_fail_are_told():
    with pytest.raises(RuntimeError, match="has failed"):
        processes.SeedsApart(partial(envs.make_env, "nowhere"), TINY, 2)()


@pytest.mark.parametrize("task", sorted(peers.GYMNASIUM))
def test_gymnasium_environments_look_like_ours(task):
    env, (name, options) = envs.make_env(task, model="gym"), peers.GYMNASIUM[task]
    assert gymnasium.make(name, **options).observation_space.shape == (env.observation_size,)


def test_stable_baselines_does_the_same_work():
    pytest.importorskip("stable_baselines3")
    from taic_jax.experiments.benchmark.peers.stable_baselines import StableBaselines

    peer = StableBaselines("HalfCheetah-v5", {}, TINY, 1)
    peer()
    peer()
    assert (peer.ticks, peer.model.num_timesteps) == (TICKS, 2 * TICKS)
    assert gradient_steps(peer.model.policy.optimizer) == 2 * STEPS
    peer.close()


def gradient_steps(optimizer) -> int:
    """Return the steps that an optimizer of PyTorch has taken."""
    return max(int(state["step"]) for state in optimizer.state.values())


@pytest.mark.parametrize("task", sorted(peers.ENVPOOL))
def test_envpool_does_the_same_work(task):
    pytest.importorskip("envpool")
    from taic_jax.experiments.benchmark.peers.pytorch_ppo import EnvPoolPPO

    peer = EnvPoolPPO(peers.ENVPOOL[task], TINY, 1, 1)
    assert peer.obs.shape == (2, envs.make_env(task, model="gym").observation_size)
    peer()
    peer()
    assert (peer.ticks, gradient_steps(peer.optimizer)) == (TICKS, 2 * STEPS)
    assert {len(column) for column in peer._rollout()} == {TICKS}
    peer.close()


def test_the_fastest_setting_is_kept_and_the_others_closed(monkeypatch):
    class Fake:
        closed = False

        def __init__(self, taken: int):
            self.taken = taken
            made.append(self)

        def __call__(self) -> None: ...

        def close(self) -> None:
            self.closed = True

    made: list[Fake] = []
    monkeypatch.setattr(peers, "seconds", lambda peer: peer.taken)
    best, setting = peers.fastest(Fake, (2, 1, 3))
    assert (best, setting) == (made[1], "1 threads")
    assert [peer.closed for peer in made] == [True, False, True]


def test_several_seeds_of_an_accelerator_are_trained_in_one_process(monkeypatch):
    arguments = throughput.Arguments("nav2d", training=TINY, seeds=3)
    env = throughput.make_env(arguments)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    training = throughput.several_seeds(arguments, env, IdentityExecutor(2), None)
    assert isinstance(training, Training)
    assert training.ticks == 3 * TICKS


def test_the_backend_is_the_one_asked_for():
    for backend, has_engine in (("mujoco", True), ("mjx", False)):
        env = throughput.make_env(throughput.Arguments("hopper", backend=backend))
        assert hasattr(env.physics, "engine") == has_engine


def test_brax_that_fails_is_told_in_one_line(monkeypatch):
    def fail(*_, **__):
        raise AttributeError("no such function\nand more")

    monkeypatch.setattr("brax.training.agents.ppo.train.train", fail)
    told = f"does not run on jax {jax.__version__}: AttributeError: no such function"
    assert peers.brax_rounds("half_cheetah", TINY, ["spring"]) == ({}, {"brax": told})


def test_brax_is_asked_for_the_same_work(monkeypatch):
    asked: dict = {}
    before = vars(jax).get("device_put_replicated")

    def train(env, **settings):
        asked.update(settings)
        asked["replicated"] = jax.device_put_replicated({"x": jax.numpy.arange(2)}, jax.local_devices()[:1])
        for _ in range(settings["num_evals"] - 1):
            settings["progress_fn"](0, {})

    monkeypatch.setattr("brax.training.agents.ppo.train.train", train)
    assert len(brax_ppo.ticks_per_second("halfcheetah", "spring", WORK)) == brax_ppo.ITERATIONS
    assert asked["replicated"]["x"].tolist() == [[0, 1]]
    assert vars(jax).get("device_put_replicated") is before
    # What Brax makes of an iteration: the ticks of batches of environments, and a step on each, in epochs.
    batches = asked["batch_size"] * asked["num_minibatches"]
    assert batches == asked["num_envs"] == 64
    assert (batches * asked["unroll_length"], asked["num_minibatches"]) == (64 * 256, 32)
    assert asked["num_updates_per_batch"] == 10


def test_table_and_json_hold_what_is_promised(tmp_path, capsys):
    out = tmp_path / "throughput.json"
    assert throughput.main(["--task", "half_cheetah", *SMALL, "--seeds", "2", "--json", str(out)]) == 0
    told = json.loads(out.read_text())
    assert all(told[name] > 0 for name in ("engine", "rollout", "flat_training", "option_training"))
    assert sorted(told["rows"]) == [
        "engine", "flat_training", "flat_training/2 seeds", "option_training", "option_training/2 seeds",
        "option_training/predict/open", "rollout",
    ]  # fmt: skip
    assert told["rows"]["option_training"]["remark"].startswith("5.")
    assert list(told["shares"]) == ["physics", "transfer", "policy", "update"]
    assert sum(told["shares"].values()) == pytest.approx(1.0)
    assert "option_training/2 seeds" in capsys.readouterr().out


def test_a_share_that_noise_made_negative_is_no_share():
    assert share_text("update", 0.324) == "update 32%"
    assert share_text("policy", -0.04) == "policy too little to be told from noise"


def test_peers_that_are_missing_are_told(monkeypatch):
    for package, module in (("stable_baselines3", "stable_baselines"), ("envpool", "pytorch_ppo")):
        monkeypatch.setitem(sys.modules, package, None)
        monkeypatch.delitem(sys.modules, f"taic_jax.experiments.benchmark.peers.{module}", raising=False)
    arguments = throughput.Arguments(training=TINY)
    loops, remarks = peers.loops(arguments.task, arguments.training)
    assert not loops
    assert all("pip install 'taic-jax[peers]'" in remark for remark in remarks.values())


def test_training_is_saved_after_each_iteration(tmp_path):
    training = Training(envs.make_env("nav2d"), IdentityExecutor(2), TINY)
    saved = saving_loop(training, Checkpoints(tmp_path))
    saved()
    checkpoints = Checkpoints(tmp_path)
    assert checkpoints.latest_step() == SAVED and saved.ticks == SAVED * TICKS
    assert int(checkpoints.load(SAVED, training.state).iteration) == SAVED


def test_a_task_without_an_engine_has_no_such_row():
    assert list(shares(envs.make_env("nav2d"), TINY, 1)) == ["physics", "policy", "update"]


def test_widened_observations_start_as_they_were():
    env = envs.make_env("nav2d")
    state, wide = env.reset(jax.random.key(0)), Widened(env, 8).reset(jax.random.key(0))
    assert wide.obs.shape == (8,) and (wide.obs[:2] == state.obs).all()


def test_scaling_goes_over_a_factor_of_16_each(monkeypatch):
    class Fake:
        def __init__(self, *arguments):
            self.ticks = arguments[-1]

        def __call__(self) -> None: ...

    monkeypatch.setattr("taic_jax.experiments.benchmark.scaling._at", Fake)
    rows = list(scaling(envs.make_env("nav2d"), TINY, 1, 1))
    for axis in SMALLEST:
        first, _, last = (row for row in rows if row["axis"] == axis)
        assert last["value"] == 16 * first["value"] and first["of_linear"] == 1.0


def test_a_sweep_is_counted_up_from_what_was_measured(monkeypatch):
    asked: list[int] = []
    monkeypatch.setattr(processes, "_processes", lambda sweep, count: asked.append(count))
    monkeypatch.setattr(processes, "num_physical_cores", lambda: 2)
    monkeypatch.setattr(processes, "seconds", lambda run: (run(), 1.0)[1])
    told = sweep_costs(Sweep("nav2d", 4, 2, TICKS, TINY), 4)
    assert asked == [1, 2, 2]
    assert (told["loop"], told["processes"]) == (2.0, 2.0) and told["one_program"] > 0


def test_a_resumed_start_goes_on_with_the_run(tmp_path):
    path = tmp_path / "long.yaml"
    path.write_text(to_yaml(with_fields(CONFIG, collect__ticks=10_000_000)))
    told = starts(str(path))
    assert list(told) == ["cold", "warm", "resumed"] and all(seconds > 0 for seconds in told.values())


def test_a_start_that_fails_is_told():
    with pytest.raises(RuntimeError, match="logged nothing: exit code 2"):
        starts("no_such_preset")


def test_points_of_a_sweep_differ():
    rates = [config.learning_rate for config in Sweep("nav2d", 64, 4, 1, TINY).configs()]
    assert len(set(rates)) == 64 and rates[0] == pytest.approx(1e-4) and rates[-1] < 1e-2


BAD = {
    "--rounds 0": "--rounds: expected at least 1, got 0",
    "--training.minibatch-size 500": "expected a divisor of the 16384 ticks",
    "--json nowhere/x.json": "no folder nowhere",
    "--task half_cheeta": "did you mean 'half_cheetah'",
    "--task ant_turn --starts": "expected a task with a preset",
}


@pytest.mark.parametrize("text", BAD)
def test_mistakes_are_told_in_one_line(text, capsys):
    assert throughput.main(text.split()) == 2
    told = capsys.readouterr().err
    assert BAD[text] in told and told.count("\n") == 1
