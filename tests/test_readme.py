"""The README is tested: its Python blocks run, and so do its commands, as dry runs."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "README.md").read_text()
MODULE = "python -m taic_jax"


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", TEXT, re.MULTILINE | re.DOTALL)


def commands() -> list[str]:
    """Return the lines of the bash blocks that run our modules; a backslash continues a line."""
    lines = "\n".join(blocks("bash")).replace("\\\n", " ").splitlines()
    return [line.strip() for line in lines if line.strip().startswith(MODULE)]


def run(args: list[str], cwd: Path) -> None:
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, *args], cwd=cwd, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-1000:] + done.stderr[-3000:]


def test_there_is_something_to_run():
    assert blocks("python") and commands()


@pytest.mark.timeout(900)
@pytest.mark.parametrize("code", blocks("python"))
def test_python_blocks_run(code, tmp_path):
    (tmp_path / "block.py").write_text(code)
    run(["block.py"], tmp_path)


@pytest.mark.parametrize("command", commands())
def test_commands_are_valid(command, tmp_path):
    args = shlex.split(command, comments=True)[1:]
    if args[1] == "taic_jax.run" and not {"--dry-run", "--help"} & set(args):
        args.append("--dry-run")
    run(args, tmp_path)
    assert not any(tmp_path.iterdir())
