"""The diffs of docs/extensions.md apply to this tree, and a run takes all of them."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DIFFS = re.findall(r"^```diff\n(.*?)^```$", (ROOT / "docs/extensions.md").read_text(), re.MULTILINE | re.DOTALL)
COMMAND = re.search(r"^    taic (run .*)$", (ROOT / "docs/extensions.md").read_text(), re.MULTILINE)[1].split()
SMALL = """
    --collect.ticks 8192 --options.steps 50 --train.ticks 4096 --train.baselines --train.soft-dqn.warmup 100
    --evaluate.episodes 2 --evaluate.video-ticks 0 --run-dir run
"""


@pytest.mark.timeout(900)
def test_a_run_takes_the_task_the_rule_and_the_learner(tmp_path):
    assert len(DIFFS) == 3
    for folder in ("taic_jax", "envs", "experiments"):
        ignored = shutil.ignore_patterns("__pycache__", "results", "pretrained")
        shutil.copytree(ROOT / folder, tmp_path / folder, symlinks=True, ignore=ignored)
    for diff in DIFFS:
        subprocess.run(["git", "apply", "-"], cwd=tmp_path, input=diff, text=True, check=True)
    env = {**os.environ, "PYTHONPATH": str(tmp_path)}
    args = [sys.executable, "-m", "taic_jax", *COMMAND, *SMALL.split()]
    done = subprocess.run(args, cwd=tmp_path, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    rows = [json.loads(line) for line in (tmp_path / "run/metrics.jsonl").read_text().splitlines()]
    last = [row for row in rows if row["stage"] == "train"][-1]
    assert 2.5 < last["train/duration"][0] < 4.2, "of 5 ticks: (1 - 0.8 ** 5) / 0.2 = 3.4 with the chance of the rule"
    assert last["train/value_loss"][0] > 0
