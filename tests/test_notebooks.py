"""The notebooks run from their first cell to the last, with small budgets."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / "docs/notebooks"
SMALL = {"TICKS, NEAR": "60, 3.0", "TRAINING": "14_000", "EPISODES, STEPS": "3, 30"}


def test_every_small_budget_is_of_a_notebook():
    text = "".join(path.read_text() for path in FOLDER.glob("*.py"))
    assert all(f"\n{name} = " in text for name in SMALL)


@pytest.mark.timeout(900)
@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.py")), ids=lambda path: path.stem)
def test_a_notebook_runs(path, tmp_path):
    text = path.read_text()
    for name, value in SMALL.items():
        text = re.sub(rf"^{name} = [\d_., ]+", f"{name} = {value}", text, flags=re.MULTILINE)
    (tmp_path / path.name).write_text(text)
    env = {**os.environ, "MPLBACKEND": "Agg", "PYTHONPATH": str(FOLDER.parents[1])}
    done = subprocess.run([sys.executable, path.name], cwd=tmp_path, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    assert [name.name for name in tmp_path.iterdir()] == [path.name]
