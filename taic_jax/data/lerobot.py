"""LeRobot's dataset folders, version 3, through pyarrow: the columns of states and actions, checked by its metadata."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from taic_jax.data.arrays import Layout, Place, nearest_name, read_arrays, reading
from taic_jax.options.dataset import Experience

INFO, STATISTICS, VERSION = "meta/info.json", "meta/stats.json", "v3."
EPISODE, LAST = "episode_index", "last step of an episode"
LAYOUT = Layout("LeRobot", ("observation.state",), "action", "next.reward", ends=(LAST,), optional=True)


def read_lerobot(folder: Path, observations: Sequence[str], actions: str) -> tuple[Experience, Layout]:
    """Read the steps of all episodes, or raise ArtifactError where data and metadata disagree."""
    place, layout = Place(folder / INFO), LAYOUT._replace(actions=actions or LAYOUT.actions)
    layout = layout._replace(observations=tuple(observations) or layout.observations)
    with reading(folder, "pyarrow"):
        info = json.loads(place.path.read_bytes())
        if not str(version := info["codebase_version"]).startswith(VERSION):
            raise place.refuse(f"expected codebase_version {VERSION}0, got {version!r}: convert the dataset by lerobot")
        features = info["features"]
        for name in (*layout.observations, layout.actions):
            _check_feature(place, name, features)
        table = _read_tables(folder / "data", {*layout.observations, layout.actions} | ({layout.rewards} & {*features}))
        index = table.pop(EPISODE)
        _check_lengths(folder, index, info)
        last = np.append(np.diff(index) != 0, True) if len(index) else np.zeros(0, bool)
        experience = read_arrays(Place(folder / "data"), table | {LAST: last}, layout)
        _check_statistics(Place(folder / STATISTICS), layout.actions, experience.action)
    return experience, layout


def _check_feature(place: Place, name: str, features: dict[str, Any]) -> None:
    """Raise ArtifactError unless a column is there and has floats."""
    numeric = [other for other, feature in features.items() if feature["dtype"].startswith("float")]
    if name not in features:
        raise place.refuse(f"expected {name} among the features, got none{nearest_name(name, numeric)}")
    if name not in numeric:
        expected = f"expected floats, as {', '.join(numeric)} have"
        raise (place / f"features/{name}").refuse(f"{expected}, got {features[name]['dtype']}")


def _read_tables(folder: Path, columns: set[str]) -> dict[str, np.ndarray]:
    """Return columns of all files in order: numbers [N], or [N, entries] of states and actions."""
    import pyarrow as pa
    import pyarrow.parquet as parquet

    paths = sorted(folder.glob("chunk-*/file-*.parquet"))
    if not paths:
        raise Place(folder).refuse("expected chunk-000/file-000.parquet in it, got none")
    tables = []
    for path in paths:
        there = parquet.read_schema(path).names
        for name in (name for name in (*columns, EPISODE) if name not in there):
            raise Place(path).refuse(f"expected column {name}, got none{nearest_name(name, there)}")
        tables.append(parquet.read_table(path, columns=[*columns, EPISODE]))
    table = pa.concat_tables(tables)
    return {name: _as_array(Place(folder, name), table[name].combine_chunks()) for name in table.column_names}


def _as_array(place: Place, column: Any) -> np.ndarray:
    """Return a column in NumPy, lists of numbers as rows."""
    if not hasattr(column, "flatten") or not str(column.type).startswith(("list", "fixed_size_list")):
        array = column.to_numpy(zero_copy_only=False)  # LeRobot writes features of one entry as plain numbers
        return array if place.inside in (EPISODE, LAYOUT.rewards) else array[:, None]
    lengths = np.unique(column.value_lengths().to_numpy(zero_copy_only=False))
    if len(lengths) > 1:
        raise place.refuse(f"expected lists of one length, got lengths {', '.join(map(str, lengths[:4]))}")
    return column.flatten().to_numpy(zero_copy_only=False).reshape(len(column), -1)


def _check_lengths(folder: Path, index: np.ndarray, info: dict[str, Any]) -> None:
    """Raise ArtifactError unless every episode is whole and in order."""
    import pyarrow.parquet as parquet

    rows = [
        parquet.read_table(p, columns=[EPISODE, "length"]) for p in sorted(folder.glob("meta/episodes/*/*.parquet"))
    ]
    expected = {int(i): int(n) for table in rows for i, n in zip(*table.to_pydict().values(), strict=True)}
    got = dict(zip(*(x.tolist() for x in np.unique(index, return_counts=True)), strict=True))
    for episode in sorted(expected.keys() | got.keys()):
        if (n := got.get(episode)) != (length := expected.get(episode)):
            raise Place(folder / "data").refuse(f"episode {episode}: expected {length} steps as in meta, got {n}")
    if len(index) != info["total_frames"] or (np.diff(index) < 0).any():
        expected = f"expected {info['total_frames']} steps of episodes in order, as in {INFO}"
        raise Place(folder / "data").refuse(f"{expected}, got {len(index)}")


def _check_statistics(place: Place, name: str, action: np.ndarray) -> None:
    """Raise ArtifactError unless the ranges of the actions are those that LeRobot measured."""
    statistics = json.loads(place.path.read_bytes()).get(name, {}) if place.path.exists() else {}
    for bound, got in {"min": action.min(axis=0), "max": action.max(axis=0)}.items():
        expected = np.asarray(statistics.get(bound, got), np.float32)
        if not np.allclose(expected, got, rtol=1e-3, atol=1e-3):
            message = f"expected {bound} {got.tolist()} as in the data, got {expected.tolist()}"
            raise (place / name).refuse(f"{message}: data of another dataset, or changed ones")
