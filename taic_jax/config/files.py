"""Configurations from YAML and back; a file holds its differences from the defaults or its base."""

import contextlib
import dataclasses
import difflib
import math
from collections.abc import Iterable
from importlib import resources
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import yaml

from taic_jax.config import Config, ConfigError, field_types

_PRESETS = resources.files("taic_jax.experiments") / "presets"
BASE = "base"
"""Key of a file for its base, a preset or another file; without it, the base is the defaults."""
SYNONYMS = {
    "env": "env.name", "env_id": "env.name", "task": "env.name", "lr": "train.ppo.learning_rate",
    "discount": "train.ppo.gamma", "gae_lambda": "train.ppo.lambda_", "lam": "train.ppo.lambda_",
    "clip_range": "train.ppo.clip", "clip_coef": "train.ppo.clip", "ent_coef": "train.ppo.entropy_weight",
    "vf_coef": "train.ppo.value_weight", "n_envs": "train.ppo.num_envs", "n_steps": "train.ppo.rollout_length",
    "n_epochs": "train.ppo.epochs", "num_steps": "train.ppo.rollout_length", "total_timesteps": "train.ticks",
    "buffer_size": "train.sac.capacity", "learning_starts": "train.sac.warmup", "algo": "train.learner",
    "timesteps": "train.ticks", "num_seeds": "seeds", "output": "run_dir", "out": "run_dir", "log_dir": "run_dir",
}  # fmt: skip
"""Names of other libraries for a field."""


def load_config(source: str | Path, above: tuple[str, ...] = ()) -> Config:
    """Load a preset by its name, or a YAML file by its path; the files `above` start from it.

    Raises:
        ConfigError: it or its base is missing, is not YAML, or holds an unknown field or a mistyped value.
    """
    source = str(source)
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
        config = load_config(base, (*above, source))
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


def from_mapping(changes: Any) -> Config:
    """Return the defaults with these changes, nested as in a file, or raise ConfigError."""
    return _override(Config(), changes)


def to_yaml(config: Config) -> str:
    """Write every field of a configuration, so that `load_config` reads the same one back."""
    return yaml.safe_dump(dataclasses.asdict(config), sort_keys=False)


def differences(config: Any, default: Any = None, indent: str = "") -> str:
    """Write the fields that differ from the defaults, each default as a comment; `load_config` reads the same back."""
    default, lines = default or type(config)(), []
    for field in dataclasses.fields(config):
        value, old = getattr(config, field.name), getattr(default, field.name)
        if dataclasses.is_dataclass(value):
            inner = differences(value, old, f"{indent}  ")
            lines += [f"{indent}{field.name}:", inner] if inner else []
        elif value != old:
            new, usual = (yaml.safe_dump([x], default_flow_style=True, width=math.inf)[1:-2] for x in (value, old))
            lines.append(f"{indent}{field.name}: {new}  # by default {usual}")
    return "\n".join(lines)


def preset_names() -> list[str]:
    """List the presets that ship with the package."""
    return sorted(file.name.removesuffix(".yaml") for file in _PRESETS.iterdir() if file.name.endswith(".yaml"))


def preset_text(name: str) -> str:
    """Return the file of a preset."""
    return (_PRESETS / f"{name}.yaml").read_text()


def mistyped(name: str, kind: Any, value: Any) -> ConfigError:
    """Return the error for a value of the wrong type, with the nearest valid value if there is one."""
    many = get_origin(kind) is tuple
    item = get_args(kind)[0] if many else kind
    nouns = {int: ("an integer", "integers"), float: ("a number", "numbers"), str: ("text", "texts")}
    expected = nouns.get(item, ("a value", "values"))[many]
    choices = get_args(item) if get_origin(item) is Literal else ("True", "False") if item is bool else ()
    if choices:
        expected = f"{'some' if many else 'one'} of {', '.join(choices)}"
    hint = nearest(str(value), choices)
    if kind is int:
        with contextlib.suppress(ValueError, TypeError, OverflowError):
            hint = f"; the nearest is {round(float(value))}"
    return ConfigError(f"{name}: expected {'a list of ' * many}{expected}, got {_show(value)}{hint}")


