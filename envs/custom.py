"""Environments of your own: a class in a Python file or an importable module, by its name."""

import hashlib
import importlib
import importlib.util
import inspect
import pkgutil
import sys
import traceback
from pathlib import Path
from types import ModuleType
from typing import Any, NoReturn

from taic_jax.envs.base import Env
from taic_jax.envs.errors import UnknownNameError, nearest

FORMS = "FILE.py:CLASS or MODULE:CLASS"


class CustomEnvError(ValueError):
    """An environment of the user's own cannot be loaded; the message is one line."""


def load_custom(name: str, backend: str = "auto", num_threads: int = 0) -> Env:
    """Make an environment of `FILE.py:CLASS` or `MODULE:CLASS`; a file is imported once.

    The class receives those of `backend` and `num_threads` that are parameters of its `__init__`.

    Raises:
      UnknownNameError: the module has no such class; the message names its nearest subclass of `Env`.
      CustomEnvError: there is no such file or module, the class is no subclass of `Env` or an abstract one, or its
        import or `__init__` raises.
    """
    source, _, class_name = name.rpartition(":") if not name.endswith(".py") else (name, "", "")
    if not source:
        raise CustomEnvError(f"environment {name!r}: expected {FORMS}")
    module = _load_file(source) if source.endswith(".py") else _load_module(source)
    cls = _find_class(module, source, class_name)
    parameters = inspect.signature(cls.__init__).parameters
    engine = {"backend": backend, "num_threads": num_threads}
    try:
        return cls(**{key: value for key, value in engine.items() if key in parameters})
    except Exception as error:
        _failed(f"making {name}", getattr(module, "__file__", None), error)


def _load_file(source: str) -> ModuleType:
    """Import a file under a unique name; a second time, return the same module."""
    path = Path(source).resolve()
    if not path.is_file():
        similar = nearest(path.name, (file.name for file in path.parent.glob("*.py")))
        hint = f"the nearest is {Path(source).parent / similar}" if similar else f"{path.parent} holds no .py files"
        raise CustomEnvError(f"environment in {source}: no such file; {hint}")
    # The file's own name may be that of another module, or have dots, i.e. a parent.
    name = f"custom_env_{hashlib.sha256(str(path).encode()).hexdigest()}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec and spec.loader, "the file's name ends in .py"
    module = sys.modules[name] = importlib.util.module_from_spec(spec)  # dataclasses look their module up there
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        del sys.modules[name]
        _failed(f"importing {source}", str(path), error)
    return module


def _load_module(source: str) -> ModuleType:
    try:
        return importlib.import_module(source)
    except (Exception, SystemExit) as error:
        missing = error.name if isinstance(error, ModuleNotFoundError) else None
        if missing is None or not f"{source}.".startswith(f"{missing}."):
            _failed(f"importing {source}", None, error)
        parent, dot, name = missing.rpartition(".")
        folders = getattr(sys.modules[parent], "__path__", []) if parent else None
        similar = nearest(name, (module.name for module in pkgutil.iter_modules(folders)))
        hint = f"the nearest is {parent}{dot}{similar}" if similar else f"{parent} holds none"
        raise CustomEnvError(f"environment in {source}: no module {missing}; {hint}; expected {FORMS}") from error


def _find_class(module: ModuleType, source: str, class_name: str) -> Any:
    """Return the class, or raise an error that names the nearest."""
    name, value = f"{source}:{class_name}", getattr(module, class_name, None)
    if _is_environment(value):
        if missing := sorted(getattr(value, "__abstractmethods__", ())):
            raise CustomEnvError(f"environment {name}: expected it to define {', '.join(missing)}")
        return value
    names = [f"{source}:{key}" for key, each in vars(module).items() if _is_environment(each) and each is not Env]
    if value is None and names:
        raise UnknownNameError("environment", name, names)
    similar = nearest(name, names)
    hint = f"the nearest is {similar}" if similar else f"{source} has none"
    got = "nothing of this name" if value is None else f"class {class_name}" if isinstance(value, type) else repr(value)
    raise CustomEnvError(f"environment {name}: expected a subclass of taic_jax.envs.Env, got {got}; {hint}")


def _is_environment(value: Any) -> bool:
    return isinstance(value, type) and issubclass(value, Env)


def _failed(doing: str, path: str | None, error: BaseException) -> NoReturn:
    """Raise the error of the user's code in one line, with the innermost line of `path`, or else of any file."""
    frames = traceback.extract_tb(error.__traceback__)
    frame = ([frame for frame in frames if frame.filename == path] or frames)[-1]
    message = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    place = "" if isinstance(error, SyntaxError) else f" (line {frame.lineno} of {frame.filename})"
    raise CustomEnvError(" ".join(f"{doing}: {message}{place}".split())) from error
