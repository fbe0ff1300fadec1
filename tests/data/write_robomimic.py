"""Writes tests/data/robomimic.hdf5 with robomimic's converter of D4RL data, `scripts/conversion/convert_d4rl.py`.

    pip install robomimic==0.3.0; python tests/data/write_robomimic.py tests/data/robomimic.hdf5

Gym and D4RL, which it asks for the data, are stand-ins here that return two episodes, of 6 and 4 steps, and the begin
of a third. robomimic needs torch, so its file is kept here, and no extra of this package installs it.
"""

import runpy
import shutil
import sys
import tempfile
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np


def dataset() -> dict[str, np.ndarray]:
    """Return flat arrays as D4RL does."""
    random, steps = np.random.default_rng(0), 13
    timeouts = np.zeros(steps, bool)
    timeouts[[5, 9]] = True
    return {
        "observations": random.normal(size=(steps, 3)).astype(np.float32),
        "actions": random.uniform(-1, 1, (steps, 2)).astype(np.float32),
        "rewards": np.arange(steps, dtype=np.float32),
        "terminals": np.zeros(steps, bool),
        "timeouts": timeouts,
    }


def main(out: Path) -> None:
    """Write the file."""
    gym: Any = ModuleType("gym")
    gym.make = lambda *args, **kwargs: SimpleNamespace(env=SimpleNamespace(get_dataset=dataset), close=lambda: None)
    d4rl: Any = ModuleType("d4rl")
    d4rl.set_dataset_path = lambda path: None
    sys.modules |= {"gym": gym, "d4rl": d4rl}
    with tempfile.TemporaryDirectory() as folder:
        sys.argv = ["convert_d4rl.py", "--env", "points-v0", "--folder", folder]
        runpy.run_module("robomimic.scripts.conversion.convert_d4rl", run_name="__main__")
        shutil.copy(Path(folder) / "d4rl/converted/points_v0.hdf5", out)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
