"""One self-contained page: everything collected, and the style and the script that draw it, in one HTML file."""

import base64
import dataclasses
import html
import json
import time
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from taic_jax.report.curves import stage_curves
from taic_jax.report.option_plots import option_plot
from taic_jax.report.results import facts_of, histograms_of, methods_of
from taic_jax.report.runs import (
    UNTRAINED_STAGES,
    LoadedRun,
    ReportError,
    check_seeds,
    default_fields,
    read_run,
    unique_names,
)
from taic_jax.report.sweeps import SweepData, is_sweep, read_sweep
from taic_jax.runtime.files import save_text

SCRIPTS = ("page.js", "charts.js", "scatter.js", "tables.js", "sections.js")
GENERATOR = '<meta name="generator" content="taic_jax.report">'


@dataclasses.dataclass(frozen=True)
class Detail:
    """How much of the runs a page holds.

    Attributes:
      points: of a curve at most.
      options: in the picture of an option space; 0 leaves these pictures out.
      videos: whether they are embedded.
    """

    points: int = 300
    options: int = 1000
    videos: bool = True


def write_report(folders: Sequence[Path], out: Path, detail: Detail = Detail()) -> None:
    """Write the report on runs and sweeps to `out`, whole or not at all.

    Raises:
      ReportError: one of them cannot be reported on, or `out` is a file that is no report.
    """
    if out.is_dir():
        raise ReportError(
            f"--out: expected a file to write, got the folder {out}; the nearest is {out / 'report.html'}"
        )
    if out.exists() and GENERATOR not in out.read_text(errors="replace")[:1000]:
        raise ReportError(f"--out: {out} is there and is no report, so it is not replaced; name another file")
    if not out.parent.is_dir():
        raise ReportError(f"--out: expected a file in a folder that is there, got {out}: make {out.parent} first")
    save_text(out, render(collect(folders, detail)))


def collect(folders: Sequence[Path], detail: Detail = Detail()) -> dict[str, Any]:
    """Return everything a page shows of runs and sweeps, ready for JSON."""
    runs, sweeps = _read(folders)
    return {
        "made": time.strftime("%Y-%m-%d %H:%M"),
        "runs": [_collect_run(run, detail) for run in runs],
        "sweeps": [dataclasses.asdict(sweep) for sweep in sweeps],
        "defaults": default_fields(),
        "notes": _differences(runs),
    }


def render(data: dict[str, Any]) -> str:
    """Return the page that shows `data`; no text in it can end the script element that holds it."""
    files = resources.files("taic_jax.report")
    names = ", ".join(run["name"] for run in data["runs"])
    parts = {
        "TITLE": html.escape(f"{names} — taic_jax"[:120]),
        "STYLE": (files / "page.css").read_text(),
        "SCRIPT": "\n".join((files / name).read_text() for name in SCRIPTS),
        "DATA": json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c"),
    }
    before, *rest = (files / "page.html").read_text().split("{{")
    pieces = (piece.partition("}}") for piece in rest)
    return before + "".join(parts[name] + after for name, _, after in pieces)


def _read(folders: Sequence[Path]) -> tuple[list[LoadedRun], list[SweepData]]:
    """Read every folder, in the order given; a sweep's points are runs."""
    runs, sweeps = [], []
    for folder, name in zip(folders, unique_names(folders), strict=True):
        if is_sweep(folder):
            sweep, points = read_sweep(folder, name)
            sweeps.append(sweep)
            runs += points
        else:
            runs.append(read_run(folder, name))
    for run in runs:
        check_seeds(run)
    return runs, sweeps


def _collect_run(run: LoadedRun, detail: Detail) -> dict[str, Any]:
    stages = list(dict.fromkeys(row["stage"] for row in run.rows if row["stage"] not in UNTRAINED_STAGES[:1]))
    plot = option_plot(run, detail.options) if detail.options else {"missing": "left out by --options 0"}
    return {
        "name": run.name,
        "folder": str(run.folder),
        "facts": facts_of(run),
        "notes": list(run.notes),
        "methods": methods_of(run),
        "histograms": histograms_of(run),
        "stages": [stage_curves(run, stage, detail.points) for stage in stages],
        "options": plot,
        "video": _video(run) if detail.videos and not run.point else None,
        "config": run.fields,
    }


def _video(run: LoadedRun) -> str | None:
    """Return the video as a data URI, or None if there is none."""
    path = run.folder / "video.webp"
    return "data:image/webp;base64," + base64.b64encode(path.read_bytes()).decode() if path.is_file() else None


def _differences(runs: Sequence[LoadedRun]) -> list[str]:
    """Tell what keeps runs from being compared number by number."""
    notes = []
    for what, values in (
        ("task", [run.task for run in runs]),
        ("number of seeds", [str(run.seeds) for run in runs]),
        ("commit", [str(run.summary.get("commit"))[:8] for run in runs if run.summary]),
        *((f"version of {name}", seen) for name, seen in _versions(runs).items()),
    ):
        different = list(dict.fromkeys(values))
        if len(different) > 1:
            notes.append(f"the runs differ in {what}: {', '.join(different)}".replace("None", "not recorded"))
    return notes


def _versions(runs: Sequence[LoadedRun]) -> dict[str, list[str]]:
    """Return for each package the versions the finished runs had."""
    told = [run.summary.get("versions") or {} for run in runs if run.summary]
    names = dict.fromkeys(name for versions in told for name in versions)
    return {name: [str(versions.get(name)) for versions in told if versions] for name in names}
