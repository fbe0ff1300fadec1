"""The report as a browser shows it: opened from a file, without a network, in every view that its address names."""

import html
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from tiny_runs import CONFIG, with_fields
from written_runs import rows, write_options, write_run

from taic_jax.report.page import Detail, write_report

NAMES = ("chromium", "chromium-browser", "google-chrome")
BROWSER = next((found for name in NAMES if (found := shutil.which(name))), "")
EVIL = "<img src=x onerror=alert(1)></script>"

pytestmark = pytest.mark.skipif(not BROWSER, reason="no Chromium on PATH, which draws the page")


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Path:
    """Write the report on a finished run with options, and on one that is partial and has another config."""
    folder = tmp_path_factory.mktemp("report")
    whole = write_run(folder / "whole")
    write_options(whole, experience=False)
    other = with_fields(CONFIG, train__ppo__gamma=0.5, collect__env=EVIL)
    write_run(folder / "part", other, finished=False, written=rows(4)[:-2])
    write_report([whole, folder / "part"], folder / "report.html", Detail(points=3, options=30))
    return folder / "report.html"


def shown(page: Path, view: str = "", *arguments: str) -> str:
    """Return the document after its script has run, in a view; fail if the browser's console tells an error."""
    command = [BROWSER, "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking"]
    command += [f"--user-data-dir={page.parent / 'profile'}", "--virtual-time-budget=3000", "--enable-logging=stderr"]
    done = subprocess.run(
        [*command, *arguments, "--dump-dom", f"{page.as_uri()}#{view}"], capture_output=True, text=True, timeout=120
    )
    told = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    assert not told, told
    assert re.search(r'<body[^>]* data-ready="true"[^>]*>', done.stdout) and "data-errors" not in done.stdout
    return re.sub(r"<script.*?</script>", "", done.stdout, flags=re.DOTALL)


def chart(document: str, task: str = "nav2d") -> str:
    (found,) = re.findall(rf'<figure class="chart" data-task="{task}".*?</figure>', document, re.DOTALL)
    return found


def curves(document: str, kind: str) -> list[str]:
    """Return the d of every path of a kind in the chart of the task."""
    return re.findall(rf'<path class="{kind}(?: dashed)?" d="([^"]*)"', chart(document))


def test_draws_curves_tables_options_and_video(page):
    document = shown(page)
    means = curves(document, "mean")
    # Two stages of the whole run; the other's collector is on another task.
    assert len(means) == 3 and len(curves(document, "seed")) == 6 and len(curves(document, "band")) == 3
    assert all(re.fullmatch(r"M[\d.]+ [\d.]+(L[\d.]+ [\d.]+){2}", mean) for mean in means)
    dots = re.search(r'<g class="dots">(.*?)</g>', document, re.DOTALL)
    assert dots and dots[1].count("<circle") == 30 and len(set(re.findall(r'fill="(rgb[^"]*)"', dots[1]))) > 5
    assert document.count('<rect class="bar"') == 6 and '<img src="data:image/webp;base64,' in document
    text = html.unescape(re.sub(r"<[^>]*>", "|", document))
    for part in ("12|11 … 13", "partial", "not evaluated yet", "stage train is at", "1 of them partial", "Decimated"):
        assert part in text, part


def test_text_of_configs_stays_text(page):
    document = shown(page)
    assert '<img src="x"' not in document and html.escape(EVIL, quote=False) in document


def test_marks_what_differs_among_configs(page):
    differing = set(re.findall(r'<tr class="differs" data-field="([^"]*)"', shown(page)))
    assert differing == {"train.ppo.gamma", "collect.env"}


def test_the_address_chooses_metric_axis_and_what_is_shown(page):
    plain, moved = shown(page), shown(page, "x=all")
    assert curves(plain, "mean") != curves(moved, "mean") and "pre-training counted in" in chart(moved)
    without = shown(page, "seeds=off&band=off")
    assert not curves(without, "seed") and not curves(without, "band") and len(curves(without, "mean")) == 3
    entropy = shown(page, "metric=entropy")
    assert "entropy on nav2d" in chart(entropy) and curves(entropy, "mean") != curves(plain, "mean")
    hidden = shown(page, "hide=0.train")
    assert len(curves(hidden, "mean")) == 2 and chart(hidden).count('aria-pressed="false"') == 1


def test_the_address_zooms_and_colours(page):
    zoomed = shown(page, "zoom=nav2d:20:40&coordinate=whole:1&fields=all")
    assert curves(zoomed, "mean") != curves(shown(page), "mean")
    assert not re.search(r"<button[^>]*hidden[^>]*>Whole range", chart(zoomed))
    assert "coloured by the change of coordinate 1" in zoomed and 'class="wide only"' not in zoomed


def test_gaps_are_not_bridged_and_a_logarithmic_axis_has_no_place_for_zero(page):
    losses = shown(page, "metric=kl_loss")  # of both runs the second seed has no number, and so the mean has none
    assert [bool(path) for path in curves(losses, "seed")] == [True, False] * 2 and curves(losses, "mean") == [""] * 2
    entropies = shown(page, "metric=entropy&log=on")  # 1, 0, -1 and -1, -2, -3
    assert set(curves(entropies, "mean")) == {""} and "left out" in chart(entropies)
    assert {path.count("L") for path in curves(entropies, "seed") if path} == {0}


def test_is_drawn_in_the_dark_and_in_a_narrow_window(page):
    document = shown(page, "", "--blink-settings=preferredColorScheme=0", "--window-size=500,800")
    width = re.search(r'<svg width="(\d+)"', chart(document))
    assert width and 300 < int(width[1]) < 480 and len(curves(document, "mean")) == 3


def test_nothing_is_fetched(page):
    text = page.read_text()
    assert "default-src 'none'" in text
    assert not re.search(r'(?:src|href)="(?!data:)[a-z]+:|url\(["\']?http|@import|fetch\(|XMLHttpRequest', text)
