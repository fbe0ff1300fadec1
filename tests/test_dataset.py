"""Windows of experience: which are cut, which are kept, and what is in them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from taic_jax.config import OptionsConfig
from taic_jax.options.dataset import Dataset, Experience, gather, make_dataset
from taic_jax.types import as_arrays

T, B, LENGTH = 12, 3, 3
FRACTION = 0.5


@jax.jit
def datasets_of(experience: Experience) -> dict[str, Dataset]:
    """Select windows of one experience both ways."""
    both = [OptionsConfig(length=LENGTH, select=select, fraction=FRACTION) for select in ("random", "top")]
    return {config.select: make_dataset(experience, as_arrays(config)) for config in both}


gather_windows = jax.jit(gather, static_argnums=3)


def make_experience(done: np.ndarray, seed: int = 0) -> Experience:
    """Return experience in which every entry tells its tick and its environment: obs (t, b), action 100 t + b."""
    t, b = np.meshgrid(np.arange(T), np.arange(B), indexing="ij")
    reward = np.random.default_rng(seed).permutation(T * B).reshape(T, B)
    obs, action = np.stack([t, b], axis=-1), (100 * t + b)[..., None]
    arrays = (jnp.asarray(x, jnp.float32) for x in (obs, action, reward))
    return Experience(*arrays, done=jnp.asarray(done))


def valid_starts(done: np.ndarray) -> set[tuple[int, int]]:
    """Return (t, b) of every window whose ticks, and the tick its end state was seen at, are of one episode."""
    return {
        (t, b) for t in range(T) for b in range(B) if t + LENGTH < T and not any(done[t + i, b] for i in range(LENGTH))
    }


def selected(dataset: Dataset) -> list[tuple[int, int]]:
    return [(int(row) % T, int(row) // T) for row in np.asarray(dataset.starts)[: int(dataset.count)]]


dones = st.lists(st.booleans(), min_size=T * B, max_size=T * B)
sparse = st.lists(st.integers(0, T * B - 1), max_size=4).map(lambda at: [i in at for i in range(T * B)])


@given(done=dones | sparse, seed=st.integers(0, 5))
def test_no_window_straddles_an_episode_end(done, seed):
    done = np.asarray(done).reshape(T, B)
    experience, valid = make_experience(done, seed), valid_starts(done)
    datasets = datasets_of(experience)
    kept = selected(datasets["random"])
    assert set(kept) == valid and len(kept) == len(valid)
    if not valid:
        return
    reward = np.asarray(experience.reward)
    score = {(t, b): reward[t : t + LENGTH, b].sum() for t, b in valid}
    top = selected(datasets["top"])
    assert len(top) == len(set(top)) == max(int(FRACTION * len(valid)), 1) and set(top) <= valid
    assert [score[w] for w in top] == sorted(score.values(), reverse=True)[: len(top)]


@pytest.mark.parametrize(
    ("since", "until", "ticks"), [(0.0, 0.5, range(6)), (0.25, 0.75, range(3, 9)), (0.5, 1.0, range(6, 12))]
)
def test_windows_start_between_since_and_until(since, until, ticks):
    done = np.zeros((T, B), bool)
    config = as_arrays(OptionsConfig(length=LENGTH, select="random", since=since, until=until))
    dataset = jax.jit(make_dataset)(make_experience(done), config)
    assert set(selected(dataset)) == {(t, b) for t, b in valid_starts(done) if t in ticks}


def test_windows_hold_their_own_environments_ticks():
    done = np.zeros((T, B), bool)
    done[5, 1] = True
    dataset = datasets_of(make_experience(done))["random"]
    windows = gather_windows(dataset, jnp.arange(int(dataset.count)), jnp.full(int(dataset.count), LENGTH), LENGTH)
    for i, (t, b) in enumerate(selected(dataset)):
        np.testing.assert_array_equal(windows.states[i], [[t + k, b] for k in range(LENGTH + 1)])
        np.testing.assert_array_equal(windows.actions[i, :, 0], [100 * (t + k) + b for k in range(LENGTH)])
    assert windows.mask.all() and windows.mask.shape == windows.actions.shape[:2]


@pytest.mark.parametrize("select", ["random", "top"])
def test_scales_are_of_the_selected_windows(select):
    experience = make_experience(np.zeros((T, B), bool))
    dataset = datasets_of(experience)[select]
    starts = np.asarray(selected(dataset), float)
    # The dataset is probed at 100,000 places, so a window may count once more than another.
    np.testing.assert_allclose(dataset.state_scale.mean, starts.mean(axis=0), rtol=1e-3)
    np.testing.assert_allclose(dataset.state_scale.std, starts.std(axis=0), rtol=1e-3)
    # Every window lasts LENGTH ticks and stays in its environment; what never varies is left as it is.
    np.testing.assert_allclose(dataset.change_scale.mean, [LENGTH, 0.0], atol=1e-4)
    np.testing.assert_array_equal(dataset.change_scale.std, [1.0, 1.0])
    normalised = dataset.state_scale(jnp.asarray(starts, jnp.float32))
    np.testing.assert_allclose(np.std(normalised, axis=0), [1.0, 1.0], rtol=1e-3)
