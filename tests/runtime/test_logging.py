"""What a run measures: rows, events and their agreement after a resume."""

import io
import json
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from tensorboardX.proto.event_pb2 import Event  # pyright: ignore[reportAttributeAccessIssue]
from tensorboardX.proto.summary_pb2 import HistogramProto  # pyright: ignore[reportAttributeAccessIssue]

from taic_jax.runtime.logging import RunLogger
from taic_jax.runtime.run_folder import RunFolder


def read_events(run_dir) -> dict[tuple[str, int], float]:
    """Read all scalars."""
    return _read_events(run_dir)[0]


def read_histograms(run_dir) -> dict[tuple[str, int], HistogramProto]:
    """Read all histograms."""
    return _read_events(run_dir)[1]


def _read_events(run_dir) -> tuple[dict, dict, dict]:
    """Read all events: a record is 8 bytes of length, 4 of checksum, the event, 4 of checksum."""
    scalars, histograms, images = {}, {}, {}
    for path in (run_dir / "tensorboard").iterdir():
        data = path.read_bytes()
        while data:
            end = 12 + int.from_bytes(data[:8], "little")
            event = Event.FromString(data[12:end])
            for value in event.summary.value:
                place = value.tag, event.step
                assert place not in {**scalars, **histograms, **images}
                if value.HasField("image"):
                    images[place] = value.image
                elif value.HasField("histo"):
                    histograms[place] = value.histo
                else:
                    scalars[place] = value.simple_value
            data = data[end + 4 :]
    return scalars, histograms, images


def read_images(run_dir) -> dict[tuple[str, int], Any]:
    """Read all pictures."""
    return _read_events(run_dir)[2]


def test_rows_hold_one_number_per_seed_and_events_their_mean(tmp_path):
    with RunLogger(tmp_path) as logger:
        logger.log("train", 64, {"return": jnp.array([1.0, 3.0]), "ppo/entropy": 0.5, "episodes": 3})
    (row,) = RunFolder(tmp_path).metrics()
    assert row.pop("time") > 0
    assert row == {
        "stage": "train",
        "ticks": 64,
        "train/return": [1.0, 3.0],
        "train/ppo/entropy": 0.5,
        "train/episodes": 3,
    }
    expected = {("train/return", 64): 2.0, ("train/ppo/entropy", 64): 0.5, ("train/episodes", 64): 3.0}
    assert read_events(tmp_path) == expected


def test_what_is_not_finite_is_null(tmp_path):
    with RunLogger(tmp_path) as logger:
        logger.log("train", 1, {"some": np.array([np.nan, 2.0, np.inf]), "none": jnp.nan})
    text = (tmp_path / "metrics.jsonl").read_text()
    row = json.loads(text, parse_constant=pytest.fail)
    assert (row["train/some"], row["train/none"]) == ([None, 2.0, None], None)
    assert read_events(tmp_path) == {("train/some", 1): 2.0}


def test_rows_are_on_disk_at_once(tmp_path):
    with RunLogger(tmp_path) as logger:
        logger.log("train", 1, {})
        assert len(RunFolder(tmp_path).metrics()) == 1


def log_two_stages(logger: RunLogger) -> None:
    for stage in ("collect", "train"):
        for ticks in (10, 20, 30):
            logger.log(stage, ticks, {"return": float(ticks)})


def test_truncate_drops_rows_and_events_after_the_checkpoint(tmp_path):
    with RunLogger(tmp_path) as logger:
        log_two_stages(logger)
    (events,) = (tmp_path / "tensorboard").iterdir()
    events.rename(events.with_name("events.out.tfevents.0.of-an-hour-ago"))
    with RunLogger(tmp_path) as logger:
        logger.truncate("train", 20)
        logger.log("train", 30, {"return": 7.0})
    kept = [(row["stage"], row["ticks"]) for row in RunFolder(tmp_path).metrics()]
    assert kept == [
        ("collect", 10),
        ("collect", 20),
        ("collect", 30),
        ("train", 10),
        ("train", 20),
        ("train", 30),
    ]
    events = read_events(tmp_path)
    assert len(events) == 6 and events["train/return", 30] == 7.0


