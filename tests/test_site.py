"""The site builds without a warning, and its reference has every public name, every field and every command."""

import html
import re
import subprocess
import sys
from pathlib import Path

import pytest

import taic_jax
from taic_jax.__main__ import COMMANDS
from taic_jax.config import Config, field_types

pytest.importorskip("sphinx")
ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("site")
    args = ["-W", "--keep-going", "-q", "-c", "docs/site", "-d", str(out / "doctrees"), ".", str(out / "html")]
    done = subprocess.run([sys.executable, "-m", "sphinx", *args], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    return out / "html"


@pytest.mark.timeout(900)
def test_the_reference_has_every_name_field_and_command(site):
    page = (site / "docs/site/api.html").read_text()
    text = html.unescape(re.sub(r"<[^>]+>", "", page))
    assert not [name for name in taic_jax.__all__ if name != "__version__" and f'id="taic_jax.{name}"' not in page]
    rows = dict(
        re.findall(
            r"<tr.*?<td><p><code.*?><span class=\"pre\">([\w.]+)</span></code></p></td>(.*?)</tr>", page, re.DOTALL
        )
    )
    assert rows.keys() == field_types(Config).keys()
    helps = {name: row.rpartition("<td>")[2] for name, row in rows.items()}
    assert not [name for name, text in helps.items() if not re.match(r"<p>\w", text)], "fields without help"
    assert "from -20 to 2" in rows["train.ppo.log_std_init"]
    assert not [name for name in COMMANDS if f"taic {name}" not in text]


def test_every_page_of_the_repository_is_there(site):
    pages = {path.relative_to(ROOT).with_suffix(".html") for path in ROOT.glob("docs/*.md")}
    assert not [page for page in (*pages, Path("RESULTS.html")) if not (site / page).is_file()]
