"""Data that others' own writers recorded, or in their published layouts: read as recorded, and refused in one line."""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from write_robomimic import dataset

from taic_jax.data.read import read_data, read_recording
from taic_jax.options.dataset import Experience
from taic_jax.runtime.checkpoint import ArtifactError

HERE = Path(__file__).parent
LENGTHS = (60, 40, 60)


@pytest.fixture(scope="module")
def minari(tmp_path_factory) -> Iterator[dict[str, Any]]:
    """Record HalfCheetah-v5 by Minari's DataCollector, in each of its formats; return folders, and what was seen."""
    package, gymnasium = pytest.importorskip("minari"), pytest.importorskip("gymnasium")
    root = tmp_path_factory.mktemp("minari")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(root))
        yield {kind: record(package, gymnasium, kind) for kind in ("hdf5", "arrow", "parquet")} | {"root": root}


@pytest.mark.filterwarnings("ignore")
def record(minari: Any, gymnasium: Any, kind: str) -> Experience:
    """Record three episodes, and return their steps as they were."""
    env, rows = minari.DataCollector(gymnasium.make("HalfCheetah-v5"), data_format=kind), []
    env.action_space.seed(0)
    for seed, length in enumerate(LENGTHS):
        obs, _ = env.reset(seed=seed)
        for step in range(length):
            action = env.action_space.sample()
            after, reward, *_ = env.step(action)
            rows.append((obs, action, reward, step + 1 == length))
            obs = after
    about = {"algorithm_name": "random", "description": "a test", "eval_env": "HalfCheetah-v5"}
    env.create_dataset(f"cheetah/{kind}-v0", author="a", author_email="a@b", code_permalink="c", **about)
    env.close()
    return Experience(*(np.array(column) for column in zip(*rows, strict=True)))


def assert_reads(got: Experience, expected: Experience) -> None:
    for name, array in vars(expected).items():
        np.testing.assert_array_equal(vars(got)[name][:, 0], np.asarray(array, vars(got)[name].dtype), err_msg=name)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", ["hdf5", "arrow", "parquet"])
def test_reads_what_minari_recorded(minari, kind, capsys):
    folder = minari["root"] / "cheetah" / f"{kind}-v0"
    assert_reads(read_data(folder, sizes=(17, 6)), minari[kind])
    low, high = minari[kind].action.min(), minari[kind].action.max()
    sizes = f"3 episodes, 160 steps, 17 observations, 6 actions in [{low:.4g}, {high:.4g}]"
    assert capsys.readouterr().err == f"taic_jax: {folder}: Minari, {sizes}\n"
    # The first entries of a longer observation are a smaller body's; a longer one is another body's.
    np.testing.assert_array_equal(read_data(folder, sizes=(4, 6)).obs[:, 0], minari[kind].obs[:, :4].astype(np.float32))
    assert "of observations the first 4 of 17" in capsys.readouterr().err
    for sizes in ((27, 8), (17, 8)):
        assert "got 17 and 6" in refusal(folder, sizes=sizes)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", ["arrow", "parquet"])
def test_refuses_a_minari_dataset_without_an_episode(minari, kind, tmp_path):
    folder = shutil.copytree(minari["root"] / "cheetah" / f"{kind}-v0", tmp_path / "a")
    metadata = folder / "data/metadata.json"
    metadata.write_text(json.dumps(json.loads(metadata.read_text()) | {"total_episodes": 2}))
    assert "metadata.json: expected 160 steps as total_steps says, got 100 in the episodes" in refusal(folder)


def refusal(path: Path, *args: Any, **settings: Any) -> str:
    with pytest.raises(ArtifactError) as error:
        read_data(path, *args, **settings)
    assert "\n" not in str(error.value) and str(path) in str(error.value)
    return str(error.value)


def test_reads_what_robomimic_wrote():
    source = dataset()
    done = source["timeouts"][:10]
    expected = Experience(source["observations"][:10], source["actions"][:10], source["rewards"][:10], done)
    for keys in ((), ("flat",)):  # the one there is need not be chosen
        assert_reads(read_data(HERE / "robomimic.hdf5", keys), expected)


