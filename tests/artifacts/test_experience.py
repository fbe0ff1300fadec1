"""Experience on disk: bounded, whole, in order, and refused in one line if it is something else."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import Counting, assert_trees_equal

from taic_jax.artifacts.experience import ExperienceStore, collect, gather_experience, num_blocks, read_experience
from taic_jax.artifacts.models import describe
from taic_jax.config import CollectConfig, PPOConfig, experience_ticks
from taic_jax.envs import make_env
from taic_jax.options.dataset import Experience
from taic_jax.runtime.checkpoint import ArtifactError

K, T, B = 2, 4, 3


def block(iteration: int) -> Experience:
    """Return a block whose entries tell iteration, seed, tick, environment and feature."""
    index = np.arange(K * T * B * 2, dtype=np.float32).reshape(K, T, B, 2) + 1000 * iteration
    done = np.zeros((K, T, B), bool)
    done[:, iteration % T] = True
    return Experience(index, -index[..., :1], index[..., 0] / 2, done)


def blocks_in(folder) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if path.name != "description.json")


def test_keeps_the_newest_blocks_whole_and_in_order(tmp_path):
    store = ExperienceStore(tmp_path / "experience", 2, {"env": "nav2d"})
    for iteration in range(5):
        store.write(iteration, block(iteration))
        assert len(blocks_in(store.folder)) == min(iteration + 1, 2)
    assert blocks_in(store.folder) == ["000003.npz", "000004.npz"]
    for seed in range(K):
        expected = [jax.tree.map(lambda x, seed=seed: x[seed], block(i)) for i in (3, 4)]
        whole = jax.tree.map(lambda *x: np.concatenate(x), *expected)
        assert_trees_equal(read_experience(store.folder, seed), whole)


def test_writing_a_block_again_replaces_it(tmp_path):
    store = ExperienceStore(tmp_path, 3, {})
    for iteration in (0, 1, 0, 1):
        store.write(iteration, block(iteration))
    assert read_experience(tmp_path, 0).reward.shape == (2 * T, B)


def test_a_write_that_fails_leaves_what_was_there(tmp_path, monkeypatch):
    store = ExperienceStore(tmp_path, 1, {})
    store.write(0, block(0))

    def half(file, **arrays):
        file.write(b"PK half a block")
        raise OSError("disk full")

    monkeypatch.setattr(np, "savez", half)
    for iteration in (0, 1):
        with pytest.raises(OSError, match="disk full"):
            store.write(iteration, block(5))
    assert_trees_equal(read_experience(tmp_path, 1), jax.tree.map(lambda x: x[1], block(0)))


def test_gathers_what_a_run_collected_for_its_own_body(tmp_path):
    env = Counting(100)
    ExperienceStore(tmp_path / "experience", 1, describe(env) | {"seeds": 2}).write(0, block(0))
    for source in (tmp_path, tmp_path / "experience"):
        gathered = gather_experience(source, env, 3)
        # Seed 2 takes the run's seed 0.
        for seed, column in enumerate((0, 1, 0)):
            np.testing.assert_array_equal(gathered.obs[seed], block(0).obs[column])
    with pytest.raises(ArtifactError, match=r"proprioception: expected 'point'.*got 'probe'"):
        gather_experience(tmp_path, make_env("nav2d"), 1)


def test_gathers_recorded_data_for_every_seed(tmp_path):
    arrays = {"obs": np.zeros((5, 1)), "action": np.full((5, 1), 0.5), "reward": np.arange(5.0)}
    np.savez(tmp_path / "demo.npz", **arrays, done=np.arange(5) == 1)
    gathered = gather_experience(tmp_path / "demo.npz", Counting(100), 2)
    np.testing.assert_array_equal(gathered.reward, np.broadcast_to(np.arange(5.0)[:, None], (2, 5, 1)))
    assert gathered.done[0, :, 0].tolist() == [False, True, False, False, True]


def damaged(folder):
    (folder / "000001.npz").write_bytes((folder / "000000.npz").read_bytes()[:300])


def foreign(folder):
    np.savez(folder / "000001.npz", frames=np.zeros(3))


def text(folder):
    (folder / "000001.npz").write_text("not a block")


def pickled(folder):
    np.savez(folder / "000001.npz", obs=np.array([{}], dtype=object))


@pytest.mark.parametrize("spoil", [damaged, foreign, text, pickled])
def test_refuses_what_is_no_block(tmp_path, spoil):
    ExperienceStore(tmp_path, 2, {}).write(0, block(0))
    spoil(tmp_path)
    with pytest.raises(ArtifactError, match=r"000001\.npz") as error:
        read_experience(tmp_path, 0)
    assert "\n" not in str(error.value)


def test_refuses_missing_folders_and_seeds(tmp_path):
    ExperienceStore(tmp_path / "some", 2, {}).write(0, block(0))
    (tmp_path / "torn").mkdir()
    (tmp_path / "torn" / "description.json").write_text('{"env": ')
    attempts = [
        lambda: read_experience(tmp_path / "none", 0),
        lambda: read_experience(tmp_path / "some", K),
        lambda: gather_experience(tmp_path / "none", Counting(100), 1),
        lambda: gather_experience(tmp_path / "torn", Counting(100), 1),
    ]
    for attempt in attempts:
        with pytest.raises(ArtifactError) as error:
            attempt()
        assert "\n" not in str(error.value) and str(tmp_path) in str(error.value)


def test_collect_returns_the_newest_ticks():
    ppo = PPOConfig(num_envs=2, rollout_length=4, epochs=1, minibatch_size=8, hidden_sizes=(2,))
    config = CollectConfig(ticks=5 * 8, capacity=2 * 8 + 7, ppo=ppo)
    assert num_blocks(config) == 2
    run = jax.jit(lambda key: collect(config, Counting(100), key))
    _, metrics, experience = run(jax.random.key(0))
    assert metrics["decisions"].shape == (5,)
    # Ticks 12 to 19 of 20, in order, in both environments.
    expected = jnp.broadcast_to(jnp.arange(12.0, 20.0)[:, None], (8, 2))
    np.testing.assert_array_equal(experience.obs[..., 0], expected)
    np.testing.assert_array_equal(experience.reward, expected + 1)
    assert experience.action.shape == (8, 2, 1) and not experience.done.any()


def test_all_ticks_are_kept_but_where_the_capacity_is_smaller():
    ppo = PPOConfig(num_envs=2, rollout_length=4)
    blocks = {capacity: num_blocks(CollectConfig(ticks=5 * 8, capacity=capacity, ppo=ppo)) for capacity in (0, 16, 99)}
    assert blocks == {0: 5, 16: 2, 99: 5}
    assert CollectConfig().capacity == 0 and experience_ticks(CollectConfig(ticks=3_000_000)) == 3_000_000


def test_description_is_json(tmp_path):
    ExperienceStore(tmp_path, 1, {"env": "nav2d"})
    assert json.loads((tmp_path / "description.json").read_text()) == {"env": "nav2d"}
