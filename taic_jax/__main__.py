"""The command `taic` and its sub-commands; `python -m taic_jax` is the same."""

import sys
from collections.abc import Sequence

from taic_jax import __version__
from taic_jax.command_line import tell
from taic_jax.config import ConfigError
from taic_jax.config_io import nearest

COMMANDS = {
    "run": "train: collect, learn options, act by choosing them, evaluate",
    "sweep": "train at many points of the config, several in one program",
    "play": "film the agents of a finished run",
    "evaluate": "evaluate them anew: other episodes, tasks, noise",
    "explore": "move through the options of a run in the browser",
    "export": "write an agent as StableHLO, ONNX or NumPy's arrays, for other programs",
    "report": "write one HTML page about runs and sweeps",
    "presets": "list the configs that ship with the package",
    "envs": "draw every task",
    "completion": "print a script that completes this command in bash, zsh or tcsh",
}
HELP = """usage: taic COMMAND ...

{}

taic COMMAND --help lists its options; taic --version prints the version.""".format(
    "\n".join(f"  {name:10} {line}" for name, line in COMMANDS.items())
)


def main(args: Sequence[str] | None = None) -> int:
    """Run one sub-command and return its exit code: 0, or 2 for a mistake in the arguments."""
    args = sys.argv[1:] if args is None else args
    name, rest = (args[0], args[1:]) if args else ("--help", [])
    match name:
        case "run":
            from taic_jax.run import main as command
        case "sweep":
            from taic_jax.sweep.__main__ import main as command
        case "play":
            from taic_jax.handles.play import main as command
        case "evaluate":
            from taic_jax.handles.assess import main as command
        case "explore":
            from taic_jax.handles.explore import main as command
        case "export":
            from taic_jax.handles.export import main as command
        case "report":
            from taic_jax.report.__main__ import main as command
        case "presets":
            from taic_jax.handles.presets import main as command
        case "envs":
            from taic_jax.handles.pictures import main as command
        case "completion":
            from taic_jax.handles.completion import complete
            from taic_jax.report.__main__ import Command as Report
            from taic_jax.run import Command as Run
            from taic_jax.sweep.__main__ import Command as Sweep

            return tell(lambda: complete(rest, COMMANDS, {"run": Run, "sweep": Sweep, "report": Report}))
        case _:
            return tell(lambda: _about(name))
    return command(rest)


def _about(name: str) -> None:
    """Print the help or the version, or raise ConfigError at another name."""
    if name in ("-h", "--help"):
        print(HELP)
    elif name == "--version":
        print(f"taic_jax {__version__}")
    else:
        hint = nearest(name, COMMANDS) or f"; there are {', '.join(COMMANDS)}"
        raise ConfigError(f"unknown command {name}{hint}")


if __name__ == "__main__":
    sys.exit(main())
