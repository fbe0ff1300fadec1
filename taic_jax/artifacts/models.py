"""Artifacts of a run for other runs: folders of `arrays.safetensors` and `description.json`; option models [K].

Both files are data: reading them executes nothing.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import safetensors.numpy
from safetensors import SafetensorError

from taic_jax import __version__
from taic_jax.artifacts.pretrained import locate
from taic_jax.config import TAIC, OptionsConfig
from taic_jax.envs.base import Env, Heading
from taic_jax.envs.views import Views, one_view
from taic_jax.options.model import OptionModel, Scale, init_params, make_networks
from taic_jax.runtime.checkpoint import ArtifactError, Tree, checksums, fit_tree, plain_arrays
from taic_jax.runtime.files import DESCRIPTION, atomic_file, read_description, save_json, writes_here, writing

DATA = "data"  # name of the body of recorded data, and of its task
OPTIONS, AGENTS, ARRAYS = "options", "agents", "arrays.safetensors"
FORMAT = 1  # of the two files; a later one is refused
MODEL = "executor.model."  # begins the names of an option model's arrays among those of agents

# The fields in which a frozen option model must agree with the config that uses it: its shapes and their meaning.
STRUCTURE = (
    "decoder",
    "size",
    "length",
    "termination",
    "hidden_size",
    "mlp_sizes",
    "decoder_sizes",
    "codes",
    "frame",
    "way_weight",
    "choose",
)


# What the first descriptions do not say, there being nothing else.
EARLIER = {
    "learner": "ppo", "discrete": False, "heading": None, "options.codes": 0, "options.frame": "world",
    "options.way_weight": 0, "options.choose": "code", "sides": 1,
    "action_bounds": (),
}  # fmt: skip


class Body(NamedTuple):
    """The environment of an artifact by its description: enough to read the artifact without the environment.

    `action_bounds` are those of recorded data, whose body is `DATA`: see `OptionsConfig`.
    """

    name: str
    proprioception: str
    proprioceptive_size: int
    action_size: int
    discrete: bool = False
    sides: int = 1
    heading: Heading | None = None
    action_bounds: tuple[float, ...] = ()

    @property
    def views(self) -> Views:
        """The one view, in which data are recorded."""
        return one_view(self.proprioceptive_size, self.action_size)


def read_body(folder: Path) -> Body:
    """Return the body in an artifact's description, or raise ArtifactError without one."""
    description = EARLIER | (read_description(folder) or {})
    try:
        body = Body(description["env"], *(description[name] for name in Body._fields[1:]))
        return body._replace(heading=body.heading and Heading(*body.heading), action_bounds=tuple(body.action_bounds))
    except KeyError:
        raise ArtifactError(f"{folder / DESCRIPTION}: expected the description of an artifact, got none") from None


def describe(env: Env | Body) -> dict[str, Any]:
    """Return the description of a body: the name and size of its slice, and the number of its actions."""
    return {
        "env": env.name,
        "proprioception": getattr(env, "proprioception", env.name),
        "proprioceptive_size": env.proprioceptive_size,
        "action_size": env.action_size,
        "discrete": env.discrete,
        "sides": env.sides if isinstance(env, Body) else len(env.views),
        "heading": env.heading and list(env.heading),
    }


def check_description(folder: Path, kind: str, env: Env | Body, fields: dict[str, Any]) -> dict[str, Any]:
    """Return an artifact's description, or raise ArtifactError where it differs from this body and these fields.

    Options that were learnt from recorded data fit every body of their sizes.
    """
    description = described(folder, kind)
    unchecked = {"env", "sides", "heading"}
    if description.get("proprioception") == DATA:  # nobody but the user knows whether the entries mean the same
        unchecked.add("proprioception")
    body = {name: value for name, value in describe(env).items() if name not in unchecked}
    for name, value in {**body, **fields}.items():
        value = list(value) if isinstance(value, tuple) else value
        if description.get(name) != value:
            got, why = description.get(name), f"which {env.name} needs" if name in body else "as in this config"
            raise ArtifactError(f"{folder / DESCRIPTION}: {name}: expected {value!r}, {why}; got {got!r}")
    return description


