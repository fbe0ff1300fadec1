"""The command `taic` and its sub-commands; `python -m taic_jax` is the same."""

import importlib
import sys
from collections.abc import Sequence

from taic_jax import __version__
from taic_jax.command_line import tell
from taic_jax.config import ConfigError
from taic_jax.config.files import nearest

# A command's module, imported once it is called, and its line in the help.
COMMANDS = {
    "run": ("run", "train: collect, learn options, act by choosing them, evaluate"),
    "learn": ("from_data", "learn options from recorded data alone, without a simulator"),
    "sweep": ("sweep.__main__", "train at many points of the config, several in one program"),
    "play": ("handles.play", "film the agents of a finished run"),
    "evaluate": ("handles.assess", "evaluate them anew: other episodes, tasks, noise"),
    "explore": ("handles.explore", "move through the options of a run in the browser"),
    "export": ("handles.export", "write an agent as StableHLO, ONNX or NumPy's arrays, for other programs"),
    "report": ("report.__main__", "write one HTML page about runs and sweeps"),
    "presets": ("handles.presets", "list the configs that ship with the package"),
    "envs": ("handles.pictures", "draw every task"),
    "completion": ("handles.completion", "print a script that completes this command in bash, zsh or tcsh"),
}
BARE = {"presets": "taic presets", "completion": "taic completion bash|zsh|tcsh"}
"""Commands without options, and their usage."""
HELP = """usage: taic COMMAND ...

{}

taic COMMAND --help lists its options; taic --version prints the version.""".format(
    "\n".join(f"  {name:10} {line}" for name, (_, line) in COMMANDS.items())
)


def main(args: Sequence[str] | None = None) -> int:
    """Run one sub-command and return its exit code: 0, or 2 for a mistake in the arguments."""
    args = sys.argv[1:] if args is None else args
    name, rest = (args[0], args[1:]) if args else ("--help", [])
    if name not in COMMANDS:
        return tell(lambda: _about(name))
    if name in BARE and rest in (["-h"], ["--help"]):
        return tell(lambda: print(f"usage: {BARE[name]}\n\n{COMMANDS[name][1]}"))
    module = importlib.import_module(f"taic_jax.{COMMANDS[name][0]}")
    if name == "completion":
        names = "run", "learn", "sweep", "report"
        later = {x: importlib.import_module(f"taic_jax.{COMMANDS[x][0]}").Command for x in names}
        return tell(lambda: module.complete(rest, COMMANDS, later))
    return module.main(rest)


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
