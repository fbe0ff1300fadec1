"""Actions in other scales: brought to [-1, 1] by bounds or quantiles, and refused where the bounds are wrong."""

import numpy as np
import pytest

from taic_jax.data.read import quantile_bounds, read_data, read_recording
from taic_jax.runtime.checkpoint import ArtifactError


def write(path, action: np.ndarray):
    steps = len(action)
    obs = np.arange(3.0 * steps).reshape(steps, 3)
    np.savez(path, observations=obs, actions=action, rewards=np.ones(steps), terminals=np.arange(steps) == 4)
    return path


def test_bounds_become_one(tmp_path, capsys):
    action = np.array([[-2.0, 10], [2, 30], [0, 20], [1, 25]])
    path = write(tmp_path / "a.npz", action)
    got = read_data(path, bounds=(-2.0, 10.0, 2.0, 30.0)).action[:, 0]
    np.testing.assert_allclose(got, [[-1, -1], [1, 1], [0, 0], [0.5, 0.5]])
    told = capsys.readouterr().err
    assert "2 actions in [-1, 1], scaled to [-1, 1] from stated bounds, 0.00% clipped" in told
    np.testing.assert_allclose(read_data(path, bounds=(-40.0, 40.0)).action[:, 0], action / 40, rtol=1e-6)


def test_few_numbers_beyond_the_bounds_are_clipped_and_many_refused(tmp_path, capsys):
    action = np.zeros((50, 1))
    action[:2] = 3
    assert read_data(write(tmp_path / "a.npz", action), bounds=(-2.0, 2.0)).action.max() == 1
    assert "4.00% clipped" in capsys.readouterr().err
    action[:4] = 3
    with pytest.raises(ArtifactError, match=r"a.npz: actions: expected entry 0 in \[-2, 2\].*got 8% .* beyond, e.g. 3"):
        read_data(write(tmp_path / "a.npz", action), bounds=(-2.0, 2.0))


@pytest.mark.parametrize(
    ("bounds", "message"),
    [
        ((1.0,), r"expected 2 bounds, or 4, 2 lows and then 2 highs, .*got 1"),
        ((-1.0, 1.0, 2.0), "got 3"),
        ((2.0, -2.0), "each lower bound below its upper one"),
        (
            (),
            r"expected actions in \[-1, 1\], got 30; state their --action-bounds LOW HIGH, or scale by --action-scale",
        ),
    ],
)
def test_wrong_bounds_are_refused(tmp_path, bounds, message):
    path = write(tmp_path / "a.npz", np.array([[-2.0, 10], [2, 30]]))
    with pytest.raises(ArtifactError, match="a.npz: actions: .*" + message):
        read_data(path, bounds=bounds)


def test_quantiles_are_those_of_all_data_and_a_constant_entry_becomes_zero(tmp_path):
    halves = [np.linspace(0, 100, 101), np.linspace(100, 400, 301)]
    recordings = [
        read_recording(write(tmp_path / f"{i}.npz", np.stack([half, np.full_like(half, 7)], axis=1)))
        for i, half in enumerate(halves)
    ]
    bounds = quantile_bounds(recordings)
    low, high = np.quantile(np.concatenate(halves), [0.01, 0.99])
    np.testing.assert_allclose(bounds, [low, 6, high, 8], rtol=1e-5)
    scaled = [recording.scaled(bounds).experience.action for recording in recordings]
    np.testing.assert_array_equal(scaled[0][:, 1], 0)
    assert scaled[0].min() == -1 and scaled[1].max() == 1
