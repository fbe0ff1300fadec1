"""Two devices do what one does: over seeds, environments, with MuJoCo's callback, resumed on another number."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_runs import CONFIG, SLOPE, KilledError, die, last_state, rows_of, tiny_steps, with_fields

from taic_jax.config.files import to_yaml
from taic_jax.envs import PhysicsState, make_env
from taic_jax.envs.physics.mujoco import num_physical_cores
from taic_jax.run import main
from taic_jax.runtime.checkpoint import Checkpoints
from taic_jax.runtime.devices import Devices, fewest, over_envs

STAGES = ("collect", "learn", "train")


@pytest.fixture(scope="module", autouse=True)
def tiny():
    with tiny_steps():
        yield


@pytest.fixture(scope="module")
def one(tmp_path_factory):
    """Run three seeds on one device."""
    with pytest.MonkeyPatch.context() as patch:
        return run_in(tmp_path_factory.mktemp("one"), patch, "--seeds", "3", "--shard", "none")


def run_in(folder: Path, patch: pytest.MonkeyPatch, *args: str) -> Path:
    patch.chdir(folder)
    Path("slope.py").write_text(SLOPE)
    Path("config.yaml").write_text(to_yaml(with_fields(CONFIG, env__name="slope.py:Slope", evaluate__video_ticks=0)))
    assert main(["config.yaml", "--run-dir", "run", "--checkpoint-seconds", "0", *args]) == 0
    return folder / "run"


def assert_same_run(a: Path, b: Path, stages: tuple[str, ...]) -> None:
    """Compare the last states of stages, and of which numbers there are logs."""
    for stage in stages:
        left, right = last_state(a, stage), last_state(b, stage)
        assert left.keys() == right.keys()
        for name in left:
            np.testing.assert_allclose(left[name], right[name], rtol=1e-4, atol=1e-6, err_msg=f"{stage} {name}")
    rows = [[row for row in rows_of(run) if row["stage"] in stages] for run in (a, b)]
    for left, right in zip(*rows, strict=True):
        assert {name: np.shape(value) for name, value in left.items()} == {
            name: np.shape(value) for name, value in right.items()
        }


def test_there_are_two_devices():
    assert jax.device_count() == 2


def test_seeds_over_two_devices_do_as_on_one_and_go_on_there(one, tmp_path, monkeypatch):
    with monkeypatch.context() as patch, pytest.raises(KilledError):  # in stage train
        die(patch, Checkpoints, "save", 3 + 2 + 2)
        run_in(tmp_path, monkeypatch, "--seeds", "3", "--shard", "seeds")  # so that one row is padding
    assert main(["--resume", "--run-dir", "run", "--checkpoint-seconds", "0", "--shard", "none"]) == 0
    assert_same_run(one, tmp_path / "run", ("collect", "learn", "train"))
    for path in (one / "experience").glob("*.npz"):
        assert np.load(path)["obs"].shape == np.load(tmp_path / "run/experience" / path.name)["obs"].shape


def test_environments_over_two_devices_do_as_on_one_and_go_on_there(one, tmp_path, monkeypatch):
    args = ["--seeds", "3", "--options", str(one), "--train.baselines", "--shard"]
    with monkeypatch.context() as patch, pytest.raises(KilledError):
        die(patch, Checkpoints, "save", 2)
        run_in(tmp_path, monkeypatch, *args, "envs")
    assert main(["--resume", "--run-dir", "run", "--checkpoint-seconds", "0", "--shard", "none"]) == 0
    assert_same_run(one, tmp_path / "run", ("train",))


def test_environments_that_do_not_divide_are_refused_in_one_line(capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["--run-dir", "run", "--train.ppo.num-envs", "5", "--shard", "envs"]) == 2
    err = capfd.readouterr().err
    assert err.count("\n") == 1 and "expected train.ppo.num_envs to be a multiple of the 2 devices, got 5" in err
    assert "nearest valid value is 4" in err and not Path("run").exists()


@pytest.mark.parametrize("shard", ["seeds", "envs"])
def test_each_device_calls_the_engine_with_its_part(shard, monkeypatch):
    physics = make_env("half_cheetah", "mujoco").env.physics
    sizes, step = [], physics.engine.step
    monkeypatch.setattr(
        physics.engine.call, "_function", lambda sent, after: (sizes.append(sent.size), step(sent, after))
    )
    rng, nq, nv = np.random.default_rng(0), physics.model.nq, physics.model.nv
    state = PhysicsState(*(jnp.asarray(rng.normal(0.0, 0.1, (2, 4, n)), jnp.float32) for n in (nq, nv, nv)))
    controls = jnp.asarray(rng.normal(0.0, 0.5, (2, 3, 4, physics.model.nu)), jnp.float32)

    def scan(state, controls):
        return jax.lax.scan(lambda s, c: (after := jax.vmap(physics.step)(s, c), after.qpos), state, controls)

    results = []
    for devices in (Devices(), Devices(shard)):
        args = devices.place((state, controls))
        split = jax.vmap(lambda state, controls: over_envs(scan, 4)(state, controls))
        results.append(devices.take(devices.compile(split, *args)(*args), 2))
    jax.tree.map(np.testing.assert_array_equal, *results)
    whole, parts = sizes[:3], sizes[3:]
    assert len(parts) == 6 and sum(parts) == sum(whole) and set(parts) == {whole[0] // 2}


@pytest.mark.parametrize("shard", ["seeds", "envs"])
@pytest.mark.parametrize("count", [3, 4])
def test_what_is_taken_is_on_one_device_so_that_nothing_is_exchanged_later(shard, count):
    devices = Devices(shard)
    rows = jnp.arange(8.0).reshape(4, 2)[:count], jax.random.split(jax.random.key(0), count)
    taken = devices.take(devices.place(rows), count)
    for row, back in zip(rows, taken, strict=True):
        assert back.devices() == {jax.local_devices()[0]}
        assert (back == row).all()


@pytest.mark.parametrize(
    ("rows", "cores", "devices"), [(10, 8, 5), (10, 16, 10), (10, 2, 2), (3, 2, 2), (9, 4, 3), (1, 8, 1), (8, 8, 8)]
)
def test_no_more_cores_are_taken_than_shorten_the_longest_queue_of_rows(rows, cores, devices):
    assert fewest(rows, cores) == devices


def test_cores_of_a_cpu_become_devices_no_more_than_rows():
    program = "import sys; from taic_jax.runtime.devices import open_devices; import jax; "
    program += "print(*[open_devices(sys.argv[1], int(sys.argv[2])), jax.device_count()])"
    env = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    told = {}
    for shard, rows in (("auto", 1), ("auto", 2), ("none", 9), ("seeds", 1)):
        line = [sys.executable, "-W", "ignore", "-c", program, shard, str(rows)]
        told[shard, rows] = subprocess.run(line, env=env, check=True, capture_output=True, text=True).stdout.split()
    two = min(2, num_physical_cores())
    assert told["auto", 1] == ["none", "1"] and told["none", 9] == ["none", "1"] and told["seeds", 1] == ["seeds", "1"]
    assert told["auto", 2] == ["seeds" if two == 2 else "none", str(two)]
