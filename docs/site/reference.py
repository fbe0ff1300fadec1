"""The parts of the reference that are made from the source when the site is built."""

import ast
import dataclasses
import inspect
import math
import os
import re
import subprocess
import sys
from collections.abc import Callable
from functools import partial, reduce
from typing import Annotated, Any, Literal, get_args, get_origin

import taic_jax
from taic_jax.__main__ import COMMANDS
from taic_jax.config import USUAL_BOUNDS, Bounds, Config, field_types

ANY = Bounds(-math.inf)


def public_names() -> str:
    """Return a directive of autodoc for every public name, in the order of the alphabet."""
    parts = []
    for name in taic_jax.__all__:
        if isinstance(value := getattr(taic_jax, name), str):
            continue
        members = "   :members:\n" if inspect.isclass(value) and not is_config(value) else ""
        kind = "class" if inspect.isclass(value) else "function"
        parts.append(f"```{{eval-rst}}\n.. auto{kind}:: taic_jax.{name}\n{members}```\n")
    return "\n".join(parts)


def is_config(value: object) -> bool:
    """Return whether this is a group of the config, whose fields have a table of their own."""
    return getattr(value, "__module__", "").startswith(Config.__module__) and dataclasses.is_dataclass(value)


def without_defaults(app, what: str, name: str, value, options, signature: str, returned: str) -> tuple[str, str]:
    """Return the signature of what is documented, for groups of the config without their long defaults."""
    return ("(...)" if is_config(value) else signature), returned


def config_fields() -> str:
    """Return a table of every field of the config by its dotted name: its values, its default and its help."""
    rows = ["| field | values | default | |", "|---|---|---|---|"]
    for name, kind in field_types(Config, bounds=True).items():
        *groups, field = name.split(".")
        group = reduce(getattr, groups, Config())
        cells = values_of(kind), f"`{getattr(group, field)!r}`", texts_of(type(group)).get(field, "")
        rows.append(f"| `{name}` | {' | '.join(cells)} |")
    return "\n".join(rows)


def values_of(kind: Any) -> str:
    """Return the values that a field of this type may hold."""
    bare, bounds = get_args(kind) if get_origin(kind) is Annotated else (kind, USUAL_BOUNDS.get(kind, ANY))
    several = get_origin(bare) is tuple
    bare = get_args(bare)[0] if several else bare
    names = get_args(bare) if get_origin(bare) is Literal else (bare.__name__,)
    text = ("several of " if several else "") + ", ".join(f"`{name}`" for name in names)
    text += f" from {bounds.low:g}" if bounds.low > -math.inf else ""
    return text + (f" to {bounds.high:.10g}" if bounds.high < math.inf else "")


def texts_of(kind: type) -> dict[str, str]:
    """Return the help of each field: the text that stands below it, in a class and in those it extends."""
    texts = {}
    for base in reversed(kind.__mro__[:-1]):
        (body,) = ast.parse(inspect.cleandoc("\n" + inspect.getsource(base))).body
        for before, after in zip(body.body, body.body[1:], strict=False):
            if isinstance(before, ast.AnnAssign) and isinstance(after, ast.Expr):
                texts[before.target.id] = " ".join(ast.literal_eval(after.value).split()).replace("|", "\\|")
    return texts


def commands() -> str:
    """Return the help of every command."""
    env = {**os.environ, "COLUMNS": "100", "NO_COLOR": "1", "TERM": "dumb"}
    call = partial(subprocess.run, stdout=subprocess.PIPE, text=True, check=True, env=env)
    texts = {name: call([sys.executable, "-m", "taic_jax", name, "--help"]).stdout for name in COMMANDS}
    return "\n\n".join(f"### taic {name}\n\n```text\n{text}```" for name, text in texts.items())


MADE: dict[str, Callable[[], str]] = {
    "{{ public_names }}": public_names, "{{ config_fields }}": config_fields, "{{ commands }}": commands,
}  # fmt: skip


def fill(app, page: str, source: list[str]) -> None:
    """Put what is made in the place of its name in a page."""
    for name, make in MADE.items():
        if name in source[0]:
            source[0] = source[0].replace(name, make())


def as_rst(app, what: str, name: str, value, options, lines: list[str]) -> None:
    """Write a docstring as reStructuredText: code by two ticks, and no mark-up by stars, bars and underscores."""
    for index, line in enumerate(lines):
        line = line.replace(": ", "; ") if what == "property" else line  # a colon would end a type for napoleon
        parts = re.split(r"(``.*?``|:\w+:`.*?`)", re.sub(r"(?<!`)`([^`]+)`(?!`)", r"``\1``", line))
        parts[::2] = [re.sub(r"[*|]|(?<=\w)_(?!\w)", r"\\\g<0>", part) for part in parts[::2]]
        lines[index] = "".join(parts)
