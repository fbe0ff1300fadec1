# %% [markdown]
# # Skills from your own logs
#
# Options can be learnt from recorded episodes alone: no simulator, no task. Here the log is made with Gymnasium's
# pendulum, by a simple controller; put your own file in its place.

# %%
# In Colab, with a GPU: Runtime, Change runtime type, then
#     !pip install -q 'taic-jax[cuda12,data,gym]'
# %%
import subprocess
import sys
import tempfile
from pathlib import Path

import gymnasium
import matplotlib.pyplot as plt
import numpy as np

import taic_jax as taic

folder = Path(tempfile.mkdtemp())
EPISODES, STEPS = 60, 3000

# %% [markdown]
# ## The log
#
# Flat arrays, as OGBench and D4RL have them: `observations`, `actions`, and `terminals` at the last step of an episode.

# %%
env, rows = gymnasium.make("Pendulum-v1"), {"observations": [], "actions": [], "terminals": []}
random = np.random.default_rng(0)
for episode in range(EPISODES):
    obs, _ = env.reset(seed=episode)
    ended = False
    while not ended:
        cos, sin, speed = obs
        upright = cos > 0.8
        torque = -12 * sin - 3 * speed if upright else 2 * np.sign(speed)
        action = np.clip([torque + random.normal()], -2, 2).astype(np.float32)
        after, _, _, ended, _ = env.step(action)
        for name, value in zip(rows, (obs, action, ended), strict=True):
            rows[name].append(value)
        obs = after
np.savez(folder / "log.npz", **rows)
print(len(rows["actions"]), "steps")

# %% [markdown]
# ## Learn
#
# The command reads the log, says in a line what it read, and leaves a run.

# %%
command = ["taic_jax", "learn", "log.npz", "--action-bounds", "-2", "2", "--options.length", "10", "--run-dir", "run"]
command += ["--options.size", "3", "--options.steps", str(STEPS), "--overwrite"]
done = subprocess.run([sys.executable, "-m", *command], cwd=folder, capture_output=True, text=True, check=True)
print(done.stderr[:400], done.stdout)

# %% [markdown]
# ## Look
#
# One code and one stretch of states give the torques of an option, in the units of the log.

# %%
run = taic.load(folder / "run")
model, observations = run.options[0], np.float32(rows["observations"])
states = observations[100:110]
for code in np.random.default_rng(1).normal(size=(8, 3)).astype(np.float32):
    torques, _ = model.decode(code, model.state_scale(states))
    plt.plot(torques, marker=".")
plt.xlabel("ticks")
plt.ylabel("torque, N m")
plt.title("eight codes of the prior, from one state")
assert np.abs(torques).max() <= 2.0

# %% [markdown]
# `taic report RUN --out report.html` has the measures of the option space, and `--options RUN` carries the options to a
# simulated task whose body has the same observations and actions.
