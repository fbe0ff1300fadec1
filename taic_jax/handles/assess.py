"""Evaluate the agents of a finished run anew: `taic evaluate RUN`; see docs/use.md. Nothing is trained or changed."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from taic_jax import __version__
from taic_jax.config import impossible, method_label
from taic_jax.handles import command
from taic_jax.handles.command import answer, methods_of

if TYPE_CHECKING:
    from taic_jax.handles.load import Handle

PROGRAM = "taic evaluate"
NAMES = {"duration": "ticks of an option", "length": "ticks of an episode"}


@dataclass(frozen=True)
class Command(command.Command):
    """Evaluate the agents of a finished run in new episodes: a table with intervals over seeds, and a JSON file."""

    episodes: int = 100
    """Episodes of each seed's agent, each from a fresh start."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE.json")] = None
    """File for all that was measured, per seed."""


def main(args: Sequence[str]) -> int:
    """Run one command and return its exit code: 0, or 2 for a mistake."""
    return answer(args, PROGRAM, Command, execute)


def execute(command: Command, handle: "Handle") -> None:
    """Evaluate, print the table and write the file."""
    if command.episodes < 1:
        raise impossible("--episodes", command.episodes, "at least 1", 1)
    if command.out and not command.out.parent.is_dir():
        raise impossible("--out", command.out, "a file in a folder that exists", command.out.name)
    methods = methods_of(command, handle)
    from rich.console import Console

    from taic_jax.runtime.files import save_json
    from taic_jax.runtime.run_folder import RunFolder

    run = RunFolder(Path(command.run))
    trained: Any = run.summary()["methods"] if run.finished else {}
    results = {name: measure(handle, name, command, trained.get(name)) for name in methods}
    if command.out:
        about = {"run": command.run, "env": handle.config.env.name, "episodes": command.episodes, "key": command.key}
        save_json(command.out, {**about, "explore": command.explore, "taic_jax": __version__, "methods": results})
    labels = [method_label(name, handle.config.collect.learner) for name in results]
    Console().print(as_table(results, labels, f"return on {handle.env.name}, {command.episodes} episodes a seed"))


def measure(handle: "Handle", method: str, command: Command, trained: Any = None) -> dict[str, Any]:
    """Return statistics over seeds of the return, the ticks of episodes and options, and the task's metrics.

    Seeds that stopped in training have no numbers, as in the summary `trained` of the method.
    """
    import jax
    import numpy as np

    from taic_jax.analysis.evaluate import evaluate
    from taic_jax.analysis.statistics import summarize

    agents = handle.agents[method]
    keys = jax.random.split(jax.random.key(command.key), len(agents))

    def one(agent: Any, key: Any) -> dict[str, Any]:
        return evaluate(handle.env, agent, key, command.episodes, float(command.explore))

    values = jax.device_get(jax.jit(jax.vmap(one))(agents.rows, keys))
    counts = values.pop("durations")
    values["duration"] = counts @ np.arange(1.0, counts.shape[1] + 1) / counts.sum(axis=1)
    lost = [x is None for x in trained["return"]["per_seed"]] if trained else False
    return {name: summarize(np.where(lost, np.nan, x)) for name, x in values.items()}


def as_table(results: dict[str, dict[str, Any]], labels: Sequence[str], title: str) -> Any:
    """Return a table with a column per method: the return with its interval over seeds, and means of all metrics."""
    from rich.box import SIMPLE
    from rich.table import Table

    table = Table("", *labels, box=SIMPLE, title=title, title_justify="left", title_style="")
    returns = [values["return"] for values in results.values()]
    table.add_row("mean", *(_cell(",.1f", x["mean"]) for x in returns))
    table.add_row("interquartile mean", *(_cell(",.1f", x["iqm"]) for x in returns))
    intervals = ["one seed" if len(x["per_seed"]) == 1 else _cell(",.1f", *x["ci95"]) for x in returns]
    table.add_row("95 % interval", *intervals, end_section=True)
    for name in sorted(set(next(iter(results.values()))) - {"return"}):
        table.add_row(NAMES.get(name, name), *(_cell(".4g", values[name]["mean"]) for values in results.values()))
    return table


def _cell(form: str, *values: float | None) -> str:
    return " … ".join("a seed diverged" if x is None else format(x, form) for x in dict.fromkeys(values))
