"""The exported tick of an agent that chooses ways: it chooses codes and sides, and gives actions, as the agent does."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import draw, random_model

from taic_jax.config import OptionsConfig
from taic_jax.envs import make_env
from taic_jax.handles.tick import export
from taic_jax.networks import SquashedPolicy
from taic_jax.options.execution import make_executor
from taic_jax.rl import normalize
from taic_jax.rl.agent import Agent
from taic_jax.types import as_arrays

OPTIONS = OptionsConfig(
    decoder="closed", length=4, size=3, hidden_size=4, mlp_sizes=(4,), decoder_sizes=(8,), frame="heading",
    way_weight=2, choose="way", termination="predict",
)  # fmt: skip
onnxruntime = pytest.importorskip("onnxruntime")
pytest.importorskip("onnx")


def test_an_agent_that_chooses_ways_acts_as_onnx_and_as_stablehlo():
    """From states of 40 ticks that turn the ant about; all four sides are taken."""
    env = make_env("ant", "mujoco")
    rng, model = np.random.default_rng(1), random_model(OPTIONS, 27, 8, env.heading)
    predictor = jax.tree.map(lambda x: 0.2 * x, model.params["predictor"])  # not saturated: no two codes lead as far
    model = model.replace(params={**model.params, "predictor": predictor}, views=env.views, delta=jnp.array(4.0))
    executor = make_executor(as_arrays(OPTIONS), model)
    policy = SquashedPolicy(2, (8,))
    params = policy.init(jax.random.key(2), 27, 1.0)
    params, statistics = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), (params, normalize.init((27,))))
    agent = Agent(executor, jax.tree.map(lambda x: 3.0 * x, params), statistics, policy)
    files, about = export(agent, ("jax", "onnx"))
    session = onnxruntime.InferenceSession(files["agent.onnx"], providers=["CPUExecutionProvider"])
    stablehlo = jax.export.deserialize(bytearray(files["agent.stablehlo"]))
    names = [x["name"] for x in about["carry"]]
    carries = [[np.full(x["shape"], x["start"], x["dtype"]) for x in about["carry"]] for _ in range(2)]
    act, carry, views, states = jax.jit(agent.act), None, set(), draw(rng, 40, 27)
    for state in states:
        obs = state.at[1:5].set(state[1:5] / jnp.linalg.norm(state[1:5]))
        carry = agent.start(obs) if carry is None else carry
        carry, expected, _ = act(carry, obs)
        action, *carries[0] = session.run(None, {"obs": np.asarray(obs), **dict(zip(names, carries[0], strict=True))})
        other, *carries[1] = stablehlo.call(obs, *carries[1])
        np.testing.assert_allclose(action, expected, atol=2e-5)
        np.testing.assert_allclose(other, expected, atol=2e-5)
        views.add(int(carry.running.view))
    assert views == {0, 1, 2, 3}
