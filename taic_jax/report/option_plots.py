"""The option space of a run, for a picture: codes on two principal components, and the changes they cause."""

import contextlib
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from taic_jax.analysis.option_space import encode_windows
from taic_jax.artifacts.experience import gather_experience
from taic_jax.artifacts.models import load_options, options_folder, read_body
from taic_jax.config import COLLECT, ConfigError, OptionsConfig
from taic_jax.options.model import OptionModel
from taic_jax.report.runs import LoadedRun, run_of
from taic_jax.runtime.checkpoint import ArtifactError
from taic_jax.runtime.files import json_safe
from taic_jax.types import as_arrays


def option_plot(run: LoadedRun, count: int) -> dict[str, Any]:
    """Return the picture of the first seed's option model, ready for JSON, or the reason against one.

    The options are the means of q(o|a) over windows of the model's experience, coloured by the change of state in these
    windows. Without experience they are drawn from the prior, coloured by the change that P predicts from the mean
    state. R^2 is the share of each coordinate's change that is linear in the plane. A count of 0 omits the picture.
    """
    if not count:
        return {"missing": "left out by --options 0"}
    if run.config is None:
        return {"missing": "the config is of another version"}
    if run.point:
        return {"missing": "option spaces of a sweep's points are not drawn"}
    folder = options_folder(run.config.options.source or run.folder)
    if folder == run.folder:
        return {"missing": "options are not learnt yet"}
    home, config = _origin(run.folder, run.config.options)
    try:
        body = read_body(folder)
        models = load_options(folder, body, config, 1)
    except ArtifactError as error:
        return {"missing": str(error)}
    model = jax.tree.map(lambda x: x[0], models)
    try:
        sources = [home if name == COLLECT else Path(name) for name in config.experience or (COLLECT,)]
        columns = [jax.tree.map(lambda x: x[0], gather_experience(source, body, 1, config)) for source in sources]
        windows = jax.device_get(encode_windows(as_arrays(config), model, columns, jax.random.key(0), count))
        option, change, drawn, why = windows.mean, windows.end - windows.start, "windows", ""
    except (ArtifactError, OSError) as error:
        option, change = _prior_codes(config, model, count)
        drawn, why = "prior", f"what they were learnt from is not there: {error}"
    plane, shares = principal_plane(option)
    r2 = [_r2(plane, column) for column in change.T]
    picture = json_safe({"shares": shares, "changes": change.T, "r2": r2}, 3) | {"size": option.shape[1]}
    return picture | json_safe({"x": plane[:, 0], "y": plane[:, 1]}, 4) | {"drawn": drawn, "why": why}


def _origin(folder: Path, config: OptionsConfig) -> tuple[Path, OptionsConfig]:
    """Return the run whose experience the options of a run were learnt from, and the config of that learning."""
    if not config.source:
        return folder, config
    home = run_of(config.source)
    with contextlib.suppress(ConfigError):
        config = home.config().options
    return home.path, config


def _prior_codes(config: OptionsConfig, model: OptionModel, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return codes [N, D] drawn from the prior and the changes [N, P] that P predicts from the mean state."""
    option = jax.random.normal(jax.random.key(0), (count, config.size))
    predict = partial(model.predict, jnp.zeros(model.state_size))
    change = np.asarray(jax.vmap(predict)(option)) * np.asarray(model.change_scale.std)
    change = (change + np.asarray(model.change_scale.mean))[:, : model.state_size]  # without the way
    return np.asarray(option), change


def principal_plane(option: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return codes [N, D] on two principal components [N, 2], of positive largest weight, and shares of variance."""
    centred = option - option.mean(axis=0)
    _, scales, axes = np.linalg.svd(centred, full_matrices=False)
    axes = axes * np.sign(axes[np.arange(len(axes)), np.abs(axes).argmax(axis=1)])[:, None]
    plane, shares = centred @ axes[:2].T, scales**2 / max((scales**2).sum(), np.finfo(float).tiny)
    missing = max(2 - plane.shape[1], 0)  # codes of one dimension get zeros as the second
    return np.pad(plane, ((0, 0), (0, missing))), np.pad(shares[:2], (0, missing))


def _r2(plane: np.ndarray, change: np.ndarray) -> float:
    """Return the share of a coordinate's change that is linear in the plane; NaN for a constant one."""
    total = ((change - change.mean()) ** 2).sum()
    if total < 1e-12 * len(change):
        return float("nan")
    inputs = np.column_stack([plane, np.ones(len(plane))])
    residual = change - inputs @ np.linalg.lstsq(inputs, change, rcond=None)[0]
    return float(1 - (residual**2).sum() / total)
