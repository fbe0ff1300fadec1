"""A run's rows, keys and folder: which streams it draws from, and that looking at it changes nothing."""

import jax
import numpy as np
from tiny_runs import CONFIG, files_of, with_fields

from taic_jax.runtime.driver import STAGE_STREAMS, Run
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
