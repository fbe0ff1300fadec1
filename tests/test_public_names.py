"""The public names of the package: each is the same at every use, whatever was imported in between."""

import pkgutil
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import taic_jax as taic

ROOT = Path(__file__).parents[1]
USE_TWICE = """
import contextlib, importlib, pkgutil
import taic_jax as taic
first = {name: getattr(taic, name) for name in taic.__all__}
for module in pkgutil.walk_packages(taic.__path__, "taic_jax."):
    if module.name.startswith("taic_jax.experiments.examples.run_"):
        continue  # a program that runs when it is imported
    with contextlib.suppress(ImportError):  # of extras that are not installed
        importlib.import_module(module.name)
for name in taic.__all__:
    assert getattr(taic, name) is first[name], f"{name} is now {getattr(taic, name)}"
print(len(first), callable(taic.evaluate))
"""


def test_every_name_is_the_same_at_its_second_use_and_after_every_module_was_imported():
    done = subprocess.run([sys.executable, "-c", USE_TWICE], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"{len(taic.__all__)} True\n"


def modules() -> set[str]:
    """List every module of the package, however deep, by its dotted name."""
    return {module.name for module in pkgutil.walk_packages(taic.__path__, "taic_jax.", onerror=lambda name: None)}


def test_no_public_name_is_that_of_a_module():
    assert "taic_jax.pipeline" in modules() and "taic_jax.analysis.evaluate" in modules()
    assert not {f"taic_jax.{name}" for name in taic.__all__} & modules()


def test_the_version_has_one_home():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert project["project"]["dynamic"] == ["version"] and "version" not in project["project"]
    assert metadata.version("taic-jax") == taic.__version__
    assert f"\nversion: {taic.__version__}\n" in (ROOT / "CITATION.cff").read_text()
