# %% [markdown]
# # Carry an ant's options to the maze
#
# These options were learnt and practised by an ant on open ground, and are chosen by the way that they shall lead, in
# metres, in the world's axes. So they can be carried to any task of that ant: here HIRO's maze, whose goal lies behind
# a wall. First we lead the ant by hand, without any learning; then a policy learns to.

# %%
# In Colab, with a GPU: Runtime, Change runtime type, then
#     !pip install -q 'taic-jax[cuda12]'
# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import taic_jax as taic

run = taic.load("pretrained:steering")
executor = taic.make_executor(run.config.options, run.options[0])
maze = taic.make_env("ant_maze")
size = maze.proprioceptive_size  # the place follows the ant's own state
print(f"an option lasts {executor.length} ticks of {maze.dt} s; the goal is at {maze.arena.goal} m")

# %% [markdown]
# ## Lead it by hand
#
# The way round the wall has three places. At each decision the option's way is the unit vector to the next one.

# %%
PLACES = jnp.array([[16.0, 0.0], [16.0, 16.0], [0.0, 16.0]])
TICKS, NEAR = 900, 3.0  # m at which a place counts as reached


@jax.jit
def lead(key):
    def tick(carry, index):
        state, running, target = carry
        place = state.obs[size : size + 2]
        near = jnp.linalg.norm(PLACES[target] - place) < NEAR
        target = jnp.minimum(target + near, len(PLACES) - 1)
        way = PLACES[target] - place
        begun = executor.start(way / jnp.linalg.norm(way), state.obs)
        running = jax.tree.map(lambda new, old: jnp.where(index % executor.length == 0, new, old), begun, running)
        running, action = executor.act(running, state.obs, jnp.zeros(executor.noise_size))
        return (maze.step(state, action), running, target), (state.physics, place, state.metrics["distance"])

    state = maze.reset(key)
    begin = state, executor.start(jnp.array([1.0, 0.0]), state.obs), jnp.zeros((), jnp.int32)
    return jax.lax.scan(tick, begin, jnp.arange(TICKS))[1]


physics, places, distances = jax.vmap(lead)(jax.random.split(jax.random.key(0), 8))
plt.figure(figsize=(4, 4))
plt.plot(*np.moveaxis(places, -1, 0).swapaxes(1, 2), linewidth=0.8)
plt.gca().add_patch(plt.Circle((0, 16), 5, color="green", alpha=0.2))
plt.axis("equal")
print("metres from the goal at the end:", np.round(np.sort(distances[:, -1]), 1))

# %%
frames = maze.render(jax.tree.map(lambda x: x[0, :: TICKS // 6], physics))
figure, panels = plt.subplots(1, len(frames), figsize=(2.4 * len(frames), 2))
for axes, frame in zip(panels, frames, strict=True):
    axes.imshow(frame)
    axes.axis("off")

# %% [markdown]
# ## Learn it
#
# A policy over the same options learns by soft actor-critic with hindsight. The whole run has a million ticks; here
# are some, enough to see that it runs.

# %%
TRAINING = 64_000
config = taic.load_config("transfer_ant_maze")
env = taic.make_env("ant_maze", goal="mixed")
agent, metrics = taic.train(config.train.sac, env, executor, jax.random.key(0), ticks=TRAINING)
plt.figure(figsize=(4, 3))
plt.plot(metrics["mean/distance"])
plt.xlabel("iterations")
plt.ylabel("m from the goal, on average")
print("return of mean options:", taic.evaluate(maze, agent, jax.random.key(1), episodes=2)["return"])

# %% [markdown]
# The command does all of it, with logs, checkpoints and a film:
#
#     taic run transfer_ant_maze --options pretrained:steering
