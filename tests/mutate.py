"""Mutation testing: draw one-line mutants of source files, run the nearest tests on each, and list the survivors.

`python tests/mutate.py taic_jax/rl/returns.py --count 30` appends a table to survivors.md. Mutants are made in a copy
of the tree. Each test session is forked from this process, which has imported the slow libraries.
"""

import argparse
import ast
import copy
import importlib
import os
import random
import resource
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
LIBRARIES = ("jax", "scipy.stats", "optax", "flax.linen", "distrax", "rlax", "hypothesis", "beartype", "jaxtyping",
             "brax.training.acme.running_statistics", "yaml", "rich.progress", "pytest")  # fmt: skip
TESTS = {
    "update": "rl/test_ppo.py", "model": "options/test_options.py options/test_losses.py",
    "execution": "options/test_options.py options/test_termination.py",
    "termination": "options/test_termination.py options/test_algorithm_1.py", "losses": "options/test_termination.py",
    "learning": "rl/test_learning.py options/test_losses.py options/test_algorithm_1.py",
    "ant_tasks": "envs/test_arenas.py envs/test_envs_rendering.py", "evaluate": "test_trainer.py",
    "summary": "test_dry_run.py test_transfer.py test_pipeline.py test_nonfinite.py handles/test_load.py",
    "agent": "handles/test_load.py", "off_policy": "rl/test_sac.py rl/test_dqn.py",
    "agents": "handles/test_load.py artifacts/test_artifacts.py", "play": "handles/test_commands.py",
    "assess": "handles/test_commands.py", "command": "handles/test_commands.py",
}  # fmt: skip
"""Tests of a module besides `test_MODULE*.py`."""
OPERATORS = {ast.Add: ast.Sub, ast.Mult: ast.Div, ast.BitAnd: ast.BitOr, ast.LShift: ast.RShift, ast.And: ast.Or,
             ast.Lt: ast.LtE, ast.Gt: ast.GtE, ast.Eq: ast.NotEq, ast.Is: ast.IsNot, ast.In: ast.NotIn}  # fmt: skip
OPERATORS |= {b: a for a, b in OPERATORS.items()} | {ast.Pow: ast.Mult, ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult}
NAMES = {"min": "max", "minimum": "maximum", "any": "all", "sum": "mean", "argmin": "argmax", "zeros": "ones"}
NAMES |= {b: a for a, b in NAMES.items()}


def mutated(node: ast.expr, names: list[str]) -> Iterator[ast.expr]:
    """Yield what may stand in a node's place; `names` are those of the function around it."""
    new = copy.deepcopy(node)
    match new:
        case ast.BinOp() | ast.BoolOp() if type(new.op) in OPERATORS:
            new.op = OPERATORS[type(new.op)]()
            yield new
        case ast.Compare():
            new.ops[0] = OPERATORS[type(new.ops[0])]()
            yield from (new, ast.UnaryOp(ast.Not(), node))
        case ast.UnaryOp():
            yield new.operand
        case ast.IfExp():
            yield ast.IfExp(new.test, new.orelse, new.body)
        case ast.Constant(value=bool() | int() | float() as value):
            yield ast.Constant(type(value)(value != 1 if value in (0, 1) else value + 1))
        case ast.Attribute(attr=name) if name in NAMES:
            yield ast.Attribute(new.value, NAMES[name], new.ctx)
        case ast.Name(id=name, ctx=ast.Load()) if name in names:
            yield ast.Name(names[names.index(name) - 1], ast.Load())
        case ast.Call(args=args, keywords=keywords):
            yield from (ast.Call(new.func, args, [k for k in keywords if k is not keyword]) for keyword in keywords)
            pairs = [[*args[:i], args[i + 1], args[i], *args[i + 2 :]] for i in range(len(args) - 1)]
            yield from (ast.Call(new.func, pair, keywords) for pair in pairs)


