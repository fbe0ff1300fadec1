"""Trees on disk: what is loaded is what was saved, and anything else is refused in one line."""

import os
import shutil
import subprocess
import sys
import time
import zlib
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import struct
from orbax.checkpoint import v1 as ocp

from taic_jax.runtime import checkpoint
from taic_jax.runtime.checkpoint import ArtifactError, Checkpoints, load_tree, save_tree
from taic_jax.runtime.files import PARTIAL, TEMPORARY, SaveError, remove_partial, save_text


class State(struct.PyTreeNode):
    params: dict[str, jax.Array]
    optimizer: Any
    key: jax.Array
    steps: jax.Array
    nothing: None = None


def make_state(seed: int = 0) -> State:
    params = {
        "w": jax.random.normal(jax.random.key(seed), (3, 4)),
        "half": jnp.arange(3, dtype=jnp.bfloat16),
        "on": jnp.array([True, False]),
        "empty": jnp.zeros((0, 2)),
    }
    adam = optax.adam(1e-3).init({"w": params["w"]})
    keys = jax.random.split(jax.random.key(seed, impl="rbg"), 2)
    return State(params=params, optimizer=adam, key=keys, steps=jnp.int32(seed))


def assert_same(a: State, b: State) -> None:
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert x.aval == y.aval
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            x, y = jax.random.key_data(x), jax.random.key_data(y)
        np.testing.assert_array_equal(x, y)


def test_round_trip_keeps_every_leaf_and_type(tmp_path):
    save_tree(tmp_path / "state", make_state(7))
    assert_same(load_tree(tmp_path / "state", make_state(0)), make_state(7))


def test_abstract_trees_and_bare_arrays_load(tmp_path):
    save_tree(tmp_path / "state", make_state(7))
    assert_same(load_tree(tmp_path / "state", jax.eval_shape(make_state)), make_state(7))
    save_tree(tmp_path / "array", jnp.arange(3))
    np.testing.assert_array_equal(load_tree(tmp_path / "array", jnp.zeros(3, jnp.int32)), np.arange(3))


def test_saving_again_replaces(tmp_path):
    save_tree(tmp_path / "state", make_state(1))
    save_tree(tmp_path / "state", make_state(2))
    assert_same(load_tree(tmp_path / "state", make_state()), make_state(2))


def test_loading_does_not_compile_the_next_step_again(tmp_path):
    save_tree(tmp_path / "state", make_state(1))
    traces = []
    step = jax.jit(lambda state: traces.append(1) or state.replace(steps=state.steps + 1))
    step(make_state(0))
    step(load_tree(tmp_path / "state", make_state(0)))
    assert len(traces) == 1


OTHERS = {
    "dtype": (lambda s: s.replace(steps=jnp.float32(0)), "expected float32[] at steps, got int32[]"),
    "shape": (
        lambda s: s.replace(params={**s.params, "w": jnp.ones((3, 5))}),
        "expected float32[3, 5] at params.w",
    ),
    "missing leaf": (lambda s: s.replace(params={**s.params, "b": jnp.ones(2)}), "at params.b, got nothing"),
    "extra leaf": (lambda s: s.replace(optimizer=None), "expected nothing at optimizer."),
    "kind of key": (lambda s: s.replace(key=jax.random.split(jax.random.key(0))), "at key, got uint32[2, 4]"),
}


@pytest.mark.parametrize("case", OTHERS)
def test_another_tree_is_refused(tmp_path, case):
    change, expected = OTHERS[case]
    save_tree(tmp_path / "state", make_state())
    with pytest.raises(ArtifactError) as error:
        load_tree(tmp_path / "state", change(make_state()))
    assert expected in str(error.value) and "\n" not in str(error.value)


