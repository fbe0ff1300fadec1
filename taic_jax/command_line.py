"""The common part of the command lines: a config by name, its fields as options, and errors in one line.

Arguments are parsed and checked before JAX is imported, so that help and mistakes answer at once.
"""

import ast
import contextlib
import dataclasses
import errno
import inspect
import io
import itertools
import os
import re
import signal
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro

from taic_jax import __version__
from taic_jax.config import Config, ConfigError, Shard, Track, field_types, impossible, replace, walk
from taic_jax.config.checks import validate
from taic_jax.config.files import as_integer, load_config, mistyped, nearest, preset_names
from taic_jax.runtime.files import SaveError
from taic_jax.runtime.signals import DivergedError, Interrupted, Signals

DEFAULT_PRESET = "nav2d"
HELP_ALL = "--help-all"
COMMON_FIELDS = (
    "env.name", "env.backend", "env.model", "env.goal", "collect.env", "collect.ticks", "options.experience",
    "options.length", "options.size", "options.decoder", "options.termination", "options.delta", "options.steps",
    "collect.learner", "train.learner", "train.ticks", "train.baselines", "train.ppo.num_envs",
    "train.ppo.learning_rate", "train.ppo.gamma", "train.fine_tune.epochs", "evaluate.episodes", "seed", "seeds",
)  # fmt: skip
"""The fields of the config that --help shows; --help-all shows all."""
FAILED, UNWRITTEN = 1, 74  # 74 is the system's "input/output error"
EXIT_CODES: dict[int, int] = {signal.SIGINT: 130, signal.SIGTERM: 75}  # 75 is the system's "try again"
C = TypeVar("C", bound="Command")
K = TypeVar("K")


@dataclass(frozen=True)
class Command:
    """The options of every command."""

    source: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="CONFIG")] = DEFAULT_PRESET
    """Name of a preset, or path of a YAML file; with --resume by default the run's own."""
    run_dir: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder of the run; by default runs/CONFIG-DATE-TIME."""
    resume: tyro.conf.FlagCreatePairsOff[bool] = False
    """Continue the run in --run-dir from its last checkpoint."""
    overwrite: tyro.conf.FlagCreatePairsOff[bool] = False
    """Replace the run in --run-dir."""
    dry_run: tyro.conf.FlagCreatePairsOff[bool] = False
    """Check all that the run would refuse, print the plan, with minutes by first steps unless --quiet, and stop."""
    quiet: tyro.conf.FlagCreatePairsOff[bool] = False
    """Show neither progress nor the table at the end, only the path of the results."""
    track: Track = "none"
    """Experiment tracker to send metrics and config to; an extra of the same name installs it."""
    version: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print the version and stop."""
    checkpoint_seconds: float = 30.0
    """Least seconds between two checkpoints of a stage, more if they are large; 0 writes one every iteration."""
    shard: Shard = "auto"
    """Split over devices (accelerators, or the cores of a CPU): the seeds of all points, or the environments of each
    seed; auto splits the seeds where there are several."""
    options: Annotated[str, tyro.conf.arg(metavar="RUN")] = ""
    """Run or artifact whose option model is used; short for --options.source."""
    init: Annotated[str, tyro.conf.arg(metavar="RUN")] = ""
    """Run whose policy over options is trained further; short for --train.init and --options.source."""
    config: Annotated[Config, tyro.conf.arg(name=""), tyro.conf.FlagConversionOff] = Config()

    @property
    def folder(self) -> Path:
        """The run's folder."""
        return self.run_dir or Path("runs") / f"{Path(self.source).stem}-{time.strftime('%Y%m%d-%H%M%S')}"


_INTEGERS = tyro.constructors.ConstructorRegistry()


@_INTEGERS.primitive_rule
def _integer(info: tyro.constructors.PrimitiveTypeInfo) -> tyro.constructors.PrimitiveConstructorSpec | None:
    """Read integers as Python does, and 1e6 as well."""
    if info.type is not int:
        return None

    def read(texts: list[str]) -> int:
        return as_integer(texts[0]) if "e" in texts[0].lower() else int(texts[0])

    return tyro.constructors.PrimitiveConstructorSpec(1, "INT", read, lambda x: isinstance(x, int), lambda x: [str(x)])


def answer(args: Sequence[str] | None, program: str, kind: type[C], execute: Callable[[C], int]) -> int:
    """Parse the arguments, by default the process's own, execute them, and return the exit code: 2 for a mistake."""
    args = sys.argv[1:] if args is None else args
    if "--version" in args:
        return tell(lambda: print(f"taic_jax {__version__}"))
    return tell(lambda: execute(parse(args, program, kind)))


