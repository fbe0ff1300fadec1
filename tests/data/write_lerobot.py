"""Writes tests/data/lerobot with LeRobot's own writer: two episodes of a point that is pushed, 7 and 5 steps.

    pip install lerobot==0.4.4; python tests/data/write_lerobot.py tests/data/lerobot

LeRobot needs torch, so its folder is kept here, and no extra of this package installs it.
"""

import sys
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

FEATURES = {
    "observation.state": {"dtype": "float32", "shape": (3,), "names": ["x", "y", "speed"]},
    "observation.environment_state": {"dtype": "float32", "shape": (2,), "names": ["goal_x", "goal_y"]},
    "action": {"dtype": "float32", "shape": (2,), "names": ["push_x", "push_y"]},
    "next.reward": {"dtype": "float32", "shape": (1,), "names": None},
    "next.done": {"dtype": "bool", "shape": (1,), "names": None},
}


def main(root: Path) -> None:
    """Write the folder."""
    dataset = LeRobotDataset.create("taic/points", fps=10, features=FEATURES, root=root, use_videos=False)
    random = np.random.default_rng(0)
    for steps in (7, 5):
        state = np.zeros(3, np.float32)
        for step in range(steps):
            action = random.uniform(-1, 1, 2).astype(np.float32)
            dataset.add_frame({
                "observation.state": state,
                "observation.environment_state": np.array([4.0, 2.0], np.float32),
                "action": action,
                "next.reward": state[:1] - 1,
                "next.done": np.array([step + 1 == steps]),
                "task": "push the point",
            })  # fmt: skip
            state = np.append(state[:2] + action, np.hypot(*action)).astype(np.float32)
        dataset.save_episode()
    dataset.finalize()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
