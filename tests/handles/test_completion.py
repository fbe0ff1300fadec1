"""Completion in a shell: the script for bash runs in bash; those for zsh and tcsh hold the same words."""

import shutil
import subprocess

import pytest

from taic_jax.__main__ import COMMANDS, main
from taic_jax.config.files import preset_names

LINES = {
    "": " ".join(COMMANDS),
    "ru": "run",
    "run nav": "nav2d nav2d_change nav2d_dqn",
    "sweep transfer_ant_m": "transfer_ant_maze",
    "run nav2d --train.ppo.learning": "--train.ppo.learning-rate --train.ppo.learning-rate-decay",
    "run nav2d --train.ppo.lam": "--train.ppo.lambda_",
    "play runs/a --ti": "--ticks",
    "evaluate runs/a --epi": "--episodes",
    "report runs/a --no": "--no-videos",
    "envs --con": "--contact-sheet",
    "completion z": "zsh",
    "presets x": "",
}
PROBE = 'source ./script; COMP_WORDS=(taic "$@"); COMP_CWORD=$#; complete -p taic; _taic; echo "${COMPREPLY[*]}"'


@pytest.fixture(scope="module")
def script(tmp_path_factory):
    folder = tmp_path_factory.mktemp("completion")
    code = "import sys; from taic_jax.__main__ import main; sys.exit(main(['completion', 'bash']))"
    done = subprocess.run(["python", "-c", code], capture_output=True, text=True)
    assert done.returncode == 0
    (folder / "script").write_text(done.stdout)
    return folder


@pytest.mark.skipif(not shutil.which("bash"), reason="there is no bash")
@pytest.mark.parametrize("line", LINES)
def test_bash_completes_commands_presets_and_options(script, line):
    *before, word = line.split(" ")
    done = subprocess.run(["bash", "-c", PROBE, "bash", *before, word], cwd=script, capture_output=True, text=True)
    assert done.stderr == "" and done.stdout.splitlines() == ["complete -o default -F _taic taic", LINES[line]]


def test_the_other_shells_have_the_same_words(capsys):
    assert main(["completion", "zsh"]) == main(["completion", "bash"]) == 0
    first, *zsh = capsys.readouterr().out.splitlines()
    assert first == "autoload -U +X bashcompinit && bashcompinit" and zsh[: len(zsh) // 2] == zsh[len(zsh) // 2 :]
    assert main(["completion", "tcsh"]) == 0
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith(f"complete taic 'p/1/({' '.join(COMMANDS)})/' 'c/--/(")
    assert f"'n/run/({' '.join(preset_names())})/'" in line and " train.ppo.lambda_ " in line


MISTAKES = {
    "completion": "expected one of bash, zsh, tcsh, got nothing",
    "completion fish": "expected one of bash, zsh, tcsh, got fish",
    "completion bsh": "got bsh; the nearest is bash",
    "completion bash now": "got bash now",
}


@pytest.mark.parametrize("line", MISTAKES)
def test_another_shell_is_told_in_one_line(line, capsys):
    assert main(line.split()) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1 and MISTAKES[line] in err
