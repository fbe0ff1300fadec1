"""The frame of every figure: its arguments, the rows of its methods, and its files."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from matplotlib.figure import Figure as Picture

from taic_jax.analysis.statistics import holm
from taic_jax.experiments.evidence.numbers import write_numbers
from taic_jax.experiments.evidence.table import RESULTS, TABLE, EvidenceRows, TableError, read_table, select
from taic_jax.experiments.figures.drawing import save, styled

Rows = list[dict[str, Any]]  # Rows of the table of finished runs, or of the numbers of a figure.


class Panel(NamedTuple):
    """The rows of one task by method, and remarks on missing or mixed ones."""

    methods: dict[str, EvidenceRows]
    remarks: list[str]


@dataclasses.dataclass(frozen=True)
class Figure:
    """A figure: its arguments and its picture."""

    number: ClassVar[str]
    fields: ClassVar[tuple[str, ...]] = ()

    table: Path = TABLE  # The table of finished runs.
    out: Path | None = None
    """The picture, by default experiments/results/figureN.png; its numbers are written beside it as CSV."""

    def draw(self, rows: Rows) -> tuple[Picture, Rows]:
        """Return the picture of the table's rows, and its numbers; raise `TableError` if rows are missing or mixed."""
        raise NotImplementedError

    @styled
    def make(self) -> None:
        """Draw the figure, and write its numbers."""
        picture, numbers = self.draw(read_table(self.table))
        out = self.out or RESULTS / f"figure{self.number}.png"
        save(picture, out)
        write_numbers(numbers, out.with_suffix(".csv"), self.fields)


def read_methods(rows: Rows, task: str, methods: dict[str, tuple[str, int]]) -> Panel:
    """Return the methods, each with label and fewest seeds, that have rows of a task, and remarks."""
    panel = Panel({}, [])
    present = {row["method"] for row in rows if row["task"] == task}
    for method, (label, minimum) in methods.items():
        if method in present:
            panel.methods[method] = select(rows, task, method, minimum)
            panel.remarks.extend(f"{label}: {remark}" for remark in panel.methods[method].remarks)
    missing = [label for method, (label, _) in methods.items() if method not in present]
    if missing:
        panel.remarks.append("missing: " + ", ".join(missing))
    return panel


def read_panels(
    figure: Figure, rows: Rows, tasks: Sequence[str], methods: dict[str, tuple[str, int]]
) -> dict[str, Panel]:
    """Return the panel of each task; raise `TableError` if all are empty."""
    panels = {task: read_methods(rows, task, methods) for task in tasks}
    if not any(panel.methods for panel in panels.values()):
        expected = f"{figure.table}: no row of figure {figure.number}"
        raise TableError(f"{expected}; python -m taic_jax.experiments.evidence makes them")
    return panels


def numbers_of(panels: dict[str, Panel], numbers: Callable[[EvidenceRows, dict[str, EvidenceRows]], Rows]) -> Rows:
    """Return the rows of `numbers` for each method, beside the others on its task, p-values adjusted."""
    rows = [row for panel in panels.values() for runs in panel.methods.values() for row in numbers(runs, panel.methods)]
    adjust(rows)
    return rows


def adjust(rows: Rows) -> None:
    """Replace `p` by `p_holm`, adjusted over the tasks of each method (Holm)."""
    for method in {row["method"] for row in rows}:
        tested = [row for row in rows if row["method"] == method and "p" in row]
        for row, p in zip(tested, holm([row.pop("p") for row in tested]), strict=True):
            row["p_holm"] = float(p)
