"""What options do, on the counting task, where every tick adds one; and the measures of a small model."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import NO, Counting, Probe, Repeat

from taic_jax.analysis.option_space import WARM_UP, encode_windows, execute, measure, order
from taic_jax.config import OptionsConfig
from taic_jax.options.dataset import Experience
from taic_jax.options.learning import learn

N = 40


class Moving(Probe):
    """Endless: the action moves x."""

    episode_length = 10_000

    def first(self, key: jax.Array) -> jax.Array:
        return jax.random.normal(key)

    def move(self, x: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        return x + action, action, NO, NO


def run(env: Probe, executor: Repeat, many: bool):
    option = jax.random.normal(jax.random.key(1), (N, 1))
    return jax.device_get(jax.jit(lambda key: execute(env, executor, option, key, many))(jax.random.key(0)))


@pytest.mark.parametrize("many", [False, True])
def test_options_move_the_state_by_what_they_do(many):
    effects = run(Moving(), Repeat(3), many)
    np.testing.assert_allclose(effects.end - effects.start, 3 * np.clip(effects.option, -1, 1), atol=1e-4)
    assert (effects.ticks == 3).all()
    assert (np.ptp(effects.start) > 1) == many  # from one state, all start alike


def test_many_states_are_those_that_options_lead_to():
    # Without an end every environment has counted the ticks of the warm-up.
    effects = run(Counting(0), Repeat(3), many=True)
    assert (effects.start == WARM_UP).all() and (effects.end == WARM_UP + 3).all()


def test_an_option_ends_with_its_episode_and_before_the_reset():
    effects = run(Counting(2, truncated=True), Repeat(3), many=False)
    assert (effects.start == 0).all() and (effects.end == 2).all() and (effects.ticks == 2).all()


def test_an_option_ends_when_its_rule_says_so():
    effects = run(Counting(0), Repeat(3, noise_size=1), many=False)
    # The chance is one half a tick: 1, 2 or 3 ticks in shares 1/2, 1/4, 1/4.
    assert set(effects.ticks) == {1, 2, 3} and 10 <= (effects.ticks == 1).sum() <= 30
    np.testing.assert_array_equal(effects.end[:, 0], effects.ticks)


def test_measures_a_model():
    """A code of one action that moves the state tells the change, and nothing of the start."""
    config = OptionsConfig(
        length=1, size=1, hidden_size=8, mlp_sizes=(8,), steps=300, select="random", lambda_kl=1e-3, lambda_adv=0.0
    )
    rng = np.random.default_rng(0)
    action = rng.uniform(-1, 1, (64, 8, 1))
    obs = rng.normal(size=(1, 8, 1)) + np.cumsum(action, axis=0) - action
    arrays = (jnp.asarray(x, jnp.float32) for x in (obs, action, action[..., 0]))
    experience = Experience(*arrays, done=jnp.zeros((64, 8), bool))
    model, _ = jax.jit(lambda key: learn(config, experience, key))(jax.random.key(0))
    windows = encode_windows(config, model, experience, jax.random.key(1), 200)
    # In order of the change, the codes are in order too.
    assert abs(np.corrcoef((windows.end - windows.start)[:, 0], windows.mean[:, 0])[0, 1]) > 0.9
    told = measure(Moving(), config, model, experience, jax.random.key(2), count=200)
    for kind in ("window", "prior/one", "prior/many", "data/one", "data/many"):
        assert told[f"{kind}/distance_correlation"] > 0.8 and told[f"{kind}/mlp_r2/change"] > 0.8
    assert told["window/mlp_r2/start"] < 0.2 and "prior/one/mlp_r2/start" not in told
    assert told["active_dimensions"] == 1 and told["kl"] > 1 and told["data/many/ticks"] == 1
    ordered = order(Moving(), config, model, jax.random.key(3), count=200)
    assert abs(ordered - told["prior/one/distance_correlation"]) < 0.1
    deaf = jax.tree.map(jnp.zeros_like, model.params["decoder"])
    deaf = model.replace(params={**model.params, "decoder": deaf})
    assert abs(order(Moving(), config, deaf, jax.random.key(3), count=200)) < 0.05, "nothing depends on the code"