def from_text(name: str, kind: Any, text: str) -> Any:
    """Read one value of a field from its text, as strictly as from YAML; raise `ConfigError` for another type."""
    try:
        value = text if kind is str or get_origin(kind) is Literal else yaml.load(text, Loader=_Loader)
    except yaml.YAMLError:
        value = text
    return _coerce(name, kind, value)


def closest(name: str, names: Iterable[str]) -> str | None:
    """Return the one of the dotted `names` that `name` stands for: by another library's name, by its last part, or by
    its spelling; None if none is similar."""
    names, (group, _, end) = list(names), name.rpartition(".")
    synonym = SYNONYMS.get(end, name)
    for candidate in (f"{group}.{synonym.rpartition('.')[2]}", synonym):
        if candidate in names:
            return candidate
    same_end = [other for other in names if other.rpartition(".")[2] == end]
    matches = difflib.get_close_matches(name, same_end or names, n=1, cutoff=0.0 if same_end else 0.6)
    return matches[0] if matches else None


def nearest(name: str, names: Iterable[str], prefix: str = "") -> str:
    """Return `; the nearest is ...` for the end of a message, empty if no name is similar."""
    match = closest(name, names)
    return f"; the nearest is {prefix}{match}" if match else ""


def as_integer(value: float | str) -> int:
    """Return the integer that is written as a float or with an exponent, such as 1e6, or raise ValueError."""
    if not float(value).is_integer():
        raise ValueError(f"{value} is no integer")
    return int(float(value))


class _Loader(yaml.SafeLoader):
    """A loader that refuses a key twice in one mapping; YAML's usual loader silently keeps the last."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        names = [key.value for key, _ in node.value]
        for name in names:
            if names.count(name) > 1:
                raise yaml.MarkedYAMLError(problem=f"{name} stands twice", problem_mark=node.start_mark)
        return super().construct_mapping(node, deep)


def _read_text(source: str) -> str:
    if not source.endswith((".yaml", ".yml")) and "/" not in source:
        if source not in preset_names():
            hint = nearest(source, preset_names()) or f"; there are {', '.join(preset_names())}"
            raise ConfigError(f"unknown preset {source!r}{hint} (a file's name ends in .yaml)")
        return preset_text(source)
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
    for key, value in changes.items():
        name = f"{prefix}{key}"
        if key not in kinds:
            fields = [f"{prefix}{field}" for field in kinds] + [BASE] * (not prefix)
            hint = nearest(name, [*fields, *field_types()]) or f"; there are {', '.join(fields)}"
            raise ConfigError(f"unknown field {name}{hint}")
        old, kind = getattr(default, key), kinds[key]
        is_group = dataclasses.is_dataclass(kind)
        values[key] = _override(old, value, f"{name}.") if is_group else _coerce(name, kind, value)
    return dataclasses.replace(default, **values)


def _coerce(name: str, kind: Any, value: Any) -> Any:
    """Check a YAML value strictly; but integers and 1e-3, a text in YAML 1.1, are floats, and 1e6 is an integer."""
    try:
        if get_origin(kind) is tuple and isinstance(value, list):
            return tuple(_coerce(name, get_args(kind)[0], item) for item in value)
        if kind is float and isinstance(value, int | str) and not isinstance(value, bool):
            return float(value)
        if kind is int and (isinstance(value, float) or (isinstance(value, str) and "e" in value.lower())):
            return as_integer(value)
    except (ValueError, OverflowError):
        raise mistyped(name, kind, value) from None
    if value in get_args(kind) if get_origin(kind) is Literal else type(value) is kind:
        return value
    raise mistyped(name, kind, value)


def _show(value: Any) -> str:
    text = "nothing" if value is None else repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