def tell(work: Callable[[], int | None]) -> int:
    """Return the exit code of `work`, None being 0, or 2 after one line that names the user's mistake."""
    try:
        code = work() or 0
        sys.stdout.flush()  # here, since a closed pipe at the end of the process would be an error
        return code
    except KeyboardInterrupt:
        print("taic_jax: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:  # a reader such as head has closed the pipe
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except (ValueError, OSError, RuntimeError) as error:
        # JAX raises an error of its own for one that an environment on the host raised in a program.
        _, from_host, reason = str(error).partition("AdapterError: ")
        ours = from_host or type(error).__module__.partition(".")[0] == "taic_jax"
        if not ours and getattr(error, "filename", None) is None:  # not about a file either: a bug
            raise
        return _fail(2, reason or str(error))


def attempt(work: Callable[[Signals], object], run_dir: Path) -> int:
    """Do the work of a run and return its exit code: 0, FAILED if every seed diverged, UNWRITTEN if a write failed, or
    one of EXIT_CODES if a signal stopped it after a checkpoint."""
    try:
        with Signals() as signals:
            work(signals)
    except (Interrupted, KeyboardInterrupt) as stop:
        received = signal.Signals(stop.received if isinstance(stop, Interrupted) else signal.SIGINT)
        print(f"taic_jax: stopped by {received.name}; --resume --run-dir {run_dir} goes on", file=sys.stderr)
        return EXIT_CODES[received]
    except DivergedError as error:
        return _fail(FAILED, str(error))
    except OSError as error:
        if not isinstance(error, SaveError) and error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            raise
        remedy = f"what was saved is whole: make room, then --resume --run-dir {run_dir} goes on"
        return _fail(UNWRITTEN, f"{error}; {remedy}")
    return 0


def _fail(code: int, message: str) -> int:
    print("taic_jax: error:", " ".join(message.split()), file=sys.stderr)
    return code


def parse(args: Sequence[str], program: str, kind: type[C]) -> C:
    """Parse and check the arguments, over the preset or file that they name; raise `ConfigError` at a mistake."""

    if {"-h", "--help"} & set(args):
        print(short_help(program, kind))
        raise SystemExit(0)

    def parse_over(source: str) -> C:
        description = f"{kind.__doc__}\n\nPresets: {', '.join(preset_names())}."
        return typed(args, program, kind, description, default=kind(source=source, config=load_config(source)))

    first = args[0] if args and not args[0].startswith("-") else DEFAULT_PRESET
    command = parse_over(first)
    source = command.source
    if command.resume and command.overwrite:
        raise ConfigError("--resume and --overwrite: expected at most one of the two")
    if command.resume and command.run_dir is None:
        raise ConfigError("--resume: expected the folder of the run to continue, as in --run-dir DIR")
    if command.run_dir and command.resume and source not in args:
        from taic_jax.runtime.run_folder import RunFolder  # it imports JAX

        folder = RunFolder(command.run_dir)
        source = str(folder.config_path) if folder.begun else source
    if source != first:
        command = parse_over(source)
    if not command.checkpoint_seconds >= 0:
        raise impossible("--checkpoint-seconds", command.checkpoint_seconds, "at least 0")
    if command.init:
        command = replace(command, "config.train.init", command.init)
    if source := command.init or command.options:
        command = replace(command, "config.options.source", source)
    validate(command.config)
    return command


def short_help(program: str, kind: type[Command]) -> str:
    """Return the usage, the command's own options, and those of COMMON_FIELDS, each with its default."""
    lines, defaults = [f"usage: {program} [CONFIG] [OPTIONS]", "", kind.__doc__ or "", ""], dict(walk(kind()))
    own = [field.name for field in dataclasses.fields(kind) if field.name not in ("source", "config")]
    for name in [*own, *(f"config.{name}" for name in COMMON_FIELDS)]:
        group, _, field = name.rpartition(".")
        owner = type(attrgetter(group)(kind()) if group else kind())
        default, option = defaults[name], f"--{name.removeprefix('config.')}".replace("_", "-")
        default = ", ".join(default) if isinstance(default, tuple) else default
        value = "" if default in (False, "", None) else f" ({default})"
        purpose = re.split(r"[;:.](?=\s|$)", " ".join(_documented(owner)[field].split()))[0]
        lines.append(f"  {option:26} {purpose}{value}")
    return "\n".join([*lines, "", f"{program} {HELP_ALL} shows every field; presets: {', '.join(preset_names())}."])


def _documented(group: type) -> dict[str, str]:
    """Return the text below each field of a dataclass, also of those that it inherits."""
    texts = {}
    for cls in reversed(group.__mro__[:-1]):
        body: Any = ast.parse(inspect.getsource(cls)).body[0]
        for field, text in itertools.pairwise(body.body):
            if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
                texts[ast.unparse(field.target)] = ast.literal_eval(text.value)
    return texts


def typed(args: Sequence[str], program: str, kind: type[K], description: str | None = None, **settings: Any) -> K:
    """Parse into `kind`, a dataclass with defaults; raise `ConfigError` at a mistake. `settings` are for tyro."""
    if {"-h", "--help", HELP_ALL} & set(args):  # alone, or tyro leaves the arguments before it out of the help
        args = ["--help"]
    try:
        with contextlib.redirect_stderr(io.StringIO()), _INTEGERS:
            return tyro.cli(kind, prog=program, description=description, args=args, **settings)
    except SystemExit as stop:
        if not stop.code:
            raise
    raise _explain(args, kind)


def _explain(args: Sequence[str], command: type) -> ConfigError:
    """Return the error for the argument that tyro refused, by parsing each option alone."""
    types = {name.removeprefix("config."): kind for name, kind in field_types(command).items()}
    configured = types.pop("source", None)
    for positional in ("runs", "data"):
        types.pop(positional, None)
    starts = [i for i, arg in enumerate(args) if re.match(r"-(?!inf|nan|[\d.])", arg, re.IGNORECASE)]
    for start, end in itertools.pairwise([*starts, len(args)]):
        option, equals, value = args[start].partition("=")
        values = [value] * bool(equals) + list(args[start + 1 : end])
        name = option.lstrip("-").replace("-", "_")
        if name not in types or option.endswith("-"):  # tyro keeps the underscore at the end of lambda_
            return ConfigError(f"unknown option {option}{nearest(name, types, '--') or '; --help lists them'}")
        try:
            with contextlib.redirect_stderr(io.StringIO()), _INTEGERS:
                tyro.cli(command, args=[option, *values])
        except SystemExit:
            return mistyped(option, types[name], " ".join(values) or None)
    expected = "one CONFIG and options" if configured else "options"
    return ConfigError(f"unexpected argument in {' '.join(args)!r}; expected {expected}, see --help")
