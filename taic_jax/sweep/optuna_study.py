"""Points that Optuna asks for, with its journal on disk."""

import math
from pathlib import Path
from typing import Any

from taic_jax.envs.errors import MissingExtraError
from taic_jax.sweep.axes import Axis

try:
    import optuna
    from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution
    from optuna.storages.journal import JournalFileBackend
except ImportError:
    raise MissingExtraError("optuna", "sweep") from None

JOURNAL = "optuna.log"


class Study:
    """Ask for points and tell how they did, the higher the better.

    Args:
      axes: where points lie.
      run_dir: folder of the journal; a study that is in it goes on.
      seed: of the sampler.
    """

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
        # A point of a batch is asked for before the others' results are known: the liar keeps them apart.
        sampler = optuna.samplers.TPESampler(seed=seed, constant_liar=True)
        self._study = optuna.create_study(
            storage=storage, study_name="sweep", direction="maximize", sampler=sampler, load_if_exists=True
        )

    def ask(self, count: int) -> tuple[list[int], list[dict[str, Any]]]:
        """Return the numbers of so many trials, and their points."""
        trials = [self._study.ask(self._space) for _ in range(count)]
        points = [
            {name: self._values.get(name, {}).get(value, value) for name, value in trial.params.items()}
            for trial in trials
        ]
        return [trial.number for trial in trials], points

    def tell(self, trial: int, value: float) -> None:
        """Tell how a trial did, unless that was told before; what diverged failed."""
        if self._study.trials[trial].state.is_finished():
            return
        if math.isfinite(value):
            self._study.tell(trial, value)
        else:
            self._study.tell(trial, state=optuna.trial.TrialState.FAIL)
