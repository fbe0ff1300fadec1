"""Recorded data: read back as they were recorded, or refused in one line with the file and the field."""

import json
import re
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from probes import assert_trees_equal

from taic_jax.data.read import read_data
from taic_jax.options.dataset import Experience
from taic_jax.runtime.checkpoint import ArtifactError

P, A = 3, 2
MINARI = ("observations", "actions", "rewards", "terminations", "truncations")


def flat(lengths: list[int]) -> dict[str, np.ndarray]:
    """Return the arrays of a NumPy file whose entries tell tick and feature."""
    ticks = sum(lengths)
    done = np.zeros(ticks, bool)
    done[np.cumsum(lengths) - 1] = True
    obs = np.arange(ticks * 5.0).reshape(ticks, 5) / 8
    action = np.linspace(-1, 1, ticks * A).reshape(ticks, A)
    return {"obs": obs, "action": action, "reward": np.arange(ticks) / 4, "done": done}


def expected(arrays: dict[str, np.ndarray]) -> Experience:
    obs, action, reward = (arrays[name].astype(np.float32)[:, None] for name in ("obs", "action", "reward"))
    return Experience(obs[..., :P], action, reward, arrays["done"][:, None])


def split(arrays: dict[str, np.ndarray], lengths: list[int]) -> dict[str, dict]:
    """Return the same ticks as Minari's groups; nothing marks an end, and a last observation is added."""
    episodes, ends = {}, np.cumsum(lengths)
    for i, (start, end) in enumerate(zip(ends - lengths, ends, strict=True)):
        obs = np.concatenate([arrays["obs"][start:end], np.full_like(arrays["obs"][:1], -7)])
        values = obs, arrays["action"][start:end], arrays["reward"][start:end], *np.zeros((2, end - start), bool)
        episodes[f"episode_{i}"] = dict(zip(MINARI, values, strict=True))
    return episodes


def without_ticks(episode: dict) -> dict:
    return {name: values[: int(name == "observations")] for name, values in episode.items()}


def write_hdf5(file: Path, tree: dict) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(file, "w") as stored:
        fill(stored, tree)
    return file


def fill(group: h5py.Group, tree: dict) -> None:
    for name, value in tree.items():
        if isinstance(value, dict):
            fill(group.create_group(name), value)
        else:
            group[name] = value


def write_minari(folder: Path, tree: dict, metadata: object = None) -> Path:
    write_hdf5(folder / "data" / "main_data.hdf5", tree)
    (folder / "data" / "metadata.json").write_text(json.dumps(metadata or {"data_format": "hdf5"}))
    return folder


def write_npz(file: Path, arrays: dict) -> Path:
    np.savez(file, **arrays)
    return file


def read_or_refusal(path: Path) -> Experience | str:
    """Return what is read or the message; any other exception passes through."""
    try:
        return read_data(path, sizes=(P, A))
    except ArtifactError as error:
        assert "\n" not in str(error) and str(path) in str(error)
        return str(error)


def refusal(path: Path) -> str:
    message = read_or_refusal(path)
    assert isinstance(message, str), "it was read"
    return message


def test_reads_a_numpy_file(tmp_path):
    arrays = flat([4, 1, 6])
    got = read_data(write_npz(tmp_path / "demos.npz", arrays), sizes=(P, A))
    assert_trees_equal(got, expected(arrays))
    assert got.obs.shape == (11, 1, P) and got.action.shape == (11, 1, A)
    assert [x.dtype for x in (got.obs, got.action, got.reward, got.done)] == ["f4", "f4", "f4", "?"]


def test_the_end_of_a_numpy_file_ends_an_episode(tmp_path):
    arrays = flat([2, 3]) | {"done": np.array([0, 1, 0, 0, 0], bool)}
    got = read_data(write_npz(tmp_path / "demos.npz", arrays), sizes=(P, A))
    np.testing.assert_array_equal(got.done[:, 0], [False, True, False, False, True])


@pytest.mark.parametrize("inside", [".", "data", "data/main_data.hdf5"])
def test_reads_a_minari_dataset_in_the_order_of_its_episodes(tmp_path, inside):
    lengths = list(range(1, 13))  # twelve episodes: as text, episode_10 comes before episode_2
    arrays = flat(lengths)
    folder = write_minari(tmp_path / "a-dataset", split(arrays, lengths))
    assert_trees_equal(read_data(folder / inside, sizes=(P, A)), expected(arrays))


