"""What the command lines share: a config by name, its fields as options, and answers in one line.

Arguments are parsed and checked before JAX is imported, so that help and mistakes answer at once.
"""

import contextlib
import dataclasses
import errno
import io
import itertools
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_type_hints

import tyro

from taic_jax import __version__
from taic_jax.config import Config, ConfigError, Shard, walk
from taic_jax.config_io import as_integer, load_config, mistyped, nearest, preset_names
from taic_jax.runtime.files import SaveError
from taic_jax.runtime.signals import DivergedError, Interrupted, Signals
from taic_jax.validation import validate

DEFAULT_PRESET = "nav2d"
FAILED, UNWRITTEN = 1, 74  # 74 is the system's "input/output error"
EXIT_CODES: dict[int, int] = {signal.SIGINT: 130, signal.SIGTERM: 75}


@dataclass(frozen=True)
class Command:
    """What every command takes."""

    source: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="CONFIG")] = DEFAULT_PRESET
    """Name of a preset, or path of a YAML file; with --resume by default the run's own."""
    run_dir: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder of the run; by default runs/CONFIG-DATE-TIME."""
    resume: tyro.conf.FlagCreatePairsOff[bool] = False
    """Continue the run in --run-dir from its last checkpoint."""
    overwrite: tyro.conf.FlagCreatePairsOff[bool] = False
    """Replace the run in --run-dir."""
    dry_run: tyro.conf.FlagCreatePairsOff[bool] = False
    """Refuse what the run would refuse, print the configuration and the plan, and stop."""
    quiet: tyro.conf.FlagCreatePairsOff[bool] = False
    """Show neither progress nor the table at the end, only the path of what was written."""
    version: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print the version and stop."""
    checkpoint_seconds: float = 30.0
    """Least seconds between two checkpoints of a stage; 0 makes one every iteration."""
    shard: Shard = "auto"
    """Split over devices (accelerators, or the cores of a CPU): the seeds of all points, or the environments of each
    seed; auto splits the seeds where there are several."""
    options: Annotated[str, tyro.conf.arg(metavar="RUN")] = ""
    """Run or artifact whose option model is used as it is; short for --options.source."""
    config: Annotated[Config, tyro.conf.arg(name=""), tyro.conf.FlagConversionOff] = Config()

    @property
    def folder(self) -> Path:
        """Where to run."""
        return self.run_dir or Path("runs") / f"{Path(self.source).stem}-{time.strftime('%Y%m%d-%H%M%S')}"


_INTEGERS = tyro.constructors.ConstructorRegistry()


@_INTEGERS.primitive_rule
def _integer(info: tyro.constructors.PrimitiveTypeInfo) -> tyro.constructors.PrimitiveConstructorSpec | None:
    """Read integers as Python does, and 1e6 as well."""
    if info.type is not int:
        return None

    def read(texts: list[str]) -> int:
        number = as_integer(texts[0])
        return int(texts[0]) if number is None else number

    return tyro.constructors.PrimitiveConstructorSpec(1, "INT", read, lambda x: isinstance(x, int), lambda x: [str(x)])


C = TypeVar("C", bound=Command)
K = TypeVar("K")


def answer(args: Sequence[str] | None, program: str, kind: type[C], execute: Callable[[C], int]) -> int:
    """Run one command and return its exit code: what `execute` returns, or 2 for a mistake of the user.

    Args:
      args: what was typed; None takes the process's own.
      program: how it is called.
      kind: what it takes.
      execute: does it.
    """
    args = sys.argv[1:] if args is None else args
    if "--version" in args:
        return tell(lambda: print(f"taic_jax {__version__}"))
    return tell(lambda: execute(parse(args, program, kind)))


