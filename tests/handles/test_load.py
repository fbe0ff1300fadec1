"""What a run leaves acts as it did in the run: loaded, one tick at a time, without an environment of ours."""

import json
import shutil
from pathlib import Path

import jax
import numpy as np
import pytest
from probes import assert_trees_equal
from safetensors.numpy import load_file, save_file
from tiny_runs import CONFIG, with_fields

import taic_jax as taic
from taic_jax import summary
from taic_jax.envs.wrappers import AutoReset
from taic_jax.pipeline import Result
from taic_jax.rl.agent import advance
from taic_jax.rl.rollout import rollout, start
from taic_jax.runtime.checkpoint import ArtifactError
from taic_jax.runtime.driver import Run

RULES = ("fixed", "output", "predict")
KINDS = [(rule, "ppo") for rule in RULES] + [("fixed", "sac"), ("output", "dqn")]


@pytest.fixture(scope="module", params=KINDS, ids="-".join)
def run(request, tmp_path_factory) -> tuple[Path, Result]:
    """Return a run under each termination rule, and of each learner, with every kind of method."""
    rule, learner = request.param
    config = with_fields(
        CONFIG, collect__learner=learner, train__learner=learner, options__termination=rule, options__length=4,
        options__delta=0.44, options__delta_unit="error", evaluate__video_ticks=0, train__baselines=("flat", "repeat"),
        train__ppo__hidden_sizes=(3,), train__sac__hidden_sizes=(3,),
    )  # fmt: skip
    if learner == "dqn":
        config = with_fields(config, env__name="four_rooms", options__codes=3, options__sample_actions=True)
    folder = tmp_path_factory.mktemp("run") / "run"
    return folder, taic.run_pipeline(config, folder, quiet=True)


def test_a_run_is_loaded_with_all_its_agents_as_they_were_returned(run):
    folder, result = run
    handle = taic.load(folder)
    assert set(handle.agents) == {"taic", "flat", "repeat", "collect"} and handle.env.name == handle.config.env.name
    assert len(handle.options) == len(handle.agents["flat"]) == 2
    for name, agents in result.agents.items():
        assert_trees_equal(handle.agents[name].rows, agents.rows)
        alone = taic.load(folder / "agents" / name)
        assert_trees_equal(alone.agents[name].rows, agents.rows)
        assert alone.config == handle.config
    assert_trees_equal(handle.options.rows, handle.agents["taic"].rows.executor.model)
    assert len(list(handle.agents["taic"])) == 2
    with pytest.raises(IndexError, match="seed 2: expected one of the 2 seeds"):
        handle.options[2]


def test_an_agent_acts_as_in_a_rollout(run):
    """The rollout's own noise, and its environment, give the same ticks; the ends of options included."""
    handle = taic.load(run[0])
    env, act = AutoReset(handle.env), jax.jit(advance)
    for method in ("taic", "repeat"):
        agent, key = handle.agents[method][1], jax.random.key(3)
        begin = start(env, agent.executor, 1, key)
        _, ticks = rollout(env, agent.executor, agent.decide(), begin, key, 30)
        assert len(set(ticks.duration[:, 0].tolist())) > 1 and not ticks.truncated.any()
        carry = agent.start(ticks.obs[0, 0])
        for t in range(30):
            carry, action, tick = act(agent, carry, ticks.obs[t, 0], ticks.noise[t, 0])
            np.testing.assert_allclose(action, ticks.action[t, 0], rtol=1e-5, atol=1e-6)
            assert (tick.began, tick.duration) == (ticks.decision[t, 0], ticks.duration[t, 0])
            if tick.began:
                option = ticks.option[t, 0]
            np.testing.assert_allclose(tick.option, option, rtol=1e-5, atol=1e-6)


