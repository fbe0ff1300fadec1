"""The rules of the architecture: layers, budgets and names, held by reading the source."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PARTS = ("analysis", "artifacts", "config", "data", "handles", "options", "report", "rl", "runtime", "sweep")
FOLDERS = ("envs", "experiments", *(f"taic_jax/{name}" for name in PARTS))
PACKAGE = sorted((ROOT / "taic_jax").glob("*.py")) + sorted(
    path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")
)
ALL = PACKAGE + sorted((ROOT / "tests").rglob("*.py"))

# A module imports only from its own layer or from earlier ones. A module that is in none fails the test.
LAYERS = (
    "envs",
    "config types",
    "networks nonfinite",
    "runtime",
    "options",
    "data",
    "rl",
    "artifacts",
    "analysis",
    "trainer",
    "summary sources",
    "pipeline",
    "handles command_line",
    "run sweep from_data",
    "report",
    "experiments",
    "__main__",
)
RANK = {name: rank for rank, names in enumerate(LAYERS) for name in names.split()}

FUNCTION_LINES, FILE_LINES, DEPTH = 60, 300, 2
VAGUE_NAMES = {"utils", "util", "common", "helpers", "helper", "misc"}
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


def module_name(path: Path) -> str:
    """Return the module's own name within the package: envs/base.py is envs, taic_jax/rl/ppo.py is rl.

    A command line, `__main__.py` in any folder, is in the last layer, and nothing imports it.
    """
    if path.stem == "__main__":
        return path.stem
    parts = path.relative_to(ROOT).with_suffix("").parts
    return parts[1] if parts[0] == "taic_jax" else parts[0]


def imported(tree: ast.AST) -> Iterator[str]:
    """Yield which of our modules are imported anywhere in a tree, functions included."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        yield from (name.split(".")[1] for name in names if name.startswith("taic_jax."))


def depths(node: ast.AST, depth: int = 0) -> Iterator[tuple[str, int]]:
    """Yield how deep each function stands in others."""
    for child in ast.iter_child_nodes(node):
        inside = depth + isinstance(child, FUNCTIONS)
        if isinstance(child, FUNCTIONS):
            yield child.name, inside
        yield from depths(child, inside)


def parse(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


def label(path: Path) -> str:
    return str(path.relative_to(ROOT))


def test_there_is_something_to_check():
    assert {"envs/base.py", "taic_jax/rl/ppo.py", "taic_jax/run.py"} <= {label(path) for path in PACKAGE}


@pytest.mark.parametrize("path", [path for path in PACKAGE if path != ROOT / "taic_jax/__init__.py"], ids=label)
def test_imports_point_to_earlier_layers(path):
    own = module_name(path)
    assert own in RANK, f"{label(path)} is in no layer of {__file__}"
    later = {name for name in set(imported(parse(path))) - {"__version__"} if RANK.get(name, len(LAYERS)) > RANK[own]}
    assert not later, f"{own} must not import {later}"
    if own == "envs":
        assert set(imported(parse(path))) <= {"envs"}


@pytest.mark.parametrize("path", ALL, ids=label)
def test_budgets(path):
    tree, lines = parse(path), len(path.read_text().splitlines())
    assert lines <= FILE_LINES, f"{lines} lines"
    for node in ast.walk(tree):
        if isinstance(node, FUNCTIONS):
            length = (node.end_lineno or 0) - node.lineno + 1
            assert length <= FUNCTION_LINES, f"{node.name} has {length} lines"
    for name, depth in depths(tree):
        assert depth <= DEPTH, f"{name} stands in a function that stands in a function"


@pytest.mark.parametrize("path", ALL, ids=label)
def test_names_and_imports(path):
    assert path.stem not in VAGUE_NAMES, "name a module for what it holds"
    for node in ast.walk(parse(path)):
        if isinstance(node, ast.ImportFrom):
            assert "*" not in [alias.name for alias in node.names]
            # It would turn annotations into strings, which the shape checks of the tests cannot read.
            assert node.module != "__future__"


@pytest.mark.parametrize("path", PACKAGE, ids=label)
def test_modules_and_public_names_have_docstrings(path):
    tree = parse(path)
    assert ast.get_docstring(tree) or not tree.body
    for node in tree.body:
        if isinstance(node, (*FUNCTIONS, ast.ClassDef)) and not node.name.startswith("_"):
            assert ast.get_docstring(node), f"{node.name} has no docstring"


SOURCE_RULES = {
    "def a():\n def b():\n  def c(): pass": [("a", 1), ("b", 2), ("c", 3)],
    "class A:\n def a(self): pass": [("a", 1)],
}


@pytest.mark.parametrize("source", SOURCE_RULES)
def test_depths_counts_functions_only(source):
    assert list(depths(ast.parse(source))) == SOURCE_RULES[source]


def test_imported_sees_every_form():
    source = "import taic_jax.rl.ppo\ndef f():\n from taic_jax import config, types\n import taic_jax.envs"
    assert sorted(imported(ast.parse(source))) == ["config", "envs", "rl", "types"]
