"""LeRobot's dataset folder, as its own writer wrote it (write_lerobot.py), and ones that were changed since."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from taic_jax.data.read import read_data
from taic_jax.options.dataset import Experience
from taic_jax.runtime.checkpoint import ArtifactError

pytest.importorskip("pyarrow")
HERE = Path(__file__).parent


def refusal(path: Path, *args: Any, **settings: Any) -> str:
    with pytest.raises(ArtifactError) as error:
        read_data(path, *args, **settings)
    assert "\n" not in str(error.value) and str(path) in str(error.value)
    return str(error.value)


def point(observations: tuple[str, ...] = ()) -> Experience:
    return read_data(HERE / "lerobot", observations)


def test_reads_what_lerobot_wrote():
    got = point()
    assert got.done[:, 0].nonzero()[0].tolist() == [6, 11] and got.obs.shape == (12, 1, 3)
    for start, end in ((0, 6), (7, 11)):  # the writer's point: it moves by its action
        np.testing.assert_array_equal(got.obs[start, 0], 0)
        moved = got.obs[start:end, 0, :2] + got.action[start:end, 0]
        np.testing.assert_allclose(got.obs[start + 1 : end + 1, 0, :2], moved, rtol=1e-6)
    np.testing.assert_array_equal(got.reward, got.obs[..., 0] - 1)
    both = point(("observation.environment_state", "observation.state")).obs
    np.testing.assert_array_equal(both, np.concatenate([np.full((12, 1, 2), [4, 2]), got.obs], axis=-1))


def change_info(folder: Path, **changes: Any) -> None:
    path = folder / "meta/info.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def cut_data(folder: Path) -> None:
    import pyarrow.parquet as parquet

    (path,) = folder.glob("data/*/*.parquet")
    parquet.write_table(parquet.read_table(path).slice(0, 9), path)


def ragged_data(folder: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as parquet

    (path,) = folder.glob("data/*/*.parquet")
    table = parquet.read_table(path)
    column = table.column_names.index("action")
    rows = [row[: 1 + (i > 0)] for i, row in enumerate(table["action"].to_pylist())]
    parquet.write_table(table.set_column(column, "action", pa.array(rows)), path)


def other_statistics(folder: Path) -> None:
    path = folder / "meta/stats.json"
    path.write_text(path.read_text().replace("0.7263578176498413", "45.0"))


def torn_data(folder: Path) -> None:
    (path,) = folder.glob("data/*/*.parquet")
    path.write_bytes(path.read_bytes()[:2000])


LEROBOT_MISTAKES = {
    "of version 2": (lambda x: change_info(x, codebase_version="v2.1"), "info.json: expected codebase_version v3.0"),
    "cut": (cut_data, "data: episode 1: expected 5 steps as in meta, got 2"),
    "ragged": (ragged_data, "data: action: expected lists of one length, got lengths 1, 2"),
    "mislabelled": (other_statistics, "stats.json: action: expected max [0.72"),
    "torn": (torn_data, "damaged, or another kind of file"),
    "without data": (lambda x: shutil.rmtree(x / "data"), "data: expected chunk-000/file-000.parquet in it, got none"),
    "of other counts": (lambda x: change_info(x, total_frames=99), "expected 99 steps of episodes in order"),
}


@pytest.mark.parametrize("mistake", LEROBOT_MISTAKES)
def test_refuses_a_lerobot_dataset(mistake, tmp_path):
    change, message = LEROBOT_MISTAKES[mistake]
    change(folder := Path(shutil.copytree(HERE / "lerobot", tmp_path / "set")))
    assert message in refusal(folder)


def test_names_lerobots_columns():
    folder = HERE / "lerobot"
    assert "expected actions among the features, got none; the nearest name is 'action'" in refusal(
        folder, (), "actions"
    )
    assert "next.done: expected floats, as observation.state" in refusal(folder, ["next.done"])
