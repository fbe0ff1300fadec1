"""Whatever is typed or written, the answer is a plan or one line that names what is wrong; never a traceback.

TAIC_JAX_FUZZ=2000 pytest tests/test_fuzz.py    # so many examples of each kind; by default a few
"""

import io
import os
import re
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from taic_jax.config import Config, walk
from taic_jax.config.files import preset_names
from taic_jax.run import main

FIELDS = [name for name, _ in walk(Config())]
WORDS = [
    "-1",
    "0",
    "1",
    "3",
    "1e-3",
    "1e400",
    "nan",
    "-inf",
    "1_000",
    "0x10",
    "true",
    "None",
    "open",
    "ant",
    "[1]",
    "7 8",
    "",
]
KEYS = sorted({part for name in FIELDS for part in name.split(".")})
# No text that a shell could not pass on, and none that is a request for help.
TEXTS = st.text(st.characters(codec="utf-8", exclude_characters="\x00"), max_size=12).filter(
    lambda text: text not in ("-h", "--help") and not text.startswith(("--h", "--tyro"))
)
VALUES = st.one_of(
    st.sampled_from(WORDS), TEXTS, st.integers().map(str), st.floats().map(str), st.integers(-3, 300).map(str)
)
SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.sampled_from(WORDS) | TEXTS | st.dates()
NAMES = st.sampled_from(KEYS) | TEXTS
DOCUMENTS = st.dictionaries(
    st.sampled_from(["env", "collect", "options", "train", "evaluate", "seed", "seeds", "base", "trian"]),
    st.recursive(SCALARS, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(NAMES, inner, max_size=3)),
    min_size=1,
    max_size=3,
)
COUNT = int(os.environ.get("TAIC_JAX_FUZZ", "25"))
fuzzed = settings(
    max_examples=COUNT, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck), database=None
)


@pytest.fixture(autouse=True)
def in_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def answer(args: list[str]) -> tuple[int, str]:
    """Return the exit code of a dry run, and what it said was wrong."""
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        code = main([*args, "--dry-run", "--quiet"])
    told = err.getvalue()
    assert code in (0, 2), (code, told)
    if code == 2:
        assert told.startswith("taic_jax: error: ") and told.count("\n") == 1 and told.endswith("\n"), told
    return code, told


def names_a_field(told: str) -> bool:
    """Tell whether a message names a field of the config by its whole name, or the preset it was looking for."""
    return "preset" in told or any(names(told, field) for field in FIELDS)


def names(told: str, what: str) -> bool:
    """Tell whether a message names this, and not only what has it in its name; every blank is told as one."""
    what = " ".join(what.split())
    return bool(what) and bool(re.search(rf"(?<![\w.]){re.escape(what)}(?!\w|\.\w)", told))


def leaves(document: Any, prefix: str = "") -> Iterator[str]:
    """Yield the dotted name of every value of a document, and of what holds it, which may be what is unknown."""
    if prefix:
        yield prefix[:-1]
    if prefix[:-1] in (*FIELDS, "base") or not isinstance(document, dict):
        return
    for key, value in document.items():
        yield from leaves(value, f"{prefix}{key}.")


@fuzzed
@given(st.sampled_from(FIELDS), st.lists(VALUES, max_size=2))
def test_a_wrong_value_is_refused_by_its_name(field, values):
    code, told = answer(["nav2d", f"--{field}", *values])
    options = (value for value in values if value.startswith("-"))  # it may be one of these that is refused
    assert code == 0 or any(names(told, name) for name in (field, field.replace("_", "-"), *options)), told


WORD = st.one_of(st.sampled_from(FIELDS).map("--{}".format), st.sampled_from(preset_names()), VALUES)


@fuzzed
@given(st.lists(WORD, max_size=6))
def test_any_command_line_gets_an_answer(args):
    code, told = answer(args)
    assert code == 0 or any(" ".join(arg.split()) in told for arg in args if arg) or names_a_field(told), told


@fuzzed
@given(DOCUMENTS)
def test_any_document_gets_an_answer_that_names_its_field(document):
    Path("mine.yaml").write_text(yaml.safe_dump(document))
    code, told = answer(["mine.yaml"])
    assert code == 0 or any(names(told, leaf) for leaf in leaves(document)) or "stands twice" in told, told


def test_what_counts_as_naming_a_field():
    assert names("env.name: expected", "env.name") and not names("env.names: expected", "env.name")
    assert not names("collect.seed: expected", "seed") and not names("something", "")
    assert names_a_field("unknown field opt; the nearest is options.size") and not names_a_field("the environment")
    assert list(leaves({"env": {"name": 1, "b": {}}, "seed": {"a": 2}})) == ["env", "env.name", "env.b", "seed"]
    assert not names("unknown field env.b", "env")


MARKS = st.sampled_from(["seed", ":", " ", "\n", "-", "{", "&a", "*a", "<<", "train", "[", "1"])


@fuzzed
@given(st.text(max_size=80) | st.lists(MARKS).map("".join))
def test_any_text_gets_an_answer(text):
    Path("mine.yaml").write_text(text, errors="surrogatepass")
    code, told = answer(["mine.yaml"])
    assert code == 0 or "mine.yaml" in told or names_a_field(told), told


@fuzzed
@given(st.binary(max_size=60))
def test_any_bytes_get_an_answer(content):
    Path("mine.yaml").write_bytes(content)
    code, told = answer(["mine.yaml"])
    assert code == 0 or "mine.yaml" in told or names_a_field(told), told