def truncate(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize("damage", [truncate, flip])
def test_missing_foreign_and_damaged_artifacts_are_refused(tmp_path, caplog, damage):
    tree = {"x": jax.random.normal(jax.random.key(0), 1000)}
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("not a tree")
    np.savez(tmp_path / "pickled", x=np.array([print], object))
    for name in ("whole", "without_arrays", "damaged", "other_manifest"):
        save_tree(tmp_path / name, tree)
    shutil.rmtree(tmp_path / "without_arrays/state")
    damage(max((tmp_path / "damaged/state").rglob("?" * 32), key=lambda path: path.stat().st_size))
    damage(tmp_path / "other_manifest/state/manifest.ocdbt")
    assert_same(load_tree(tmp_path / "whole", tree), tree)
    for name in ("missing", "empty", "file", "pickled.npz", "without_arrays", "damaged", "other_manifest"):
        with pytest.raises(ArtifactError, match=f"{name}: expected an artifact") as error:
            load_tree(tmp_path / name, tree)
        assert "\n" not in str(error.value)
    assert not caplog.records


def test_checkpoints_keep_the_latest(tmp_path):
    checkpoints = Checkpoints(tmp_path / "checkpoints", keep=2)
    assert checkpoints.latest_step() is None
    for step in (5, 20, 100):
        checkpoints.save(step, make_state(step))
    checkpoints.wait()
    assert checkpoints.steps() == [20, 100]
    (tmp_path / "checkpoints/7").mkdir()
    assert Checkpoints(tmp_path / "checkpoints").steps() == [20, 100]
    assert_same(checkpoints.load(100, make_state()), make_state(100))
    with pytest.raises(ArtifactError):
        checkpoints.load(5, make_state())


SAVE_FOR_EVER = """
import sys, pathlib, itertools, jax.numpy as jnp
from taic_jax.runtime.checkpoint import Checkpoints
checkpoints = Checkpoints(pathlib.Path(sys.argv[1]))
for step in itertools.count():
    checkpoints.save(step, {"x": jnp.full(500_000, float(step)), "y": jnp.full(500_000, float(step))})
"""


def test_a_killed_save_leaves_the_one_before(tmp_path):
    process = subprocess.Popen([sys.executable, "-c", SAVE_FOR_EVER, str(tmp_path)])
    deadline = time.monotonic() + 60
    while not (tmp_path / "2").exists() and time.monotonic() < deadline:
        time.sleep(0.005)
    while not any(tmp_path.glob(f"*{TEMPORARY}")) and time.monotonic() < deadline:
        pass
    process.kill()
    process.wait()
    (tmp_path / f"options{TEMPORARY}/state").mkdir(parents=True)
    (tmp_path / f"9{PARTIAL}").touch()
    checkpoints = Checkpoints(tmp_path)
    step = checkpoints.latest_step()
    assert step is not None
    loaded = checkpoints.load(step, {"x": jnp.zeros(500_000), "y": jnp.zeros(500_000)})
    assert all((leaf == step).all() for leaf in loaded.values())
    remove_partial(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {str(step) for step in checkpoints.steps()}


def test_a_damaged_checkpoint_tells_what_is_left_without_it(tmp_path):
    checkpoints = Checkpoints(tmp_path)
    for step in (1, 2):
        checkpoints.save(step, make_state(step))
    checkpoints.wait()
    for path in tmp_path.rglob("_CHECKPOINT_METADATA"):
        truncate(path)
    with pytest.raises(ArtifactError, match=r"2: .*; without .*/2 --resume goes on from .*/1$"):
        checkpoints.load(2, make_state())
    with pytest.raises(ArtifactError, match=r"1: .* goes on from the start of the stage$"):
        checkpoints.load(1, make_state())


def test_checkpoints_of_another_version_are_told(tmp_path, monkeypatch):
    checkpoints = Checkpoints(tmp_path)
    monkeypatch.setattr(checkpoint, "_version", lambda: "0.0.9")
    checkpoints.save(1, {"x": jnp.ones(3)})
    checkpoints.wait()
    monkeypatch.setattr(checkpoint, "_version", lambda: "9.8.7")
    checkpoints.load(1, {"x": jnp.ones(3)})
    with pytest.raises(ArtifactError, match=r"at y, got nothing; taic_jax 0.0.9 wrote it, this is 9.8.7"):
        checkpoints.load(1, {"x": jnp.ones(3), "y": jnp.ones(3)})


def test_the_layout_of_a_checkpoint_is_as_it_always_was(tmp_path):
    """Checkpoints of earlier versions are resumed from."""
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, {"x": jnp.array([1.0, 2.0]), "a": {"key": jax.random.key(3, impl="threefry2x32")}})
    checkpoints.wait()
    stored = ocp.metadata(str(tmp_path / "1")).custom_metadata
    assert stored["layout"] == [["a.key", "uint32", [2]], ["x", "float32", [2]]]
    packed = np.concatenate([np.uint32([0, 3]).view(np.uint8), np.float32([1, 2]).view(np.uint8)])
    assert stored["crc32"] == {"bytes": zlib.crc32(packed.data)} and set(stored) == {"taic_jax", "crc32", "layout"}
    loaded = ocp.load(str(tmp_path / "1"))
    np.testing.assert_array_equal(loaded["bytes"], packed)


def test_checkpoints_of_one_array_for_each_leaf_are_read(tmp_path):
    tree = {"x": jnp.ones(3), "a": {"b": jnp.int32([[1], [2]])}}
    ocp.save(str(tmp_path / "1"), {"x": np.asarray(tree["x"]), "a.b": np.asarray(tree["a"]["b"])})
    assert_same(Checkpoints(tmp_path).load(1, tree), tree)


def test_what_is_saved_is_what_was_there_when_saving_began(tmp_path):
    """The loop donates its buffers to the next step while they are being written."""
    checkpoints = Checkpoints(tmp_path)
    step = jax.jit(lambda tree: jax.tree.map(lambda x: x + 1, tree), donate_argnums=0)
    tree = {"x": jnp.zeros(1_000_000), "y": jnp.zeros((), jnp.int32)}
    for index in range(3):
        checkpoints.save(index, tree)
        for _ in range(5):
            tree = step(tree)
        checkpoints.wait()
        found = checkpoints.load(index, tree)
        assert (found["x"] == 5 * index).all() and found["y"] == 5 * index


def test_what_cannot_be_written_leaves_what_was_there(tmp_path, limit, capfd):
    checkpoints = Checkpoints(tmp_path / "checkpoints")
    checkpoints.save(1, make_state(1))
    checkpoints.wait()
    save_text(tmp_path / "text", "short")
    save_tree(tmp_path / "artifact", make_state(1))
    state = make_state(2)
    limit(200)
    with pytest.raises(SaveError, match=r"checkpoints/2: cannot be written: File too large") as error:
        checkpoints.save(2, state)
    assert "\n" not in str(error.value)
    with pytest.raises(SaveError, match="/artifact: cannot be written: File too large"):
        save_tree(tmp_path / "artifact", state)
    with pytest.raises(SaveError, match="text: cannot be written"):
        save_text(tmp_path / "text", "long" * 100)
    limit(None)
    assert checkpoints.steps() == [1] and (tmp_path / "text").read_text() == "short"
    assert_same(checkpoints.load(1, make_state()), make_state(1))
    assert_same(load_tree(tmp_path / "artifact", make_state()), make_state(1))
    (tmp_path / "file").touch()
    with pytest.raises(SaveError, match=r"1: cannot be written: (File exists|Not a directory)"):
        Checkpoints(tmp_path / "file").save(1, make_state(1))
    assert not list(tmp_path.rglob(f"*{PARTIAL}")) and not list(tmp_path.rglob(f"*{TEMPORARY}"))
    assert capfd.readouterr() == ("", "")


def test_a_disk_that_fills_while_orbax_writes_is_told_when_it_is_waited_for(tmp_path, limit, caplog, monkeypatch):
    monkeypatch.setattr(checkpoint, "make_room", lambda path, size: None)
    checkpoints, tree = Checkpoints(tmp_path), {"x": np.arange(100_000.0)}
    limit(200)
    with pytest.raises(SaveError, match=r"/2: cannot be written: File too large$"), checkpoints.waited_for():
        checkpoints.save(2, tree)
    with pytest.raises(SaveError, match="the first"), checkpoints.waited_for():
        checkpoints.save(2, tree)
        raise SaveError("the first")
    limit(None)
    assert not list(tmp_path.iterdir())
    checkpoints.save(2, tree)
    checkpoints.wait()
    assert checkpoints.steps() == [2]
    assert not caplog.records


LOG_FROM = """
import taic_jax.runtime.checkpoint
import absl.logging
place = "orbax/x.py"
exec(compile("absl.logging.error(place)", place, "exec"))
import logging
logging.getLogger("other").error("heard")
"""


def test_orbax_does_not_log_to_the_terminal():
    """Though absl's logger is made before absl knows who calls."""
    run = subprocess.run([sys.executable, "-c", LOG_FROM], capture_output=True, text=True, check=True)
    assert "orbax/x.py" not in run.stderr and "heard" in run.stderr
