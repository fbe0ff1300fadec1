"""State beyond positions and velocities: activations, equalities and sensors; what cannot be carried is refused."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from taic_jax.envs import ModelError, PhysicsState, make_env
from taic_jax.envs.physics import MujocoPhysics, make_physics

# Two arms that an equality moves as one, one with a slow servo, one with an integrating motor; and a ball on the floor,
# which a weld would hold, were it active.
RICH = """<mujoco model="rich"> <option timestep="0.004"/> <default> <joint axis="0 1 0" damping="0.5"/> </default>
  <worldbody> <geom type="plane" size="2 2 .1"/>
    <body pos="0 0 1"> <joint name="a"/> <geom type="capsule" fromto="0 0 0 .4 0 0" size=".04"/>
      <site name="tip" pos=".4 0 0"/> </body>
    <body pos="0 1 1"> <joint name="b"/> <geom type="capsule" fromto="0 0 0 .4 0 0" size=".04"/> </body>
    <body name="ball" pos="1 0 .1"> <freejoint/> <geom size=".1"/> <site name="pad" size=".11"/> </body>
  </worldbody>
  <equality> <joint joint1="a" joint2="b"/> <weld body1="ball" active="false"/> </equality>
  <actuator> <position joint="a" kp="20" timeconst="0.1"/> <general joint="b" dyntype="integrator" gainprm="2"/>
  </actuator>
  <sensor> <jointpos joint="a"/> <touch site="pad"/> <gyro site="tip"/> </sensor>