def described(folder: Path, kind: str) -> dict[str, Any]:
    """Return an artifact's description, or raise ArtifactError without one, or if its format is a later one."""
    description = read_description(folder)
    if description is None:
        raise ArtifactError(f"{folder}: expected a run that got this far, or its {kind}; got none")
    if not isinstance(description.get("seeds"), int):
        raise ArtifactError(f"{folder / DESCRIPTION}: expected the description of an artifact, got another file")
    if (version := description.get("format", FORMAT)) > FORMAT:
        writer = f"taic_jax {description.get('taic_jax')} wrote format {version}"
        raise ArtifactError(f"{folder}: {writer}, this is taic_jax {__version__}, which reads formats to {FORMAT}")
    return EARLIER | description


def save_artifact(folder: Path, tree: Any, description: dict[str, Any]) -> None:
    """Save a tree of arrays as the artifact `folder`, or raise SaveError."""
    arrays = plain_arrays(tree)
    if writes_here():
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
            (folder / DESCRIPTION).unlink(missing_ok=True)  # until the arrays that it describes are whole
    with atomic_file(folder / ARRAYS) as file:
        file.write(safetensors.numpy.save(arrays))
    about = {"format": FORMAT, "taic_jax": __version__, "crc32": checksums(arrays)}
    save_json(folder / DESCRIPTION, about | description)


def load_artifact(folder: Path, kind: str, like: Tree, prefix: str = "") -> Tree:
    """Load the arrays whose names begin with `prefix` as a tree like `like`.

    Raises:
      ArtifactError: the files are damaged, of a later format, or hold another tree.
    """
    description, path = described(folder, kind), folder / ARRAYS
    try:
        arrays = safetensors.numpy.load_file(path)
        if checksums(arrays) != description.get("crc32"):
            raise SafetensorError
    except (OSError, SafetensorError):
        raise ArtifactError(f"{path}: expected an artifact, got files of another kind or damaged ones") from None
    arrays = {name.removeprefix(prefix): x for name, x in arrays.items() if name.startswith(prefix)}
    return fit_tree(path, arrays, description["taic_jax"], like)


def save_options(folder: Path, model: OptionModel, env: Env | Body, config: OptionsConfig) -> None:
    """Save option models [K] of `env` as the artifact `folder`."""
    bounds = {"action_bounds": list(env.action_bounds)} if isinstance(env, Body) else {}
    save_artifact(folder, model, describe(env) | bounds | structure(config) | {"seeds": len(model.delta)})


def load_options(source: str | Path, env: Env | Body, config: OptionsConfig, seeds: int) -> OptionModel:
    """Load option models [seeds] from a source, or raise ArtifactError; seed k takes model k modulo their number."""
    folder = options_folder(source)
    description = check_description(folder, "option model", env, structure(config))
    like = rows_like(description["seeds"], partial(empty_model, env, config))
    return for_seeds(seeds, load_artifact(folder, "option model", like, MODEL if "method" in description else ""))


def options_folder(source: str | Path) -> Path:
    """Return the artifact that a source's options are in: those it learnt; else those that its agents act with.

    A source is the folder of a run, or of an artifact, or `pretrained:NAME`.
    """
    path = locate(source)
    return next((folder for folder in (path / OPTIONS, path / AGENTS / TAIC) if folder.is_dir()), path)


def for_seeds(seeds: int, rows: Tree) -> Tree:
    """Return rows [seeds], of which the k-th is row k modulo their number."""
    return jax.tree.map(lambda x: x[jnp.arange(seeds) % len(x)], rows)


def empty_model(env: Env | Body, config: OptionsConfig) -> OptionModel:
    """Return an option model of this structure, whose numbers are not meaningful."""
    networks = make_networks(config, env.proprioceptive_size, env.action_size, env.discrete, env.heading)
    params, zeros = init_params(networks, config, jax.random.key(0)), jnp.zeros(env.proprioceptive_size)
    changes = jnp.zeros(networks.predictor.change_size)
    book = jnp.zeros((config.codes, config.size)) if config.codes else None
    model = OptionModel(params, Scale(zeros, zeros), Scale(changes, changes), jnp.zeros(()), networks, book)
    if config.choose != "way":
        return model
    count = describe(env)["sides"]
    return model.replace(views=one_view(env.proprioceptive_size, env.action_size, count))


def rows_like(count: int, make: Callable[[], Any]) -> Any:
    """Return the shapes of `count` rows of a tree."""
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct((count, *x.shape), x.dtype), jax.eval_shape(make))


def structure(config: OptionsConfig) -> dict[str, Any]:
    """Return the fields of STRUCTURE by dotted name, for a description."""
    return {f"options.{name}": getattr(config, name) for name in STRUCTURE}