def test_robomimic_data_with_several_observations_want_a_choice(tmp_path):
    path = Path(shutil.copy(HERE / "robomimic.hdf5", tmp_path / "demos.hdf5"))
    with h5py.File(path, "a") as file:
        for demo in file["data"].values():
            demo["obs/object"] = demo["obs/flat"][:, :2] + 10
            demo["obs/image"] = np.zeros((len(demo["actions"]), 4, 4, 3), np.uint8)
    hint = "data/demo_0: expected a choice by --observations KEY..., got flat, image, object"
    assert hint in refusal(path)
    got = read_data(path, ("object", "flat")).obs[:, 0]
    np.testing.assert_array_equal(got[:, :2], got[:, 2:4] + 10)
    assert got.shape == (10, 5)
    assert "demo_0/obs: expected objekt in it, got nothing; the nearest name is 'object'" in refusal(path, ["objekt"])
    assert "demo_0/obs/image: expected numbers [6, entries], got uint8 [6, 4, 4, 3]" in refusal(path, ["image"])
    assert "demo_0: expected action in it, got nothing; the nearest name is 'actions'" in refusal(
        path, ["flat"], "action"
    )


def d4rl() -> dict[str, np.ndarray]:
    """Return arrays in the layout that D4RL's scripts/generation/mujoco/collect_data.py writes, from robomimic's."""
    source = dataset()
    terminals = np.zeros(13, bool)
    terminals[2] = True
    return source | {"terminals": terminals, "infos/qpos": source["observations"][:, :2] * 2}


def test_reads_the_layout_of_d4rl(tmp_path):
    arrays = d4rl()
    with h5py.File(tmp_path / "d4rl.hdf5", "w") as file:
        for name, array in arrays.items():
            file.create_dataset(name, data=array, compression="gzip")
        file["metadata/algorithm"] = np.bytes_("SAC")
    done = arrays["terminals"] | arrays["timeouts"] | (np.arange(13) == 12)
    expected = Experience(arrays["observations"], arrays["actions"], arrays["rewards"], done)
    assert_reads(read_data(tmp_path / "d4rl.hdf5"), expected)
    got = read_data(tmp_path / "d4rl.hdf5", ("infos/qpos",))
    np.testing.assert_array_equal(got.obs[:, 0], arrays["infos/qpos"])


def test_reads_the_layout_of_ogbench(tmp_path):
    """OGBench's data are compressed NumPy files without rewards; `terminals` end trajectories, as its loader says."""
    arrays = d4rl()
    names = ("observations", "actions", "terminals")
    np.savez_compressed(tmp_path / "cube.npz", **{name: arrays[name].astype(np.float32) for name in names})
    done = arrays["terminals"] | (np.arange(13) == 12)
    assert_reads(
        read_data(tmp_path / "cube.npz"), Experience(arrays["observations"], arrays["actions"], np.zeros(13), done)
    )


def written(path: Path, **changes: Any) -> Path:
    np.savez(path, **{name: array for name, array in (d4rl() | changes).items() if array is not None})
    return path


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"actions": None}, "a.npz: expected actions in it, got nothing; the nearest name is"),
        ({"actions": np.zeros(13, np.int64)}, "a.npz: actions: .* got int64 .13.: discrete actions"),
        ({"actions": np.zeros((13, 2), np.int32)}, "a.npz: actions: .* got int32 .13, 2.: discrete actions"),
        (
            {"observations": np.zeros((12, 3))},
            "a.npz: observations: expected numbers .13, entries., got float64 .12, 3.",
        ),
        ({"rewards": np.full(13, np.nan)}, "a.npz: rewards: expected finite numbers, got 13 of 13"),
        ({"terminals": None, "timeouts": None}, "a.npz: expected the ends of episodes, done, terminals, timeouts"),
        ({"terminals": np.arange(13)}, "a.npz: terminals: expected bool .13., or 0 and 1, got int64"),
    ],
)
def test_names_what_is_wrong_in_flat_arrays(tmp_path, changes, message):
    path = written(tmp_path / "a.npz", **changes)
    with pytest.raises(ArtifactError, match=message):
        read_recording(path)
