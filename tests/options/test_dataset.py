"""Windows of experience: which are cut, which are kept, and what is in them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from probes import assert_trees_equal, draw

from taic_jax.config import OptionsConfig
from taic_jax.options.dataset import HELD_OUT_EVERY, STRETCH, Dataset, Experience, gather, make_dataset
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


TOP = OptionsConfig(length=LENGTH, select="top", fraction=0.4)
make = jax.jit(make_dataset)


def make_untied(seed: int = 0) -> Experience:
    """Return experience of which no two windows collected the same reward."""
    experience = make_experience(np.zeros((T, B), bool))
    return experience.replace(reward=draw(np.random.default_rng(seed), T, B))


def best(experience: Experience, windows: list[tuple[int, int]], fraction: float) -> set[tuple[int, int]]:
    """Return the share of these windows that collected most reward, at least one."""
    reward = np.asarray(experience.reward)
    ranked = sorted(windows, key=lambda w: -reward[w[0] : w[0] + LENGTH, w[1]].sum())
    return set(ranked[: max(int(fraction * len(ranked)), 1)]) if ranked else set()


@pytest.mark.parametrize("parts", [1, 2, 3])
@pytest.mark.parametrize("span", [(0.0, 1.0), (0.25, 0.75)], ids=str)
def test_each_part_contributes_its_own_best(parts, span):
    done = np.zeros((T, B), bool)
    done[[2, 3, 6], [0, 1, 1]] = True
    # Rewards fall with time, so that without parts the early ones alone would be kept.
    experience = make_untied()
    experience = experience.replace(reward=experience.reward - 9.0 * experience.obs[..., 0], done=jnp.asarray(done))
    dataset = make(experience, as_arrays(dataclasses.replace(TOP, parts=parts, since=span[0], until=span[1])))
    first, last = (int(share * T) for share in span)
    expected = set()
    for n in range(parts):
        ticks = [t for t in range(first, last) if (t - first) * parts // (last - first) == n]
        expected |= best(experience, [w for w in valid_starts(done) if w[0] in ticks], TOP.fraction)
    kept = selected(dataset)
    assert set(kept) == expected and len(kept) == len(expected) and dataset.held_out == 0


def test_a_part_without_windows_contributes_none():
    done = np.zeros((T, B), bool)
    done[:6] = True
    experience = make_untied().replace(done=jnp.asarray(done))
    dataset = make(experience, as_arrays(dataclasses.replace(TOP, parts=2)))
    assert set(selected(dataset)) == best(experience, list(valid_starts(done)), TOP.fraction)


def test_several_experiences_each_contribute_their_own_best():
    """The second is shorter, has fewer environments and rewards far below the first one's."""
    config = dataclasses.replace(TOP, fraction=0.7)
    done = [np.zeros((T, B), bool), np.zeros((7, 2), bool)]
    done[1][3, 0] = True
    first = make_untied()
    second = jax.tree.map(lambda x: x[:7, :2], make_untied(seed=1))
    # Its entries tell apart from the first's: 1000 is added to the environment.
    second = Experience(
        second.obs.at[..., 1].add(1000.0), second.action + 1000.0, second.reward - 100.0, jnp.asarray(done[1])
    )
    dataset = make([first, second], as_arrays(config))
    expected = best(first, list(valid_starts(done[0])), config.fraction)
    starts = [(t, b) for t in range(7 - LENGTH) for b in range(2) if not done[1][t : t + LENGTH, b].any()]
    expected |= {(t, 1000 + b) for t, b in best(second, starts, config.fraction)}
    count = int(dataset.count)
    windows = gather_windows(dataset, jnp.arange(count), jnp.full(count, LENGTH), LENGTH)
    assert {tuple(map(int, states[0])) for states in windows.states} == expected and count == len(expected)
    for states, actions in zip(windows.states, windows.actions, strict=True):
        t, b = map(int, states[0])
        np.testing.assert_array_equal(states, [[t + k, b] for k in range(LENGTH + 1)])
        np.testing.assert_array_equal(actions[:, 0], [100 * (t + k) + b for k in range(LENGTH)])


def test_one_experience_in_a_list_is_the_same():
    experience = make_experience(np.zeros((T, B), bool))
    assert_trees_equal(make(experience, as_arrays(TOP)), make([experience], as_arrays(TOP)))


def long_experience() -> Experience:
    """Return 2 environments of twice as many ticks as every tenth stretch needs."""
    ticks = 2 * STRETCH * HELD_OUT_EVERY * LENGTH
    t, b = np.meshgrid(np.arange(ticks), np.arange(2), indexing="ij")
    reward = np.random.default_rng(0).normal(size=t.shape)
    arrays = (jnp.asarray(x, jnp.float32) for x in (np.stack([t, b], axis=-1), t[..., None], reward))
    return Experience(*arrays, done=jnp.zeros(t.shape, bool))


@pytest.mark.parametrize("select", ["top", "random"])
def test_every_tenth_stretch_is_held_out_where_a_quantile_is_measured(select):
    experience, config = long_experience(), dataclasses.replace(TOP, select=select)
    ticks = len(experience.reward)
    quantile = as_arrays(dataclasses.replace(config, termination="predict", delta_unit="quantile"))
    plain, split = make(experience, as_arrays(config)), make(experience, quantile)
    assert plain.held_out == 0
    rows = np.asarray(split.starts)
    count, held = int(split.count), int(split.held_out)
    learnt_from, held_out = set(rows[:count].tolist()), set(rows[count : count + held].tolist())
    assert len(learnt_from) == count and len(held_out) == held and not learnt_from & held_out
    assert learnt_from | held_out == set(np.asarray(plain.starts)[: int(plain.count)].tolist())
    for row in learnt_from | held_out:
        assert (row in held_out) == (row % ticks // (STRETCH * LENGTH) % 10 == 9)
    np.testing.assert_allclose(held / (held + count), 0.1, atol=0.03)
    # The scales are measured on what is learnt from.
    mean = np.asarray(split.experience.obs)[sorted(learnt_from)].mean(axis=0)
    np.testing.assert_allclose(split.state_scale.mean, mean, rtol=1e-3)


@pytest.mark.parametrize(
    "changes", [{"termination": "fixed"}, {"termination": "output"}, {"termination": "predict", "delta_unit": "error"}]
)
def test_nothing_else_holds_windows_out(changes):
    plain = make(long_experience(), as_arrays(TOP))
    assert_trees_equal(make(long_experience(), as_arrays(dataclasses.replace(TOP, **changes))), plain)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("select", ["top", "random"])
def test_a_reward_that_is_not_finite_gives_no_window(value, select):
    done = np.zeros((T, B), bool)
    experience = make_experience(done)
    experience = experience.replace(reward=experience.reward.at[5, 1].set(value))
    dataset = make(experience, as_arrays(dataclasses.replace(TOP, select=select, fraction=1.0)))
    assert set(selected(dataset)) == {(t, b) for t, b in valid_starts(done) if b != 1 or not t <= 5 < t + LENGTH}


def test_gather_masks_the_ticks_beyond_those_asked_for():
    dataset = datasets_of(make_experience(np.zeros((T, B), bool)))["random"]
    windows = gather_windows(dataset, jnp.array([4, 4, 9]), jnp.array([1, 2, 3]), LENGTH)
    np.testing.assert_array_equal(windows.mask, [[True, False, False], [True, True, False], [True, True, True]])
    np.testing.assert_array_equal(windows.states[0], windows.states[1])  # the rest is as it was
    assert windows.states.shape == (3, LENGTH + 1, 2)
