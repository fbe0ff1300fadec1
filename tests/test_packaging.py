"""What is shipped: wheel and sdist hold all three packages, and the constraints no addresses."""

import itertools
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from importlib import resources
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def python(*args: str, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *args], cwd=cwd, capture_output=True, text=True)


def test_constraints_hold_names_and_versions_only():
    for line in (ROOT / "constraints.txt").read_text().splitlines():
        assert re.fullmatch(r"[a-z0-9-]+(\[[a-z0-9,-]+\])?==[\w.]+( ; [\w .<>='()!]+)?", line), line


def test_constraints_pin_a_jax_for_every_python():
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    markers = [line.partition(" ; ")[2] for line in lines if line.startswith("jax==")]
    assert markers == ["python_full_version < '3.12'", "python_full_version >= '3.12'"]


def test_constraints_pin_everything_that_is_asked_for():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    asked = itertools.chain(project["dependencies"], *project["optional-dependencies"].values())
    names = {re.split(r"[\[>=]", requirement)[0].lower() for requirement in asked}
    pinned = {line.partition("==")[0] for line in (ROOT / "constraints.txt").read_text().splitlines()}
    assert names <= pinned


@pytest.mark.parametrize("name", ["envs", "experiments"])
def test_symlinks_make_one_package(name):
    link = ROOT / "taic_jax" / name
    assert link.is_symlink() and not Path(link.readlink()).is_absolute()
    assert link.resolve() == ROOT / name


@pytest.mark.parametrize("name", ["envs", "experiments"])
def test_the_folders_refuse_to_be_imported_by_their_bare_name(name):
    done = python("-c", f"import {name}")
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith("ImportError: ") and f"taic_jax.{name}" in done.stderr


def test_presets_are_found_as_resources():
    names = {file.name for file in (resources.files("taic_jax.experiments") / "presets").iterdir()}
    assert {"nav2d.yaml", "half_cheetah.yaml", "ant.yaml", "paper.yaml"} <= names


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> Path:
    """Build sdist and wheel from a copy of what the checkout holds, with the tools installed here."""
    copy = tmp_path_factory.mktemp("build") / "checkout"
    keep = ("pyproject.toml", "README.md", "LICENSE", "taic_jax", "envs", "experiments")
    copy.mkdir()
    for name in keep:
        if (ROOT / name).is_dir():
            ignore = shutil.ignore_patterns("__pycache__")
            shutil.copytree(ROOT / name, copy / name, symlinks=True, ignore=ignore)
        else:
            shutil.copy(ROOT / name, copy)
    done = python("-m", "build", "--no-isolation", "--outdir", str(copy / "dist"), cwd=copy)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return copy / "dist"


MEASURING = tuple(f"taic_jax/experiments/{name}/" for name in ("benchmark", "evidence", "figures", "reliability"))


def shipped() -> set[str]:
    """List what must be inside: every module for users under its import name, and the data files."""
    files = set()
    for path in ROOT.glob("taic_jax/**/*.py"):
        files.add(path.relative_to(ROOT).as_posix())
    for folder in ("envs", "experiments"):
        for path in (*ROOT.glob(f"{folder}/**/*.py"), *ROOT.glob(f"{folder}/**/*.yaml")):
            files.add("taic_jax/" + path.relative_to(ROOT).as_posix())
    files.add("taic_jax/experiments/results/presets.csv")
    pretrained = (path for path in ROOT.glob("experiments/pretrained/**/*") if path.is_file())
    files |= {f"taic_jax/{path.relative_to(ROOT).as_posix()}" for path in pretrained}
    page = [path for ending in ("html", "css", "js") for path in ROOT.glob(f"taic_jax/report/*.{ending}")]
    files = {name for name in files if not name.startswith(MEASURING)}
    return files | {"taic_jax/py.typed"} | {path.relative_to(ROOT).as_posix() for path in page}


def test_wheel_holds_everything_and_nothing_else(built):
    (wheel,) = built.glob("*.whl")
    names = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert names == shipped()
    assert wheel.stat().st_size < 5e6


def test_sdist_holds_everything(built):
    (sdist,) = built.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert shipped() | {"LICENSE", "README.md", "pyproject.toml"} <= names


def test_the_wheel_runs_away_from_the_checkout(built, tmp_path):
    (wheel,) = built.glob("*.whl")
    zipfile.ZipFile(wheel).extractall(tmp_path / "site")
    code = """
import sys; sys.path.insert(0, "site")
import taic_jax, taic_jax.run, taic_jax.config.files
assert taic_jax.__file__.startswith(sys.argv[1]), taic_jax.__file__
names = taic_jax.config.files.preset_names()
print(names, taic_jax.command_line.parse(["ant"], "", taic_jax.run.Command).config.env.name)
"""
    done = python("-I", "-c", code.replace('"site"', repr(str(tmp_path / "site"))), str(tmp_path), cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "half_cheetah" in done.stdout and done.stdout.endswith(" ant\n")