@pytest.mark.parametrize("name", ["terminations", "truncations"])
def test_ends_that_minari_marks_count_too(tmp_path, name):
    episodes = split(flat([4]), [4])
    episodes["episode_0"][name] = np.array([0, 1, 0, 0], bool)
    got = read_data(write_hdf5(tmp_path / "demos.h5", episodes), sizes=(P, A))
    np.testing.assert_array_equal(got.done[:, 0], [False, True, False, True])


def test_takes_the_observation_of_a_group(tmp_path):
    arrays = flat([3, 2])
    episodes = split(arrays, [3, 2])
    for episode in episodes.values():
        episode["observations"] = {"observation": episode["observations"], "desired_goal": np.zeros((9, 2))}
    assert_trees_equal(read_data(write_minari(tmp_path, episodes), sizes=(P, A)), expected(arrays))


def test_leaves_out_what_is_no_episode_and_episodes_without_ticks(tmp_path):
    arrays = flat([3])
    episodes = split(arrays, [3])
    empty = without_ticks(episodes["episode_0"])
    tree = episodes | {"episode_1": empty, "episode_x": {}, "notes": np.zeros(2)}
    assert_trees_equal(read_data(write_hdf5(tmp_path / "demos.hdf5", tree), sizes=(P, A)), expected(arrays))


def test_clips_what_rounding_put_beyond_one(tmp_path):
    arrays = flat([3])
    arrays["action"] = np.array([[1.0009, 0.5], [-1.0009, 0], [1, -1]])
    got = read_data(write_npz(tmp_path / "demos.npz", arrays), sizes=(P, A))
    np.testing.assert_array_equal(got.action[:, 0], np.array([[1, 0.5], [-1, 0], [1, -1]], np.float32))


def with_entry(name, index, value):
    """Return a change of one entry of the array `name`."""

    def change(arrays):
        arrays[name][index] = value

    return change


NPZ_MISTAKES = {
    "no action": (lambda x: x.update(actions=x.pop("action")), r": expected action in it.*nearest name is 'actions'"),
    "narrow obs": (
        lambda x: x.update(obs=x["obs"][:, :2]),
        r": expected at least 3 observations and 2 actions, as the body has; got 2 and 2",
    ),
    "short obs": (lambda x: x.update(obs=x["obs"][1:]), r": obs: expected numbers \[5, entries\].*\[4, 5\]"),
    "wide action": (
        lambda x: x.update(action=x["obs"]),
        r": expected at least 3 observations and 2 actions.*got 5 and 5",
    ),
    "scalar action": (
        lambda x: x.update(action=np.zeros(())),
        r": action: expected continuous actions \[steps, entries\].*\[\]",
    ),
    "short reward": (lambda x: x.update(reward=x["reward"][1:]), r": reward: expected numbers \[5\].*\[4\]"),
    "text reward": (lambda x: x.update(reward=np.array(["a"] * 5)), r": reward: expected numbers \[5\], got <U1"),
    "pickled reward": (lambda x: x.update(reward=np.array([None] * 5)), r": .*allow_pickle=False"),
    "number done": (lambda x: x.update(done=x["done"] * 2.0), r": done: expected bool \[5\], or 0 and 1, got float64"),
    "short done": (lambda x: x.update(done=x["done"][1:]), r": done: expected bool \[5\], or 0 and 1, got bool \[4\]"),
    "NaN obs": (with_entry("obs", (1, 2), np.nan), r": obs: .* got 1 of 25 that are NaN or infinite"),
    "infinite reward": (with_entry("reward", slice(3), np.inf), r": reward: .* got 3 of 5 that are NaN or infinite"),
    "huge reward": (with_entry("reward", 0, 1e300), r": reward: .* got 1 of 5 that are NaN or infinite"),
    "unscaled action": (with_entry("action", (1, 0), -3.5), r": action: .* got -3.5; state their --action-bounds"),
    "no tick": (lambda x: x.update({k: v[:0] for k, v in x.items()}), r": .* got no step"),
}


@pytest.mark.parametrize("mistake", NPZ_MISTAKES)
def test_names_what_is_wrong_in_a_numpy_file(tmp_path, mistake):
    change, pattern = NPZ_MISTAKES[mistake]
    arrays = flat([2, 3])
    change(arrays)
    assert re.search(r"demos\.npz" + pattern, refusal(write_npz(tmp_path / "demos.npz", arrays)))


def in_episode(name: str, value: object):
    """Return a change of one entry of episode_1; None takes it away."""

    def change(tree):
        tree["episode_1"] = {k: v for k, v in tree["episode_1"].items() if k != name}
        if value is not None:
            tree["episode_1"][name] = value

    return change


