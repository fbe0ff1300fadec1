"""The table of every kind of options on every robot: returns, durations, and measures of the option space."""

import dataclasses
from pathlib import Path

import numpy as np

from taic_jax.analysis.statistics import probability_of_improvement
from taic_jax.experiments.evidence.measures import PREFIX
from taic_jax.experiments.evidence.plan import BASELINE, FLAT, METHODS, OTHERS, ROBOTS
from taic_jax.experiments.evidence.table import RESULTS, TABLE, EvidenceRows, TableError, read_table, with_interval
from taic_jax.experiments.figures.drawing import read_methods
from taic_jax.runtime.files import save_text

# Heading, and the number per seed below it.
COLUMNS = {
    "untrained": "first",
    "return": "last",
    "of mean options": "mean_option",
    "ticks an option": "duration",
    "KL, nats": f"{PREFIX}kl",
    "active dimensions": f"{PREFIX}active_dimensions",
    "distance correlation": f"{PREFIX}prior/one/distance_correlation",
    "the same, many states": f"{PREFIX}prior/many/distance_correlation",
    "R² of the change": f"{PREFIX}window/mlp_r2/change",
    "R² of the first state": f"{PREFIX}window/mlp_r2/start",
}
KINDS = ("task", "termination", "decoder", "constraints", "seeds")
NOTE = """Interquartile means over seeds and their 95 % intervals, of the runs of figures 6 and 7; a cell that is
missing has no run yet. *untrained* and *return* are those of the policy as it explores, *P* is the probability that a
seed returns more than one of strong flat PPO at the same ticks of the task. Distance correlation is that of the code
and the state change of options from the prior, executed from one state, and from many; R² is that of an MLP fitted to
the codes of windows.

Made by `python -m taic_jax.experiments.figures table`.
"""


@dataclasses.dataclass(frozen=True)
class OptionTable:
    """Write the table of all kinds of options."""

    table: Path = TABLE  # The table of finished runs.
    out: Path = RESULTS / "options.md"  # The file, in Markdown.

    def make(self) -> None:
        """Write the table."""
        rows, lines = read_table(self.table), []
        for task in ROBOTS:
            methods = read_methods(rows, task, dict.fromkeys(METHODS | OTHERS, 1))
            lines += [line(runs, methods.get(BASELINE)) for runs in methods.values()]
        if not lines:
            raise TableError(f"{self.table}: no run of a robot; python -m taic_jax.experiments.evidence makes them")
        headings = [*KINDS, "P", *COLUMNS]
        table = "".join(f"| {' | '.join(cells)} |\n" for cells in [headings, ["---"] * len(headings), *lines])
        save_text(self.out, f"# Options, of every kind\n\n{table}\n{NOTE}")
        print(self.out)


def kind(method: str) -> list[str]:
    """Return the words for a method's termination, decoder and constraints."""
    if method in FLAT:
        return [METHODS[method][0], "", ""]
    rule, decoder, constraints, *tuned = method.split("-")
    return [rule, ", ".join([decoder, *("fine-tuned" for _ in tuned)]), constraints]


def cell(values: np.ndarray | None) -> str:
    """Return an interquartile mean with its interval, to two digits or whole numbers; an empty text without values."""
    if values is None:
        return ""
    mean, low, high = (f"{x:.0f}" if abs(x) >= 100 else f"{x:.2g}" for x in with_interval(values).values())
    return mean if low == high else f"{mean} ({low} … {high})"


def line(runs: EvidenceRows, flat: EvidenceRows | None) -> list[str]:
    """Return the cells of one method on one task."""
    p = ""
    if flat is not None and flat is not runs:
        p = f"{probability_of_improvement(runs.numbers['last'], flat.numbers['last'])[0]:.2f}"
    cells = (cell(runs.numbers.get(name)) for name in COLUMNS.values())
    return [runs.task, *kind(runs.method), str(len(runs.seeds)), p, *cells]
