"""A run's rows, keys and folder: which streams it draws from, and that looking at it changes nothing."""

import time

import jax
import numpy as np
import pytest
from tiny_runs import CONFIG, files_of, with_fields

from taic_jax.nonfinite import FINITE
from taic_jax.runtime.checkpoint import Checkpoints
from taic_jax.runtime.driver import STAGE_STREAMS, Run, drive
from taic_jax.types import as_arrays


def test_streams_of_stages_are_never_renumbered():
    assert STAGE_STREAMS == {
        "collect": 0, "learn": 1, "train": 2, "flat": 3, "evaluate": 4, "video": 5, "repeat": 6, "total": 7,
        "transfer": 8, "practise": 9,
    }  # fmt: skip


def test_seed_k_of_a_run_is_seed_0_of_a_run_whose_seed_is_k_more(tmp_path):
    points = [with_fields(CONFIG, seed=4, options__lambda_adv=value) for value in (0.5, 0.25)]
    with Run.open(points[0], tmp_path, points=points, quiet=True) as run:
        expected = jax.random.fold_in(jax.random.key(5), STAGE_STREAMS["train"])
        for row in (1, 3):
            assert run.stage_keys("train")[row] == expected
        np.testing.assert_array_equal(run.config.options.lambda_adv, np.float32([0.5, 0.5, 0.25, 0.25]))


def test_to_view_a_run_writes_nothing_and_needs_no_claim(tmp_path):
    with Run.open(CONFIG, tmp_path, quiet=True) as run:
        before = files_of(tmp_path)
        with Run.view(CONFIG, tmp_path, as_arrays(CONFIG)) as viewed:
            assert (viewed.stage_keys("learn") == run.stage_keys("learn")).all() and viewed.folder.path == tmp_path
        assert files_of(tmp_path) == before


@pytest.mark.parametrize(("seconds", "expected"), [(0.0, [1, 2, 3, 4]), (1e-6, [1, 4])])
def test_slow_saves_are_seldom_but_for_zero_seconds_which_save_every_step(tmp_path, monkeypatch, seconds, expected):
    save, steps = Checkpoints.save, []

    def slowly(self, step, tree):
        steps.append(step)
        time.sleep(0.5)  # the third step is over before forty times as long
        save(self, step, tree)

    monkeypatch.setattr(Checkpoints, "save", slowly)

    def step(state):
        return state + 1.0, {"nonfinite": jax.numpy.full(2, FINITE)}, None

    with Run.open(CONFIG, tmp_path, quiet=True, checkpoint_seconds=seconds) as run:
        state = drive(run, "train", step, jax.numpy.zeros(2), num_steps=4, unit=1)
    assert steps == expected and (state == 4.0).all()