def nested(**entries: object):
    return in_episode("observations", dict(entries))


HDF5_MISTAKES = {
    "no rewards": (in_episode("rewards", None), r"episode_1: expected rewards in it, got nothing; the nearest"),
    "ragged obs": (in_episode("observations", np.zeros((3, 5))), r"episode_1/observations: .*\[4, entries\].*\[3, 5\]"),
    "narrow obs": (
        in_episode("observations", np.zeros((4, 1))),
        r"episode_1: expected 5 observations and 2 actions, as the first episode has; got 1 observations",
    ),
    "ragged rewards": (in_episode("rewards", np.zeros(4)), r"episode_1/rewards: expected numbers \[3\].*\[4\]"),
    "ragged ends": (in_episode("truncations", np.zeros(2, bool)), r"episode_1/truncations: .*bool \[3\].*\[2\]"),
    "integer ends": (in_episode("terminations", np.arange(3)), r"episode_1/terminations: .*0 and 1, got int64 \[3\]"),
    "discrete actions": (
        in_episode("actions", np.zeros(3, int)),
        r"episode_1/actions: .*got int64 \[3\]: discrete actions, where",
    ),
    "grouped actions": (in_episode("actions", {"left": np.zeros(3)}), r"episode_1/actions: .* got a group"),
    "text obs": (in_episode("observations", ["a", "b", "c", "d"]), r"episode_1/observations: .* got object \[4\]"),
    "empty obs": (in_episode("observations", h5py.Empty("f")), r"episode_1/observations: .* got float32 \[\]"),
    "unscaled actions": (in_episode("actions", np.full((3, 2), 2.5)), r"actions: .* got 2.5; state their"),
    "NaN obs": (in_episode("observations", np.full((4, 5), np.nan)), r"episode_1/observations: .* got 20 of 20"),
    "unknown group": (nested(image=np.zeros((4, 9))), r"episode_1/observations: .*got a group"),
    "nested group": (nested(observation={"body": np.zeros((4, 5))}), r"episode_1/observations: .* got a group"),
    "array episode": (lambda x: x.update(episode_1=np.zeros(3)), r"episode_1: expected a group, got an array"),
    "no episode": (
        lambda x: x.clear(),
        r"expected the ends of episodes, done, terminals, timeouts, or groups episode_0 .*, got none",
    ),
    "no tick": (lambda x: x.update({k: without_ticks(v) for k, v in x.items()}), r".*got no step"),
}


@pytest.mark.parametrize("mistake", HDF5_MISTAKES)
def test_names_what_is_wrong_in_a_minari_file(tmp_path, mistake):
    change, pattern = HDF5_MISTAKES[mistake]
    tree = split(flat([2, 3]), [2, 3])
    change(tree)
    write_minari(tmp_path / "a-dataset", tree)
    message = refusal(tmp_path / "a-dataset" / "data")
    assert re.search(r"(main_data\.hdf5|data): " + pattern, message), message


def test_names_the_layouts_it_reads(tmp_path):
    assert "another kind of file" in refusal(write_minari(tmp_path / "zarr", {}, {"data_format": "zarr"}))
    torn = write_minari(tmp_path / "torn", {})
    (torn / "data" / "metadata.json").write_text('{"data_format": ')
    assert "metadata.json: damaged" in refusal(torn)
    assert "metadata.json: damaged" in refusal(write_minari(tmp_path / "list", {}, [1]))
    (tmp_path / "empty").mkdir()
    assert "expected main_data.hdf5 or data/main_data.hdf5 in it" in refusal(tmp_path / "empty")
    for name in ("demos.csv", "demos"):
        (tmp_path / name).write_text("1,2")
        assert re.search("unknown kind of file.*supported: .*npz.*hdf5", refusal(tmp_path / name))
    assert "got nothing" in refusal(tmp_path / "none.npz")
    assert "OSError" in refusal(tmp_path / ("long" * 1000))
    np.save(tmp_path / "array.npy", np.zeros(3))
    (tmp_path / "array.npy").rename(tmp_path / "array.npz")
    assert "expected an .npz file as np.savez writes it" in refusal(tmp_path / "array.npz")


def test_only_hdf5_needs_h5py(tmp_path, monkeypatch):
    file = write_hdf5(tmp_path / "demos.hdf5", split(flat([3]), [3]))
    monkeypatch.setitem(sys.modules, "h5py", None)
    assert refusal(file).endswith("the package h5py is not installed: pip install 'taic-jax[data]'")
    assert not isinstance(read_or_refusal(write_npz(tmp_path / "demos.npz", flat([3]))), str)
