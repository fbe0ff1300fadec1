"""Errors that a user can cause or correct; one line each."""

import difflib
from collections.abc import Iterable


def nearest(name: str, names: Iterable[str], cutoff: float = 0.0) -> str | None:
    """Return the name most like `name`, or None if the likeness of all, from 0 to 1, is below the cutoff."""
    return next(iter(difflib.get_close_matches(name, list(names), n=1, cutoff=cutoff)), None)


class UnknownNameError(ValueError):
    """A name, of an environment say, that does not exist; the message gives the nearest that does."""

    def __init__(self, kind: str, name: str, valid: Iterable[str]):
        valid = list(valid)
        similar = nearest(name, valid, cutoff=0.5)
        hint = f"did you mean {similar!r}? " if similar else ""
        super().__init__(f"unknown {kind} {name!r}: {hint}valid: {', '.join(valid)}")


class MissingExtraError(ImportError, ValueError):
    """A package that is not installed; the message gives the line that installs it, None being no extra."""

    def __init__(self, package: str, extra: str | None):
        requirement = f"taic-jax[{extra}]" if extra else "taic-jax"
        super().__init__(f"the package {package} is not installed: pip install '{requirement}'", name=package)


class BackendError(ValueError):
    """A physics backend that does not run on this machine."""

    def __init__(self, backend: str, requirement: str):
        super().__init__(f"env.backend: {backend} needs {requirement}; the nearest that runs here is mjx")


class EnvOptionError(ValueError):
    """An option of `make_env` that the task does not have."""

    def __init__(self, task: str, option: str, value: object, options: Iterable[str]):
        valid = ", ".join(options) or "none"
        super().__init__(f"env.{option}: {task} has no such option, got {value!r}; its options: {valid}")


class AdapterError(ValueError):
    """An environment that does not fit an adapter, or a wrong use of an adapter."""


class ModelError(ValueError):
    """A robot's model that lacks what a task needs, or has what the physics cannot carry; one line."""

    def __init__(self, name: str, problem: str):
        super().__init__(f"model {name}: {problem}")


class ContractError(ValueError):
    """An environment that breaks the contract of `Env`; the message starts with its name and the field."""

    def __init__(self, environment: str, field: str, problem: str):
        super().__init__(f"{environment}: {field}: {problem}")


class RenderingError(RuntimeError, ValueError):
    """This machine cannot draw MuJoCo scenes."""
