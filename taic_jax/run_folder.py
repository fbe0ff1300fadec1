"""The folder of a run: whose it is, and that nobody else writes in it."""

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path

from taic_jax.checkpoint import PARTIAL, save_text
from taic_jax.config import COLLECT, Config, walk
from taic_jax.config_io import load_config, to_yaml

try:
    import fcntl
except ImportError:  # Windows has none, and no other lock that a killed process gives back
    fcntl = None


class RunFolderError(ValueError):
    """The run folder cannot be used as asked."""


class BusyError(RunFolderError):
    """Another process is at the run folder."""


def prepare_folder(config: Config, run_dir: Path, *, resume: bool = False, overwrite: bool = False) -> None:
    """Make the run folder, or check that it is the one to resume.

    Raises:
      RunFolderError: the folder holds another run, or none where one is to be resumed.
    """
    saved, text = run_dir / "config.yaml", to_yaml(config)
    if resume:
        if not saved.is_file():
            raise RunFolderError(f"{run_dir} holds no run to resume: no config.yaml in it")
        old = dict(walk(load_config(str(saved))))  # a field that is newer than the run has its default there
        differing = [f"{name}: {value}" for name, value in walk(config) if old[name] != value]
        if differing:
            raise RunFolderError(f"{run_dir} was run with another config, differing in {differing[:1]}")
        return
    if run_dir.exists() and (not run_dir.is_dir() or _holds_files(run_dir)):
        if not overwrite:
            raise RunFolderError(f"{run_dir} already holds files; add --resume, --overwrite or another --run-dir")
        if not saved.is_file():
            raise RunFolderError(f"{run_dir} is not a run's folder (no config.yaml in it), so it is not overwritten")
        for name in {config.options.source, *config.options.experience} - {"", COLLECT}:
            if Path(name).resolve().is_relative_to(run_dir.resolve()):
                raise RunFolderError(f"{run_dir} holds what this run starts from, {name}, so it is not overwritten")
        with claimed(run_dir):
            shutil.rmtree(run_dir)
    run_dir.mkdir(parents=True, exist_ok=True)
    save_text(saved, text)


@contextlib.contextmanager
def claimed(run_dir: Path) -> Iterator[None]:
    """Keep other processes off a run's folder; the system gives it back when this one ends, however it ends.

    Raises:
      BusyError: another process is at it.
    """
    with (run_dir / "config.yaml").open() as file:
        if fcntl is not None:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise BusyError(f"{run_dir} is being written by another process; wait for its end") from None
        yield


def _holds_files(run_dir: Path) -> bool:
    """Tell whether anything is there but what a process that was killed at its very start leaves."""
    return any(path.suffix != PARTIAL for path in run_dir.iterdir())
