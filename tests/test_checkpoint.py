"""Trees on disk: what is loaded is what was saved, and anything else is refused in one line."""

import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import struct

from taic_jax.checkpoint import TEMPORARY, ArtifactError, Checkpoints, load_tree, save_tree


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


def test_missing_foreign_and_damaged_artifacts_are_refused(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("not a tree")
    save_tree(tmp_path / "damaged", make_state())
    shutil.rmtree(tmp_path / "damaged" / "state")
    for name in ("missing", "empty", "file", "damaged"):
        with pytest.raises(ArtifactError, match="expected an artifact") as error:
            load_tree(tmp_path / name, make_state())
        assert "\n" not in str(error.value)


def test_checkpoints_keep_the_latest(tmp_path):
    checkpoints = Checkpoints(tmp_path / "checkpoints", keep=2)
    assert checkpoints.latest_step() is None
    for step in (5, 100, 20):
        checkpoints.save(step, make_state(step))
    assert checkpoints.steps() == [20, 100]
    assert Checkpoints(tmp_path / "checkpoints").latest_step() == 100
    assert_same(checkpoints.load(100, make_state()), make_state(100))
    with pytest.raises(ArtifactError):
        checkpoints.load(5, make_state())


SAVE_FOR_EVER = """
import sys, pathlib, itertools, jax.numpy as jnp
from taic_jax.checkpoint import Checkpoints
checkpoints = Checkpoints(pathlib.Path(sys.argv[1]))
for step in itertools.count():
    checkpoints.save(step, {"x": jnp.full(500_000, float(step)), "y": jnp.full(500_000, float(step))})
"""


def test_a_killed_save_leaves_the_one_before(tmp_path):
    process = subprocess.Popen([sys.executable, "-c", SAVE_FOR_EVER, str(tmp_path)])
    deadline = time.monotonic() + 60
    while not (tmp_path / "2").exists() and time.monotonic() < deadline:
        time.sleep(0.005)
    while not any(tmp_path.glob(f"*{TEMPORARY}*")) and time.monotonic() < deadline:
        pass
    process.kill()
    process.wait()
    (tmp_path / f"9{TEMPORARY}").mkdir(exist_ok=True)
    checkpoints = Checkpoints(tmp_path)
    assert not any(Path(tmp_path).glob(f"*{TEMPORARY}*"))
    step = checkpoints.latest_step()
    assert step is not None
    loaded = checkpoints.load(step, {"x": jnp.zeros(500_000), "y": jnp.zeros(500_000)})
    assert all((leaf == step).all() for leaf in loaded.values())
