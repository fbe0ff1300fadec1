"""Points from Optuna, with its journal on disk."""

import math
from pathlib import Path

from taic_jax.envs.errors import MissingExtraError
from taic_jax.sweep.axes import Axis, Point

try:
    import optuna
    from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution
    from optuna.storages.journal import JournalFileBackend
except ImportError:
    raise MissingExtraError("optuna", "sweep") from None

JOURNAL = "optuna.log"


class Study:
    """A study that suggests points from earlier results, the higher the better, with a journal in `run_dir`."""

    def __init__(self, axes: list[Axis], run_dir: Path, seed: int):
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        self._space: dict[str, BaseDistribution] = {
            axis.name: FloatDistribution(axis.low, axis.high, log=axis.logarithmic)
            if axis.is_range
            else CategoricalDistribution([str(value) for value in axis.values])
            for axis in axes
        }
        self._values = {axis.name: {str(value): value for value in axis.values} for axis in axes if not axis.is_range}
        storage = optuna.storages.JournalStorage(JournalFileBackend(str(run_dir / JOURNAL)))
        # A batch of points is suggested before any of its results: the liar keeps them apart.
        sampler = optuna.samplers.TPESampler(seed=seed, constant_liar=True)
        self._study = optuna.create_study(
            storage=storage, study_name="sweep", direction="maximize", sampler=sampler, load_if_exists=True
        )

    def ask(self, count: int) -> tuple[list[int], list[Point]]:
        """Return the numbers and the points of `count` new trials."""
        trials = [self._study.ask(self._space) for _ in range(count)]
        points = [{name: self._values.get(name, {}).get(x, x) for name, x in trial.params.items()} for trial in trials]
        return [trial.number for trial in trials], points

    def tell(self, trial: int, value: float) -> None:
        """Report the result of a trial, once; one that is not finite counts as failed."""
        failed = None if math.isfinite(value) else optuna.trial.TrialState.FAIL
        self._study.tell(trial, None if failed else value, failed, skip_if_finished=True)
