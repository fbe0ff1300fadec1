"""The README is tested: its Python blocks run, twice in one interpreter, and so do its commands, as dry runs."""

import os
import re
import shlex
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "README.md").read_text()
COMMAND = "taic "


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", TEXT, re.MULTILINE | re.DOTALL)


def commands() -> list[str]:
    """Return the lines of the bash blocks that are our command; a backslash continues a line."""
    lines = "\n".join(blocks("bash")).replace("\\\n", " ").splitlines()
    return [line.strip() for line in lines if line.strip().startswith(COMMAND)]


def run(args: list[str], cwd: Path, code: int = 0) -> str:
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, *args], cwd=cwd, env=env, capture_output=True, text=True)
    assert done.returncode == code, done.stdout[-1000:] + done.stderr[-3000:]
    return done.stderr


def test_there_is_something_to_run():
    assert blocks("python") and commands()


def test_the_front_pages_are_short():
    assert len(TEXT.splitlines()) <= 110
    assert len((ROOT / "RESULTS.md").read_text().splitlines()) <= 140


PAGES = ["README.md", "RESULTS.md", "CHANGELOG.md", "CONTRIBUTING.md", "experiments/README.md"]
PAGES += ["experiments/logbook.md", *(f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md"))]


@pytest.mark.parametrize("page", PAGES)
def test_links_and_paths_lead_to_what_is_there(page):
    text = re.sub(r"^```.*?^```$", "", (ROOT / page).read_text(), flags=re.MULTILINE | re.DOTALL)
    for path in re.findall(r"`((?:taic_jax|envs|experiments|tests)/[\w/.]+)`", text):
        assert (ROOT / path).exists(), path
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if link.startswith("https://"):
            continue
        target, _, anchor = link.partition("#")
        path = (ROOT / page).parent / target if target else ROOT / page
        assert path.exists(), link
        headings = re.findall(r"^#+ (.*)$", path.read_text(), re.MULTILINE) if anchor else []
        assert not anchor or anchor in {re.sub(r"[^\w -]", "", h).lower().replace(" ", "-") for h in headings}, link


@pytest.mark.timeout(900)
@pytest.mark.parametrize("code", blocks("python"))
def test_python_blocks_run(code, tmp_path):
    (tmp_path / "block.py").write_text(f"for _ in range(2):\n{textwrap.indent(code, '    ')}")
    run(["block.py"], tmp_path)


@pytest.mark.parametrize("command", commands())
def test_commands_are_valid(command, tmp_path, tmp_path_factory):
    args = ["-m", "taic_jax", *shlex.split(command, comments=True)[1:]]
    args += ["--dry-run"] * (args[2] == "run" and not {"--dry-run", "--help"} & set(args))
    args += ["--quiet"] * ("--dry-run" in args)  # which measures nothing
    if args[2] == "play":
        args += ["--ticks", "3", "--out", str(tmp_path_factory.mktemp("film") / "film.webp")]
    if "--resume" in args:  # the run that it names is not there
        (folder,) = (arg for arg in args if arg.startswith("runs/"))
        assert folder in run(args, tmp_path, code=2)
    else:
        run(args, tmp_path)
    assert not any(tmp_path.iterdir())
