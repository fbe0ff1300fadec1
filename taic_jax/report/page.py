"""One self-contained HTML file: the data of runs, and the style and the script that draw it."""

import base64
import dataclasses
import html
import json
import time
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from taic_jax.config import Config, walk
from taic_jax.report.curves import stage_curves
from taic_jax.report.option_plots import option_plot
from taic_jax.report.results import facts_of, histograms_of, methods_of
from taic_jax.report.runs import LoadedRun, ReportError, check_seeds, read_run, unique_names
from taic_jax.report.sweeps import read_sweep
from taic_jax.runtime.files import save_text
from taic_jax.sweep.runs import PLAN

SCRIPTS = ("page.js", "charts.js", "curves.js", "scatter.js", "tables.js", "sections.js")
GENERATOR = '<meta name="generator" content="taic_jax.report">'


@dataclasses.dataclass(frozen=True)
class Detail:
    """The amount of detail of a page."""

    points: int = 300  # of a curve at most
    options: int = 1000  # in the picture of an option space; 0 leaves these pictures out
    videos: bool = True  # whether they are embedded


def write_report(folders: Sequence[Path], out: Path, detail: Detail = Detail()) -> None:
    """Write the report on runs and sweeps to `out`, atomically, or raise ReportError; replace no other file."""
    if out.is_dir():
        nearest = out / "report.html"
        raise ReportError(f"--out: expected a file to write, got the folder {out}; the nearest is {nearest}")
    if out.exists() and GENERATOR not in out.read_text(errors="replace")[:1000]:
        raise ReportError(f"--out: {out} is there and is no report, so it is not replaced; name another file")
    if not out.parent.is_dir():
        raise ReportError(f"--out: expected a file in a folder that is there, got {out}: make {out.parent} first")
    save_text(out, render(collect(folders, detail)))


def collect(folders: Sequence[Path], detail: Detail = Detail()) -> dict[str, Any]:
    """Return the data of a page on runs and sweeps, ready for JSON; a sweep's points are runs."""
    runs, sweeps = [], []
    for folder, name in zip(folders, unique_names(folders), strict=True):
        if (folder / PLAN).is_file():
            sweep, points = read_sweep(folder, name)
            sweeps.append(sweep)
            runs += points
        else:
            runs.append(read_run(folder, name))
    for run in runs:
        check_seeds(run)
    return {
        "made": time.strftime("%Y-%m-%d %H:%M"),
        "runs": [_collect_run(run, detail) for run in runs],
        "sweeps": sweeps,
        "defaults": dict(walk(Config())),
        "notes": _differences(runs),
    }


def render(data: dict[str, Any]) -> str:
    """Return the page on `data`, escaped so that no text ends the script element around it."""
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


def _collect_run(run: LoadedRun, detail: Detail) -> dict[str, Any]:
    video = run.folder / "video.webp"
    shows = detail.videos and not run.point and video.is_file()
    return {
        "name": run.name, "folder": str(run.folder), "facts": facts_of(run), "notes": list(run.notes),
        "methods": methods_of(run), "histograms": histograms_of(run),
        "stages": [stage_curves(run, stage, detail.points) for stage in run.stages()],
        "options": option_plot(run, detail.options), "measures": (run.summary or {}).get("options", {}),
        "video": f"data:image/webp;base64,{base64.b64encode(video.read_bytes()).decode()}" if shows else None,
        "config": run.fields,
    }  # fmt: skip


def _differences(runs: Sequence[LoadedRun]) -> list[str]:
    """Return notes on every difference that bars a comparison of numbers."""
    finished = [run.summary for run in runs if run.summary]
    versions = [summary["versions"] for summary in finished if summary.get("versions")]
    values = {
        "task": [run.task for run in runs],
        "number of seeds": [str(run.seeds) for run in runs],
        "commit": [str(summary.get("commit"))[:8] for summary in finished],
    }
    for name in dict.fromkeys(name for of_run in versions for name in of_run):
        values[f"version of {name}"] = [str(of_run.get(name)) for of_run in versions]
    return [
        f"the runs differ in {name}: {', '.join(dict.fromkeys(texts))}".replace("None", "not recorded")
        for name, texts in values.items()
        if len(set(texts)) > 1
    ]