def walk(node: ast.AST, names: list[str]) -> Iterator[tuple[ast.expr, list[str]]]:
    """Yield the expressions under a node but for annotations, errors and texts, with the names they may use."""
    if isinstance(node, ast.FunctionDef):
        names = [argument.arg for argument in node.args.args + node.args.kwonlyargs if argument.arg != "self"]
    if isinstance(node, ast.Raise | ast.Assert | ast.JoinedStr):
        return
    if isinstance(node, ast.expr):
        yield node, names
    for field, children in ast.iter_fields(node):
        for child in children if isinstance(children, list) else [children]:
            if isinstance(child, ast.AST) and field not in ("annotation", "returns", "decorator_list"):
                yield from walk(child, names)


def mutants(source: str) -> Iterator[tuple[int, str, str, str]]:
    """Yield the line, the code before and after, and the whole text of every mutant."""
    text, starts = source.encode(), [0]
    for line in text.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    for node, names in walk(ast.parse(source), []):
        first, last = starts[node.lineno - 1] + node.col_offset, starts[node.end_lineno - 1] + node.end_col_offset
        for new in mutated(node, names):
            before, after = ast.unparse(node), ast.unparse(ast.fix_missing_locations(new))
            if before != after:
                yield node.lineno, before, after, f"{text[:first].decode()}({after}){text[last:].decode()}"


def run(tree: Path, tests: list[str], limit: int) -> tuple[int, float]:
    """Run pytest in a fork; return its exit code, negative after `limit` seconds of computing, and how many it took."""
    child = os.fork()
    if not child:
        resource.setrlimit(resource.RLIMIT_CPU, (limit, limit))
        os.chdir(tree)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os.dup2(1, 2)
        sys.path[0], os.environ["PYTHONPATH"] = str(tree), str(tree)
        sys.dont_write_bytecode, os.environ["PYTHONDONTWRITEBYTECODE"] = True, "1"
        quiet = ["-x", "-n0", "-q", "-p", "no:cacheprovider", "-W", "ignore::pytest.PytestAssertRewriteWarning"]
        os._exit(importlib.import_module("pytest").main([*quiet, *tests]))
    _, status, usage = os.wait4(child, 0)
    return os.waitstatus_to_exitcode(status), usage.ru_utime


def survivors(tree: Path, name: str, args: argparse.Namespace) -> Iterator[str]:
    """Yield a row for each mutant of a file that its tests let live, then the count."""
    module, source = Path(name).stem, (tree / name).read_text()
    tests = [str(path) for path in sorted((tree / "tests").rglob(f"test_{module}*.py"))]
    tests += [f"tests/{test}" for test in TESTS.get(module, "").split()]
    code, seconds = run(tree, tests, 600)
    if code:
        sys.exit(f"{name}: its tests fail without a mutant, exit code {code}: {tests}")
    drawn, count = list(mutants(source)), 0
    drawn = random.Random(args.seed).sample(drawn, len(drawn))[args.skip : args.skip + args.count]
    for line, before, after, text in drawn:
        (tree / name).write_text(text)
        if run(tree, tests, 20 + int(3 * seconds))[0] == 0:
            count += 1
            yield f"| {name}:{line} | `{before}` | `{after}` |"
    (tree / name).write_text(source)
    yield f"| {name} | {len(drawn) - count} of {len(drawn)} killed | |"


def main() -> None:
    """Mutate, test, and append what survived to a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="+")
    parser.add_argument("--count", type=int, default=12, help="mutants a file")
    parser.add_argument("--skip", type=int, default=0, help="mutants that an earlier call has tried")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("survivors.md"))
    args = parser.parse_args()
    for library in LIBRARIES:
        importlib.import_module(library)
    with tempfile.TemporaryDirectory() as folder, args.out.open("a") as out:
        tree = Path(folder) / "tree"
        shutil.copytree(ROOT, tree, symlinks=True, ignore=shutil.ignore_patterns(".*", "__pycache__", "results"))
        print("\n| where | code | survivor |\n|---|---|---|", file=out)
        for name in args.files:
            for row in survivors(tree, name, args):
                print(row, file=out, flush=True)


if __name__ == "__main__":
    main()
