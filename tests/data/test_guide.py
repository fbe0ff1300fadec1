"""The page *skills from your logs* is tested: its blocks run, the log first, and so do its dry runs."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs/skills_from_your_logs.md").read_text()
SMALL = ["--options.steps", "4", "--options.hidden-size", "8", "--options.mlp-sizes", "8", "--quiet"]


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", TEXT, re.MULTILINE | re.DOTALL)


def run(*args: str, cwd: Path) -> None:
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, *args], cwd=cwd, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-1000:] + done.stderr[-3000:]


def test_the_example_runs_as_it_stands(tmp_path):
    use, make = blocks("python")
    (commands,) = blocks("bash")
    run("-c", make, cwd=tmp_path)
    ran = []
    for command in commands.splitlines():
        if command.startswith("taic "):
            name, *args = shlex.split(command)[1:]
            run("-m", "taic_jax", name, *args, *(SMALL if name == "learn" else []), cwd=tmp_path)
            ran.append(name)
    run("-c", use, cwd=tmp_path)
    assert ran == ["learn", "report"] and "Measures of options" in (tmp_path / "report.html").read_text()
