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
SYNONYMS = {
    "env": "env.name", "env_id": "env.name", "task": "env.name", "lr": "train.ppo.learning_rate",
    "discount": "train.ppo.gamma", "gae_lambda": "train.ppo.lambda_", "lam": "train.ppo.lambda_",
    "clip_range": "train.ppo.clip", "clip_coef": "train.ppo.clip", "ent_coef": "train.ppo.entropy_weight",
    "vf_coef": "train.ppo.value_weight", "n_envs": "train.ppo.num_envs", "n_steps": "train.ppo.rollout_length",
    "n_epochs": "train.ppo.epochs", "num_steps": "train.ppo.rollout_length", "total_timesteps": "train.ticks",
    "timesteps": "train.ticks", "num_seeds": "seeds", "output": "run_dir", "out": "run_dir", "log_dir": "run_dir",
}  # fmt: skip
"""Words of other libraries for a field."""


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
    hint = nearest(str(value), choices)
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


def closest(name: str, names: Iterable[str]) -> str | None:
    """Return the one of the dotted `names` that `name` stands for: by a word that other libraries use, by its end, or
    by its looks; None where none is like it."""
    names, (group, _, end) = list(names), name.rpartition(".")
    if end in SYNONYMS:
        meant = SYNONYMS[end]
        candidates = [f"{group}.{meant.rpartition('.')[2]}", meant]
        if known := [candidate for candidate in candidates if candidate in names]:
            return known[0]
    same_end = [known for known in names if known.rpartition(".")[2] == end]
    found = difflib.get_close_matches(name, same_end or names, n=1, cutoff=0.0 if same_end else 0.6)
    return found[0] if found else None


def nearest(name: str, names: Iterable[str], prefix: str = "") -> str:
    """Return `; the nearest is ...` for the end of a message, empty where nothing is near."""
    found = closest(name, names)
    return f"; the nearest is {prefix}{found}" if found else ""


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
            hint = nearest(source, preset_names()) or f"; there are {', '.join(preset_names())}"
            raise ConfigError(f"unknown preset {source!r}{hint} (a file's name ends in .yaml)")
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
            hint = nearest(f"{prefix}{name}", groups + [known for known, _ in walk(Config())])
            hint = hint or f"; there are {', '.join(groups)}"
            raise ConfigError(f"unknown field {prefix}{name}{hint}")
        old = getattr(default, name)
        if dataclasses.is_dataclass(old):
            values[name] = _override(old, value, f"{prefix}{name}.")
        else:
            values[name] = _coerce(f"{prefix}{name}", kinds[name], value)
    return dataclasses.replace(default, **values)


def _coerce(name: str, kind: Any, value: Any) -> Any:
    """Check a YAML value strictly; but integers and 1e-3, a text in YAML 1.1, are floats, and 1e6 is an integer."""
    if kind is float and isinstance(value, int | str) and not isinstance(value, bool):
        try:
            return float(value)
        except ValueError:
            pass
    elif kind is int and isinstance(value, float | str):
        if (number := as_integer(value)) is not None:
            return number
    elif get_origin(kind) is tuple and isinstance(value, list):
        try:
            return tuple(_coerce(name, get_args(kind)[0], item) for item in value)
        except ConfigError:
            raise mistyped(name, kind, value) from None
    elif value in get_args(kind) if get_origin(kind) is Literal else type(value) is kind:
        return value
    raise mistyped(name, kind, value)


def as_integer(value: float | str) -> int | None:
    """Return the integer that is written as a float or with an exponent, 1e6 say, or None if it is none."""
    if isinstance(value, str) and "e" not in value.lower():
        return None
    with contextlib.suppress(ValueError):
        return int(float(value)) if float(value).is_integer() else None
    return None


def _show(value: Any) -> str:
    text = "nothing" if value is None else repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
