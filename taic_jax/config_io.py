"""Configurations from YAML and back: a preset or file holds only its differences from the defaults or its base."""

import contextlib
import dataclasses
import difflib
from collections.abc import Iterable
from importlib import resources
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import yaml

from taic_jax.config import Config, ConfigError, walk

BASE = "base"
"""Key of a file that names what it starts from, a preset or another file; without it, the defaults."""


def load_config(source: str | Path) -> Config:
    """Load a preset by its name, or a YAML file by its path.

    Raises:
        ConfigError: it or its base is missing, is not YAML, or holds an unknown field or a mistyped value.
    """
    return _load(str(source), ())


def _load(source: str, above: tuple[str, ...]) -> Config:
    """Load what the files `above` start from, the last of them at once."""
    if source in above:
        raise ConfigError(f"{above[0]}: base: expected an end, got {' -> '.join((*above, source))}")
    try:
        changes = _read_changes(source)
    except ConfigError as error:
        raise (ConfigError(f"{above[-1]}: base: {error}") if above else error) from None
    config = Config()
    if BASE in changes:
        base = changes.pop(BASE)
        if not isinstance(base, str):
            raise ConfigError(f"{source}: base: expected a preset's name or a file, got {_show(base)}")
        config = _load(base, (*above, source))
    try:
        return _override(config, changes)
    except ConfigError as error:
        raise ConfigError(f"{source}: {error}") from None


def _read_changes(source: str) -> dict:
    text = _read_text(source)
    try:
        changes = yaml.load(text, Loader=_Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" in line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or getattr(error, "reason", "unreadable")
        raise ConfigError(f"{source}: expected YAML, got a mistake{where}: {problem}") from None
    if not isinstance(changes, dict):
        raise ConfigError(f"{source}: expected a mapping such as 'seed: 0', got {_show(changes)}")
    return changes


def to_yaml(config: Config) -> str:
    """Write every field of a configuration, so that `load_config` reads the same one back."""
    return yaml.safe_dump(dataclasses.asdict(config), sort_keys=False)


def preset_names() -> list[str]:
    """List the presets that ship with the package."""
    return sorted(file.name.removesuffix(".yaml") for file in _presets().iterdir() if file.name.endswith(".yaml"))


def mistyped(name: str, kind: Any, value: Any) -> ConfigError:
    """Return the error for a value of the wrong type, with the nearest valid value where there is one."""
    item = get_args(kind)[0] if get_origin(kind) is tuple else kind
    choices = get_args(item) if get_origin(item) is Literal else ("True", "False") if item is bool else ()
    if item is kind:
        nouns = {int: "an integer", float: "a number", str: "text"}
        expected = f"one of {', '.join(choices)}" if choices else nouns.get(kind, "a value")
    else:
        plurals = {int: "integers", str: "texts"}
        expected = "a list of " + (f"some of {', '.join(choices)}" if choices else plurals.get(item, "values"))
    hint = f"; the nearest is {closest(str(value), choices)}" if choices else ""
    if kind is int:
        with contextlib.suppress(ValueError, TypeError, OverflowError):
            hint = f"; the nearest is {round(float(value))}"
    return ConfigError(f"{name}: expected {expected}, got {_show(value)}{hint}")


def from_text(name: str, kind: Any, text: str) -> Any:
    """Read one value of a field from what was typed for it, as strictly as from YAML.

    Raises:
        ConfigError: it is not of the field's type.
    """
    try:
        value = text if kind is str or get_origin(kind) is Literal else yaml.load(text, Loader=_Loader)
    except yaml.YAMLError:
        value = text
    return _coerce(name, kind, value)


def closest(name: str, names: Iterable[str]) -> str:
    """Return the one of the dotted `names` that looks most like `name`, if possible one that ends like it."""
    names, end = list(names), name.rpartition(".")[2].lstrip("-")
    same_end = [known for known in names if known.rpartition(".")[2].lstrip("-") == end]
    return difflib.get_close_matches(name, same_end or names, n=1, cutoff=0.0)[0]


class _Loader(yaml.SafeLoader):
    """Refuse a key that stands twice in one mapping, where YAML's usual loader keeps the last in silence."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        names = [key.value for key, _ in node.value]
        for name in names:
            if names.count(name) > 1:
                raise yaml.MarkedYAMLError(problem=f"{name} stands twice", problem_mark=node.start_mark)
        return super().construct_mapping(node, deep)


def _presets() -> Any:
    return resources.files("taic_jax.experiments") / "presets"


def _read_text(source: str) -> str:
    if not source.endswith((".yaml", ".yml")) and "/" not in source:
        if source not in preset_names():
            nearest = closest(source, preset_names())
            raise ConfigError(f"unknown preset {source!r}; the nearest is {nearest} (a file's name ends in .yaml)")
        return (_presets() / f"{source}.yaml").read_text()
    try:
        return Path(source).read_text()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not text"
        raise ConfigError(f"{source}: expected a YAML file or one of {', '.join(preset_names())}: {reason}") from None


def _override(default: Any, changes: Any, prefix: str = "") -> Any:
    """Replace the fields of `default` that `changes` names; the others keep the values of *this* default."""
    kinds = get_type_hints(type(default))
    if not isinstance(changes, dict):
        raise ConfigError(f"{prefix[:-1]}: expected a mapping of {', '.join(kinds)}, got {_show(changes)}")
    values = {}
    for name, value in changes.items():
        if name not in kinds:
            groups = [f"{prefix}{kind}" for kind in kinds] + [BASE] * (not prefix)
            nearest = closest(f"{prefix}{name}", groups + [known for known, _ in walk(Config())])
            raise ConfigError(f"unknown field {prefix}{name}; the nearest is {nearest}")
        old = getattr(default, name)
        if dataclasses.is_dataclass(old):
            values[name] = _override(old, value, f"{prefix}{name}.")
        else:
            values[name] = _coerce(f"{prefix}{name}", kinds[name], value)
    return dataclasses.replace(default, **values)


def _coerce(name: str, kind: Any, value: Any) -> Any:
    """Check a YAML value strictly: only integers, and what YAML 1.1 misreads (1e-3), turn into floats."""
    if kind is float and isinstance(value, int | str) and not isinstance(value, bool):
        try:
            return float(value)
        except ValueError:
            pass
    elif get_origin(kind) is tuple and isinstance(value, list):
        try:
            return tuple(_coerce(name, get_args(kind)[0], item) for item in value)
        except ConfigError:
            raise mistyped(name, kind, value) from None
    elif value in get_args(kind) if get_origin(kind) is Literal else type(value) is kind:
        return value
    raise mistyped(name, kind, value)


def _show(value: Any) -> str:
    text = "nothing" if value is None else repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
