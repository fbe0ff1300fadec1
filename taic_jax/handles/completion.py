"""Completion of `taic` in a shell, its commands, presets and options: `taic completion bash`."""

import re
from collections.abc import Iterable, Sequence

from taic_jax.config import ConfigError, field_types
from taic_jax.config.files import nearest, preset_names
from taic_jax.handles import assess, explore, export, pictures, play

BASH = """_taic() {
  local words
  case $COMP_CWORD:${COMP_WORDS[1]} in
    1:*) words='%s' ;;
    %s
  esac
  COMPREPLY=($(compgen -W "$words" -- "${COMP_WORDS[COMP_CWORD]}"))
}
complete -o default -F _taic taic"""
TCSH = "complete taic 'p/1/(%s)/' 'c/--/(%s)/' 'n/run/(%s)/' 'n/sweep/(%s)/'"
SHELLS = ("bash", "zsh", "tcsh")


def complete(args: Sequence[str], commands: Iterable[str], later: dict[str, type]) -> None:
    """Print the script for a shell, or raise ConfigError for another; `later` has dataclasses of other commands."""
    shell = " ".join(args) or "nothing"
    if shell not in SHELLS:
        raise ConfigError(f"taic completion: expected one of {', '.join(SHELLS)}, got {shell}{nearest(shell, SHELLS)}")
    kinds = later | {"play": play.Command, "evaluate": assess.Command, "envs": pictures.Arguments}
    kinds |= {"explore": explore.Command, "export": export.Command}
    presets, cases, every = " ".join(preset_names()), [], set()
    for name, kind in kinds.items():
        fields = [x.removeprefix("config.") for x in field_types(kind) if x not in ("source", "run", "runs", "data")]
        options = [re.sub("_(?=.)", "-", x) for x in fields]
        every.update(options)
        first = presets if name in ("run", "sweep") else ""
        cases.append(f"*:{name}) words='{first} {' '.join(f'--{x}' for x in options)}' ;;")
    if shell == "tcsh":
        return print(TCSH % (" ".join(commands), " ".join(sorted(every)), presets, presets))
    if shell == "zsh":
        print("autoload -U +X bashcompinit && bashcompinit")
    print(BASH % (" ".join(commands), "\n    ".join([*cases, f"*:completion) words='{' '.join(SHELLS)}' ;;"])))