def test_an_agent_may_be_compiled_and_batched_and_called_with_numpy(run):
    agent = taic.load(run[0]).agents["taic"][0]
    obs = np.random.default_rng(0).normal(size=(3, agent.observation_size))  # float64, as Gymnasium's
    plain = [agent.act(agent.start(x), x) for x in obs]
    batch = jax.jit(jax.vmap(agent.act))(jax.vmap(agent.start)(obs.astype(np.float32)), obs.astype(np.float32))
    for i, one in enumerate(plain):
        assert_trees_equal(one, jax.tree.map(lambda x, i=i: x[i], batch), rtol=1e-5, atol=1e-6)
    key = jax.random.key(0)
    carry, action, tick = agent.act(agent.start(obs[0]), obs[0], key)
    assert action.shape == (agent.action_size,) and not np.allclose(tick.option, plain[0][2].option)
    assert_trees_equal(agent.act(agent.start(obs[0]), obs[0], key), (carry, action, tick))


def test_options_alone_are_loaded_with_their_structure(run):
    folder = run[0]
    handle = taic.load(folder / "options")
    assert handle.agents == {} and handle.config.options.length == 4 and handle.env.name == handle.config.env.name
    assert_trees_equal(handle.options.rows, taic.load(folder).options.rows.replace(delta=handle.options.rows.delta))


def test_the_video_is_of_the_first_seed(run, tmp_path, monkeypatch):
    """What is recorded here is a layer of the policy, and what is drawn is nothing."""
    handle, seen = taic.load(run[0]), []
    env, agents = handle.env, handle.agents["taic"].rows
    monkeypatch.setattr(summary, "record", lambda env, agent, key, ticks: agent.params)
    monkeypatch.setattr(type(env), "render", lambda env, drawn: seen.append(drawn) or np.zeros((3, 8, 6, 3), np.uint8))
    with Run.view(CONFIG, tmp_path, CONFIG) as view:
        summary.write_video(view, env, agents)
    assert_trees_equal(seen[0], jax.tree.map(lambda x: x[0], agents.params))
    assert (tmp_path / "video.webp").is_file()


def unfinished(folder: Path) -> str:
    (folder / "summary.json").unlink()
    return "expected a finished run, got one that --resume goes on with"


def of_an_earlier_version(folder: Path) -> str:
    shutil.rmtree(folder / "agents")
    return "agents: expected the agents that a run of this version leaves, got none"


def of_a_later_version(folder: Path) -> str:
    edit(folder / "agents/taic", format=2, taic_jax="9.9")
    return "agents/taic: taic_jax 9.9 wrote format 2, this is taic_jax"


def tampered(folder: Path) -> str:
    path = folder / "agents/taic/arrays.safetensors"
    arrays = load_file(path)
    save_file(arrays | {"params.log_std": arrays["params.log_std"] + 1}, path)
    return "arrays.safetensors: expected an artifact, got files of another kind or damaged ones"


def cut_short(folder: Path) -> str:
    path = folder / "agents/flat/arrays.safetensors"
    path.write_bytes(path.read_bytes()[:-10])
    return "arrays.safetensors: expected an artifact, got files of another kind or damaged ones"


def of_other_sizes(folder: Path) -> str:
    edit(folder / "agents/taic", observation_size=3)
    return "expected float32[2, 3, 3] at params.actor.params.Dense_0.kernel, got float32[2, 2, 3]"


def of_another_config(folder: Path) -> str:
    edit(folder / "agents/taic", config={"optins": {}})
    return "expected the description of agents: unknown field optins; the nearest is options"


def edit(folder: Path, **fields) -> None:
    path = folder / "description.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | fields))


SPOILS = [unfinished, of_an_earlier_version, of_a_later_version, tampered, cut_short, of_other_sizes, of_another_config]


@pytest.mark.parametrize("spoil", SPOILS)
@pytest.mark.parametrize("run", KINDS[:1], indirect=True)
def test_what_cannot_be_loaded_is_refused_in_one_line(run, tmp_path, spoil):
    folder = tmp_path / "run"
    shutil.copytree(run[0], folder)
    expected = spoil(folder)
    with pytest.raises(ArtifactError) as error:
        taic.load(folder)
    assert expected in str(error.value) and "\n" not in str(error.value) and str(error.value).startswith(str(folder))