</mujoco>"""
BACKENDS = ("mujoco", "mjx")


@functools.cache
def physics(backend: str = "mujoco", sensors: bool = True, **options):
    return make_physics(mujoco.MjModel.from_xml_string(RICH), 5, backend, sensors=sensors, **options)


def drawn(seed: int, *batch: int):
    """Draw states in motion, with activations, and controls."""
    rng, model = np.random.default_rng(seed), physics().model
    draw = lambda size: jnp.array(rng.normal(0.0, 0.5, (*batch, size)), jnp.float32)  # noqa: E731
    pose = jnp.broadcast_to(jnp.array(model.qpos0, jnp.float32), (*batch, model.nq))
    rest, unread = jnp.zeros((*batch, model.nv)), jnp.zeros((*batch, model.nsensordata))
    return PhysicsState(pose, draw(model.nv), rest, act=draw(model.na), sensordata=unread), draw(model.nu)


def assert_same(one, other):
    jax.tree.map(np.testing.assert_array_equal, one, other)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_tick_is_the_engines_own(backend):
    """By one MjData that goes on for 20 ticks: positions, activations, and readings before the latest substep."""
    step, data = jax.jit(physics(backend).step), mujoco.MjData(physics().model)
    state, ctrl = drawn(0)
    data.qvel[:], data.act[:], data.ctrl[:] = state.qvel, state.act, ctrl
    for _ in range(20):
        state = step(state, ctrl)
        for _ in range(5):
            mujoco.mj_step(physics().model, data)
    for got, wanted in ((state.qpos, data.qpos), (state.act, data.act), (state.sensordata, data.sensordata)):
        np.testing.assert_allclose(got, wanted, rtol=2e-3, atol=2e-3)
    assert np.abs(state.act).min() > 0.05 and abs(float(state.qpos[0] - state.qpos[1])) < 0.01 < abs(state.qpos[0])
    assert state.sensordata[1] > 1.0, "the ball presses on the floor"
    assert float(state.qpos[4]) < 0.12, "no weld holds it"


def test_the_result_depends_on_the_state_and_the_action_alone():
    """Not on what was simulated before, a divergence included, on the other simulations, or on the threads."""
    step = jax.jit(jax.vmap(physics().step))
    state, ctrl = drawn(1, 6)
    first = step(state, ctrl)
    for seed in range(2, 5):
        step(*drawn(seed, 6))
    assert_same(first, step(state, ctrl))
    bad = step(state.replace(act=state.act.at[2].set(jnp.inf)), ctrl)
    assert all(np.isnan(leaf[2]).all() for leaf in jax.tree.leaves(bad))
    assert_same(*(jax.tree.map(lambda leaf: leaf[3:], each) for each in (first, bad)))
    assert_same(first, step(state, ctrl))
    alone = jax.jit(MujocoPhysics(physics().model, 5, num_threads=1, sensors=True).step)
    for row in range(6):
        pick = lambda leaf, row=row: leaf[row]  # noqa: E731
        assert_same(jax.tree.map(pick, first), alone(jax.tree.map(pick, state), ctrl[row]))
    other = step(state.replace(act=state.act + 1.0), ctrl)
    assert not np.array_equal(other.qvel, first.qvel), "activations count"


def test_a_saved_state_goes_on_bit_for_bit(tmp_path):
    """Through a file, in an engine of its own; readings are results alone."""
    state, ctrl = drawn(3, 4)
    step = jax.jit(jax.vmap(physics().step))
    for _ in range(10):
        state = step(state, ctrl)
    np.savez(tmp_path / "state.npz", **{name: np.asarray(value) for name, value in vars(state).items()})
    saved = state.replace(**np.load(tmp_path / "state.npz"))
    fresh = jax.jit(jax.vmap(MujocoPhysics(physics().model, 5, num_threads=2, sensors=True).step))
    for _ in range(10):
        state, saved = step(state, ctrl), fresh(saved, ctrl)
    assert_same(state, saved)
    assert_same(step(state, ctrl), step(state.replace(sensordata=state.sensordata + 1.0), ctrl))


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_state_has_no_more_than_its_model_and_its_physics(backend):
    state, ctrl = drawn(0)
    without = jax.jit(physics(backend, sensors=False).step)(state.replace(sensordata=None), ctrl)
    assert without.sensordata is None and without.act.shape == (2,)
    np.testing.assert_allclose(without.qpos, jax.jit(physics(backend).step)(state, ctrl).qpos, atol=1e-6)
    plain = make_env("half_cheetah", backend).reset(jax.random.key(0)).physics
    assert plain.act is None and plain.sensordata is None and len(jax.tree.leaves(plain)) == 3


MUSCLE = '<actuator> <position joint="j" kp="1" {}/> </actuator>'
REFUSED = {
    "mocap bodies": '<worldbody> <body mocap="true"/> </worldbody>',
    "delays": MUSCLE.format('delay="0.02" nsample="4"'),
    "sleep": '<option> <flag sleep="enable"/> </option>',
}


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("content", REFUSED)
def test_what_cannot_be_carried_is_refused_by_name(content, backend):
    xml = f"""<mujoco model="odd"> <worldbody> <body> <joint name="j"/> <geom size="1"/> </body> </worldbody>
      {REFUSED[content]} </mujoco>"""
    says = f"^model odd: got {content}, which the state of the physics cannot carry$"
    with pytest.raises(ModelError, match=says):
        make_physics(mujoco.MjModel.from_xml_string(xml), 1, backend)


OWN = """
import jax.numpy as jnp, mujoco
from taic_jax.envs import Env, State
from taic_jax.envs.physics import make_physics

class Own(Env):
    name, episode_length, dt, observation_size, proprioceptive_size, action_size = "own", 50, 0.02, 7, 2, 2
    def __init__(self, backend="auto", num_threads=0):
        model = mujoco.MjModel.from_xml_string(XML)
        self.physics = make_physics(model, 5, backend, num_threads, sensors=True)
        self.qpos = jnp.array(model.qpos0, jnp.float32)
    def reset(self, key):
        return self.made(self.physics.init(self.qpos, jnp.zeros(8)))
    def step(self, state, action):
        return self.made(self.physics.step(state.physics, action))
    def made(self, physics):
        obs = jnp.concatenate([physics.act, physics.sensordata])
        return State.first(physics, obs, {"touch": physics.sensordata[1]})
    def render(self, physics, *, height=240, width=320):
        raise NotImplementedError
"""


def test_a_users_robot_carries_them_too(tmp_path):
    (tmp_path / "own.py").write_text(f"XML = {RICH!r}\n{OWN}")
    env = make_env(f"{tmp_path}/own.py:Own", "mujoco")
    state = jax.jit(env.reset)(jax.random.key(0))
    step = jax.jit(env.step)
    for _ in range(20):
        state = step(state, jnp.array([1.0, -1.0]))
    np.testing.assert_array_equal(state.obs, [*state.physics.act, *state.physics.sensordata])
    assert state.obs[0] > 0.5 > 0 > state.obs[1] and state.metrics["touch"] > 1.0