def tell(work: Callable[[], int | None]) -> int:
    """Return the exit code of `work`, None being 0, or 2 after one line that tells what mistake the user made."""
    try:
        code = work() or 0
        sys.stdout.flush()  # at the end of the process a reader that has gone would be an error
        return code
    except KeyboardInterrupt:
        print("taic_jax: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader, such as head, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (ValueError, OSError) as error:
        if not _is_mistake(error):
            raise
        print("taic_jax: error:", " ".join(str(error).split()), file=sys.stderr)
        return 2
    return 0


def attempt(work: Callable[[Signals], object], run_dir: Path) -> int:
    """Do the work of a run, which may be told to stop, and return the exit code.

    It is 0 at its end; a run that was told to stop and saved what it had done gives 130 after SIGINT (Ctrl-C) and 75,
    the system's "try again", after SIGTERM; one whose every seed diverged gives 1; one that could not write gives 74.
    """
    try:
        with Signals() as signals:
            work(signals)
    except (Interrupted, KeyboardInterrupt) as stop:
        received = stop.received if isinstance(stop, Interrupted) else signal.SIGINT
        name = signal.Signals(received).name
        print(f"taic_jax: stopped by {name}; --resume --run-dir {run_dir} goes on", file=sys.stderr)
        return EXIT_CODES[received]
    except DivergedError as error:
        print(f"taic_jax: error: {error}", file=sys.stderr)
        return FAILED
    except OSError as error:
        if not isinstance(error, SaveError) and error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            raise
        told = " ".join(str(error).split())
        goes_on = f"what was saved is whole: make room, then --resume --run-dir {run_dir} goes on"
        print(f"taic_jax: error: {told}; {goes_on}", file=sys.stderr)
        return UNWRITTEN
    return 0


def parse(args: Sequence[str], program: str, kind: type[C]) -> C:
    """Parse and check the arguments; the fields start from the preset or file that they name.

    Raises:
        ConfigError: an argument, the named preset or file, or a value is not valid.
    """
    first = args[0] if args and not args[0].startswith("-") else DEFAULT_PRESET
    command = _parse_over(args, program, kind, first)
    if command.resume and command.overwrite:
        raise ConfigError("--resume and --overwrite: expected at most one of the two")
    if command.resume and command.run_dir is None:
        raise ConfigError("--resume: expected the folder of the run to continue, as in --run-dir DIR")
    if command.run_dir and command.resume and command.source not in args:
        own = command.run_dir / "config.yaml"
        command = _parse_over(args, program, kind, str(own)) if own.is_file() else command
    elif command.source != first:
        command = _parse_over(args, program, kind, command.source)
    if not command.checkpoint_seconds >= 0:
        raise ConfigError(f"--checkpoint-seconds: expected at least 0, got {command.checkpoint_seconds}")
    if command.options:
        options = dataclasses.replace(command.config.options, source=command.options)
        command = dataclasses.replace(command, config=dataclasses.replace(command.config, options=options))
    validate(command.config)
    return command


def _parse_over(args: Sequence[str], program: str, kind: type[C], source: str) -> C:
    default = kind(source=source, config=load_config(source))
    description = f"{kind.__doc__}\n\nPresets: {', '.join(preset_names())}."
    return typed(args, program, kind, description, default=default)


def typed(args: Sequence[str], program: str, kind: type[K], description: str | None = None, **settings: Any) -> K:
    """Parse arguments into `kind`, a dataclass whose fields all have defaults; `settings` are for tyro.

    Raises:
      ConfigError: one is not valid.
    """
    if "-h" in args or "--help" in args:  # alone, or tyro leaves the arguments before it out of the help
        args = ["--help"]
    try:
        with contextlib.redirect_stderr(io.StringIO()), _INTEGERS:
            return tyro.cli(kind, prog=program, description=description, args=args, **settings)
    except SystemExit as stop:
        if not stop.code:
            raise
    raise _explain(args, kind)


def _explain(args: Sequence[str], command: type) -> ConfigError:
    """Find the argument that tyro refused, by parsing each option alone, and tell it in one line."""
    hints = get_type_hints(command)
    if hints.get("config") is Config:
        hints |= {name: _kind(name) for name, _ in walk(Config())}
    known = {name: kind for name, kind in hints.items() if name not in ("source", "config", "runs")}
    for option, values in _options(args):
        name = option.lstrip("-").replace("-", "_")
        if name not in known or option.endswith("-"):  # tyro keeps the underscore at the end of lambda_
            return ConfigError(f"unknown option {option}{nearest(name, known, '--') or '; --help lists them'}")
        try:
            with contextlib.redirect_stderr(io.StringIO()), _INTEGERS:
                tyro.cli(command, args=[option, *values])
        except SystemExit:
            return mistyped(option, known[name], " ".join(values) or None)
    expected = "one CONFIG and options" if "source" in hints else "options"
    return ConfigError(f"unexpected argument in {' '.join(args)!r}; expected {expected}, see --help")


def _options(args: Sequence[str]) -> Iterator[tuple[str, list[str]]]:
    """Yield each option with the values that follow it."""
    starts = [i for i, arg in enumerate(args) if arg.startswith("-") and not _is_number(arg)]
    for start, end in itertools.pairwise([*starts, len(args)]):
        option, equals, value = args[start].partition("=")
        yield option, [value] * bool(equals) + list(args[start + 1 : end])


def _kind(name: str) -> Any:
    """Return the type of the field with this dotted name."""
    kind: Any = Config
    for part in name.split("."):
        kind = get_type_hints(kind)[part]
    return kind


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _is_mistake(error: ValueError | OSError) -> bool:
    """Tell a mistake of the user (our own errors, files that cannot be used) from one of the program."""
    ours = type(error).__module__.partition(".")[0] == "taic_jax"
    return ours or (isinstance(error, OSError) and error.filename is not None)
