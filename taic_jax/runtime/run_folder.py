"""The folder of a run: its files, its config, and its lock."""

import contextlib
import json
import shutil
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NotRequired, TypedDict

import filelock

from taic_jax.config import COLLECT, Config, walk
from taic_jax.config.files import load_config, to_yaml
from taic_jax.runtime.files import PARTIAL, SaveError, remove_partial, save_text, writes_here, writing
from taic_jax.runtime.hosts import agree

LOCK = ".lock"  # file of a run's folder that the process writing there locks


class Statistics(TypedDict):
    """A quantity over seeds, by `statistics.summarize`; None stands for a number that is not finite."""

    per_seed: list[float | None]
    mean: float | None
    iqm: float | None
    ci95: list[float | None]


class Returns(Statistics):
    """Returns after training, and those before it per seed."""

    first_per_seed: list[float | None]


class Durations(Statistics):
    """Mean ticks of an option, and the share of each duration 1..L."""

    histogram: list[float | None]


# The evaluation of one method.
Method = TypedDict(
    "Method",
    {"return": Returns, "return_mean_option": Returns, "duration": Durations, "metrics": dict[str, Statistics]},
)


class Summary(TypedDict):
    """The contents of summary.json."""

    ticks: int
    ticks_per_second: float | None
    seconds: dict[str, float]
    stopped: dict[str, dict[str, dict[str, Any]]]  # stage -> seed -> quantity, after
    methods: dict[str, Method]
    options: NotRequired[dict[str, Statistics]]  # measures of options that were learnt from data alone
    versions: dict[str, str | None]
    commit: str | None


# A row of metrics.jsonl: `stage`, `ticks` or `steps`, `time`, and each metric, a number or a list over seeds.
Row = dict[str, Any]


class RunFolderError(ValueError):
    """A run folder that does not fit the request."""


class BusyError(RunFolderError):
    """A run folder that another process writes."""


def _goes_on(name: str, old: Any, new: Any) -> bool:
    """Return whether a run goes on with another value: evaluation does not change it, and it may train for longer."""
    return new == old or name.startswith("evaluate.") or (name == "train.ticks" and new > old)


class RunFolder:
    """The files of one run, by name, and their one reader."""

    def __init__(self, path: Path):
        self.path = path
        self.config_path = path / "config.yaml"  # the resolved config, written before anything else
        self.metrics_path = path / "metrics.jsonl"  # a row per logged iteration
        self.summary_path = path / "summary.json"  # the results, written when all stages are done
        self.clock_path = path / "clock.json"  # seconds so far

    @property
    def begun(self) -> bool:
        """Whether a run has begun here."""
        return self.config_path.is_file()

    @property
    def finished(self) -> bool:
        """Whether the run has ended."""
        return self.summary_path.is_file()

    def config(self) -> Config:
        """Read the config, or raise ConfigError if it is of another version, or none."""
        return load_config(self.config_path)

    def summary(self) -> Summary:
        """Read the results of a finished run."""
        return json.loads(self.summary_path.read_text())

    def metrics(self, stage: str | None = None) -> list[Row]:
        """Read the rows of one stage, or of all, without an incomplete last one; none before the first is written."""
        if not self.metrics_path.is_file():
            return []
        lines = self.metrics_path.read_text().splitlines(keepends=True)
        rows = [json.loads(line) for line in lines if line.endswith("\n")]
        return [row for row in rows if stage in (None, row["stage"])]

    @property
    def _is_used(self) -> bool:
        """Whether the path holds more than an empty folder, or the traces of a process killed at its very start."""
        if not self.path.is_dir():
            return self.path.exists()
        return any(path.suffix != PARTIAL and path.name != LOCK for path in self.path.iterdir())

    def check(self, config: Config, *, resume: bool = False, overwrite: bool = False) -> None:
        """Check, without a change, that a run can begin or resume in the folder, or raise RunFolderError."""
        if resume:
            if not self.begun:
                raise RunFolderError(f"{self.path} holds no run to resume: no config.yaml in it")
            old = dict(walk(self.config()))  # with the defaults of fields newer than the run
            differing = [f"{name}: {value}" for name, value in walk(config) if not _goes_on(name, old[name], value)]
            if differing:
                raise RunFolderError(f"{self.path} was run with another config, differing in {differing[:1]}")
        elif self._is_used:
            if not overwrite:
                raise RunFolderError(f"{self.path} already holds files; add --resume, --overwrite or another --run-dir")
            if not self.begun:
                why = "is not a run's folder (no config.yaml in it)"
                raise RunFolderError(f"{self.path} {why}, so it is not overwritten")
            for name in {config.options.source, *config.options.experience} - {"", COLLECT}:
                if Path(name).resolve().is_relative_to(self.path.resolve()):
                    why = f"holds what this run starts from, {name}"
                    raise RunFolderError(f"{self.path} {why}, so it is not overwritten")

    def reopen(self, config: Config) -> None:
        """Go on with a run under a config that `check` allows; with another one the run is not finished any more."""
        if writes_here() and self.config() != config:
            self.summary_path.unlink(missing_ok=True)
            save_text(self.config_path, to_yaml(config))

    def prepare(self, config: Config, *, resume: bool = False, overwrite: bool = False) -> None:
        """Make or check the folder, on the first host for all, or raise RunFolderError on every host."""
        checksum = zlib.crc32(to_yaml(config).encode()) >> 1  # a number of 31 bits
        if agree([checksum]) != agree([checksum], least=True):
            raise RunFolderError("--hosts: expected the same config on every host, got different ones")
        refusal = None
        if writes_here():
            try:
                self.check(config, resume=resume, overwrite=overwrite)
                if not resume:
                    self._begin(config)
            except RunFolderError as error:
                refusal = error
        if any(agree([refusal is not None])):
            raise refusal or RunFolderError(f"{self.path} cannot be used, as the first host tells")

    def _begin(self, config: Config) -> None:
        if self._is_used:
            with self.claimed():
                for path in self.path.iterdir():
                    if path.name != LOCK:
                        shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
        try:
            with writing(self.path):
                self.path.mkdir(parents=True, exist_ok=True)
            save_text(self.config_path, to_yaml(config))
        except SaveError as error:
            raise RunFolderError(f"{error}; nothing was begun") from None

    @contextlib.contextmanager
    def claimed(self) -> Iterator[None]:
        """Lock the folder in the context, and remove the incomplete files of killed processes.

        The system unlocks it at any end of this process. Raise BusyError if it is locked, or RunFolderError.
        """
        if not writes_here():
            yield
            return
        try:
            lock = filelock.FileLock(self.path / LOCK).acquire(blocking=False)
        except filelock.Timeout:
            raise BusyError(f"{self.path} is being written by another process; wait for its end") from None
        except OSError as error:
            raise RunFolderError(f"{self.path} cannot be written: {error.strerror}") from None
        with lock:
            remove_partial(self.path)
            yield