COUNTS = np.array([[1.0, 0.0, 4.0], [2.0, 0.0, 3.0]], np.float32)
"""Of two seeds: how many options took 1, 2 and 3 ticks."""


def assert_histogram_of_counts(histogram: HistogramProto) -> None:
    """Over both seeds 3 options took one tick and 7 took three: 24 ticks, and 3 + 7 * 9 squared."""
    assert list(histogram.bucket) == [3.0, 0.0, 7.0] and list(histogram.bucket_limit) == [1.5, 2.5, 3.5]
    assert (histogram.min, histogram.max, histogram.num) == (0.5, 3.5, 10)
    assert (histogram.sum, histogram.sum_squares) == (24.0, 66.0)


def test_counts_are_a_list_per_seed_and_a_histogram_over_seeds(tmp_path):
    with RunLogger(tmp_path) as logger:
        logger.log("train", 64, {"durations": jnp.asarray(COUNTS), "return": jnp.array([1.0, 3.0])})
        logger.log("train", 128, {"durations": np.zeros((2, 3), np.float32)})  # no option ended
    first, second = RunFolder(tmp_path).metrics()
    assert first["train/durations"] == [[1.0, 0.0, 4.0], [2.0, 0.0, 3.0]]
    assert second["train/durations"] == [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    assert read_events(tmp_path) == {("train/return", 64): 2.0}
    histograms = read_histograms(tmp_path)
    assert set(histograms) == {("train/durations", 64), ("train/durations", 128)}
    assert_histogram_of_counts(histograms["train/durations", 64])
    assert histograms["train/durations", 128].num == 0


def test_counts_survive_truncation(tmp_path):
    with RunLogger(tmp_path) as logger:
        logger.log("train", 10, {"durations": COUNTS})
        logger.log("train", 20, {"durations": COUNTS})
    (events,) = (tmp_path / "tensorboard").iterdir()
    events.rename(events.with_name("events.out.tfevents.0.of-an-hour-ago"))
    with RunLogger(tmp_path) as logger:
        logger.truncate("train", 10)
    (row,) = RunFolder(tmp_path).metrics()
    assert row["train/durations"] == COUNTS.tolist()
    histograms = read_histograms(tmp_path)
    assert set(histograms) == {("train/durations", 10)}
    assert_histogram_of_counts(histograms["train/durations", 10])


def test_truncate_to_nothing_drops_the_whole_stage(tmp_path):
    with RunLogger(tmp_path) as logger:
        log_two_stages(logger)
        logger.truncate("collect", -1)
    assert {row["stage"] for row in RunFolder(tmp_path).metrics()} == {"train"}
    assert {name for name, _ in read_events(tmp_path)} == {"train/return"}


def test_a_half_written_row_is_dropped(tmp_path):
    path = tmp_path / "metrics.jsonl"
    with RunLogger(tmp_path) as logger:
        log_two_stages(logger)
    path.write_text(path.read_text() + '{"stage": "train", "ti')
    assert len(RunFolder(tmp_path).metrics()) == 6
    with RunLogger(tmp_path) as logger:
        logger.log("train", 40, {})
    assert [row["ticks"] for row in RunFolder(tmp_path).metrics()] == [10, 20, 30, 10, 20, 30, 40]


def test_an_animation_is_an_image_that_plays(tmp_path):
    frames = np.zeros((3, 32, 48, 3), np.uint8)
    frames[1:] = 250
    with RunLogger(tmp_path) as logger:
        logger.log("train", 8, {"return": 1.0})
        logger.show("video", 64, frames, dt=0.2)
    image = read_images(tmp_path)["video", 64]
    assert (image.height, image.width, image.colorspace) == (32, 48, 3) and len(read_images(tmp_path)) == 1
    with Image.open(io.BytesIO(image.encoded_image_string)) as gif:
        assert gif.format == "GIF" and gif.size == (48, 32) and gif.info["duration"] == 200 and gif.n_frames > 1
    assert read_events(tmp_path) == {("train/return", 8): 1.0}
