# %% [markdown]
# # Options of the room
#
# An option is a code of a few numbers, which the decoder D turns into actions. Here a point moves in a room with walls;
# its options were learnt from walks to random goals, and ship with the package. We look at single codes, at codes
# between two others, and at one entry of a code at a time.

# %%
# In Colab, with a GPU: Runtime, Change runtime type, then
#     !pip install -q 'taic-jax[cuda12]'
# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import taic_jax as taic

run = taic.load("pretrained:nav2d")
env, options = run.env, run.config.options
executor = taic.make_executor(options, run.options[0])
print(f"codes of {options.size} numbers, options of {options.length} ticks")

# %% [markdown]
# ## Execute one
#
# An executor begins an option at an observation and acts tick by tick, all within `jit`. `path` repeats one option
# several times and returns the places.

# %%
TIMES = 6


@jax.jit
def path(option):
    def tick(carry, index):
        state, running = carry
        begun = executor.start(option, state.obs)
        running = jax.tree.map(lambda new, old: jnp.where(index % executor.length == 0, new, old), begun, running)
        running, action = executor.act(running, state.obs, jnp.zeros(executor.noise_size))
        return (env.step(state, action), running), state.obs[:2]

    state = env.reset(jax.random.key(0))
    return jax.lax.scan(tick, (state, executor.start(option, state.obs)), jnp.arange(TIMES * executor.length))[1]


codes = jax.random.normal(jax.random.key(1), (40, options.size))
paths = jax.vmap(path)(codes)
plt.figure(figsize=(4, 4))
plt.plot(*np.moveaxis(paths, -1, 0).swapaxes(1, 2), linewidth=0.8)
plt.title("40 codes of the prior, from one place")
plt.axis("equal")

# %% [markdown]
# ## Between two codes
#
# Codes lie in a continuous space: on the line between two of them the paths change evenly.

# %%
first, last = codes[0], codes[1]
between = first + jnp.linspace(0, 1, 9)[:, None] * (last - first)
plt.figure(figsize=(4, 4))
for share, each in zip(np.linspace(0, 1, 9), jax.vmap(path)(between), strict=True):
    plt.plot(*each.T, color=plt.get_cmap("viridis")(share))
plt.title("from one code (dark) to another (light)")
plt.axis("equal")

# %% [markdown]
# ## One entry at a time
#
# The KL term of learning leaves only as many entries in use as it takes: the others move little.

# %%
figure, panels = plt.subplots(1, options.size, figsize=(2.2 * options.size, 2.4), sharex=True, sharey=True)
moved = []
for entry, axes in enumerate(panels):
    sweep = jnp.zeros((7, options.size)).at[:, entry].set(jnp.linspace(-2, 2, 7))
    ends = jax.vmap(path)(sweep)
    axes.plot(*np.moveaxis(ends, -1, 0).swapaxes(1, 2), linewidth=0.8)
    axes.set_title(f"entry {entry + 1}")
    moved.append(float(jnp.linalg.norm(ends[-1, -1] - ends[0, -1])))
print("entries by how far they move the end of the path:", [f"{x:.2f} m" for x in moved])
assert max(moved) > 3 * min(moved)

# %% [markdown]
# `taic explore pretrained:nav2d` does the same with sliders; `taic run nav2d` learns such options anew.
