"""What a run leaves for others: loaded as it was saved, and refused in one line where it does not fit."""

import dataclasses
import json
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import Counting, assert_trees_equal

from taic_jax.artifacts.agents import load_policy, save_agents
from taic_jax.artifacts.models import load_options, save_options
from taic_jax.config import CollectConfig, Config, OptionsConfig, PPOConfig
from taic_jax.networks import Policy
from taic_jax.options.execution import IdentityExecutor
from taic_jax.options.model import OptionModel, Scale, init_params, make_networks
from taic_jax.rl import normalize
from taic_jax.rl.agent import Agent
from taic_jax.runtime.checkpoint import ArtifactError
from taic_jax.runtime.files import TEMPORARY

CONFIG = OptionsConfig(length=3, size=2, hidden_size=4, mlp_sizes=(4,), decoder_sizes=(4,))
HIDDEN = (4, 3)
PPO = PPOConfig(hidden_sizes=HIDDEN)
P, A = 2, 1
NETWORKS = make_networks(CONFIG, P, A)


class Body(Counting):
    """A task of a body whose slice is the first P of S observations."""

    def __init__(
        self, observation_size: int = P, proprioceptive_size: int = P, action_size: int = A, body: str = "ant"
    ):
        super().__init__(100)
        self.name, self.proprioception = f"{body}_task", body
        self.observation_size, self.action_size = observation_size, action_size
        self.proprioceptive_size = proprioceptive_size


def make_model(seed: Any) -> OptionModel:
    return OptionModel(
        init_params(NETWORKS, CONFIG, jax.random.key(seed)),
        Scale(jnp.full(P, seed, jnp.float32), jnp.ones(P)),
        Scale(jnp.zeros(P), jnp.ones(P)),
        jnp.asarray(seed, jnp.float32),
        NETWORKS,
    )


def make_agent(observation_size: int, seed: Any) -> Agent:
    key_params, key_obs = jax.random.split(jax.random.key(seed))
    policy = Policy(A, HIDDEN)
    params = policy.init(key_params, observation_size, -1.0)
    # Its last layer starts near zero; the mean action shall depend on what is observed.
    last = f"Dense_{len(HIDDEN)}"
    actor = {**params.actor["params"], last: jax.tree.map(lambda x: 100.0 * x, params.actor["params"][last])}
    seen = 3.0 + 2.0 * jax.random.normal(key_obs, (50, observation_size))
    statistics = normalize.update(normalize.init((observation_size,)), seen)
    return Agent(IdentityExecutor(A), params.replace(actor={"params": actor}), statistics, policy)


@pytest.fixture(scope="module")
def models() -> OptionModel:
    return jax.jit(jax.vmap(make_model))(jnp.arange(2))


@pytest.fixture(scope="module")
def saved(models, tmp_path_factory) -> Path:
    """Return a run's folder with the option models and the flat policies of two seeds."""
    run = tmp_path_factory.mktemp("runs") / "run"
    save_options(run / "options", models, Body(), CONFIG)
    agents = jax.jit(jax.vmap(partial(make_agent, 4)))(jnp.arange(2))
    config = Config(collect=CollectConfig(ppo=PPO))
    save_agents(run / "agents" / "collect", agents, Body(observation_size=4), config, "collect")
    return run


@pytest.mark.parametrize("inside", ["", "options"])
def test_seed_k_takes_option_model_k_modulo_their_number(saved, models, inside):
    loaded = load_options(saved / inside, Body(observation_size=7), CONFIG, 3)
    assert_trees_equal(loaded, jax.tree.map(lambda x: x[jnp.array([0, 1, 0])], models))


def refusal(load, *args) -> str:
    with pytest.raises(ArtifactError) as error:
        load(*args, 2)
    assert "\n" not in str(error.value)
    return str(error.value)


OTHER = {
    "proprioception": (Body(body="hiro"), {}, "'hiro'", "'ant'"),
    "proprioceptive_size": (Body(proprioceptive_size=1), {}, "1", "2"),
    "action_size": (Body(action_size=2), {}, "2", "1"),
    "options.decoder": (Body(), {"decoder": "closed"}, "'closed'", "'open'"),
    "options.termination": (Body(), {"termination": "predict"}, "'predict'", "'fixed'"),
    "options.length": (Body(), {"length": 4}, "4", "3"),
    "options.size": (Body(), {"size": 3}, "3", "2"),
    "options.hidden_size": (Body(), {"hidden_size": 8}, "8", "4"),
    "options.mlp_sizes": (Body(), {"mlp_sizes": (4, 4)}, "[4, 4]", "[4]"),
    "options.decoder_sizes": (Body(), {"decoder_sizes": (5,)}, "[5]", "[4]"),
}


@pytest.mark.parametrize("field", OTHER)
def test_options_of_another_body_or_structure_are_refused(saved, field):
    env, changes, expected, got = OTHER[field]
    message = refusal(load_options, saved, env, dataclasses.replace(CONFIG, **changes))
    assert message.startswith(f"{saved / 'options' / 'description.json'}: {field}: expected {expected}, ")
    assert message.endswith(f"; got {got}")


def test_how_options_are_used_may_differ(saved, models):
    config = dataclasses.replace(CONFIG, end_signal="threshold", delta=0.9, steps=7, lambda_adv=0.0, batch_size=3)
    assert_trees_equal(load_options(saved, Body(), config, 2), models)


def nothing(folder: Path) -> str:
    shutil.rmtree(folder)
    return "expected a run that got this far"


def of_another_program(folder: Path) -> str:
    nothing(folder)
    folder.mkdir()
    (folder / "thesis.txt").write_text("years of work")
    return "expected a run that got this far"


def described_by_another_program(folder: Path) -> str:
    (folder / "description.json").write_text('{"title": "thesis"}')
    return "expected the description of an artifact, got another file"


def not_described_yet(folder: Path) -> str:
    (folder / "description.json").unlink()
    return "expected a run that got this far"


def half_described(folder: Path) -> str:
    text = (folder / "description.json").read_text()
    (folder / "description.json").write_text(text[: len(text) // 2])
    return "expected a run that got this far"


def half_written(folder: Path) -> str:
    folder.rename(folder.with_name(folder.name + TEMPORARY))
    return "expected a run that got this far"


def without_arrays(folder: Path) -> str:
    for path in folder.iterdir():
        if path.name != "description.json":
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    return "expected an artifact, got files of another kind or damaged ones"


def of_fewer_seeds_than_described(folder: Path) -> str:
    path = folder / "description.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"seeds": 3}))
    return "expected float32[3"


SPOILS = [
    nothing,
    of_another_program,
    described_by_another_program,
    not_described_yet,
    half_described,
    half_written,
    without_arrays,
    of_fewer_seeds_than_described,
]


@pytest.mark.parametrize("spoil", SPOILS)
@pytest.mark.parametrize("kind", ["options", "agents/collect"])
def test_what_is_no_whole_artifact_is_refused(saved, tmp_path, kind, spoil):
    run = tmp_path / "run"
    shutil.copytree(saved, run)
    expected = spoil(run / kind)
    load = partial(load_options, run, Body(), CONFIG) if kind == "options" else partial(load_policy, run, Body(), PPO)
    message = refusal(load)
    assert message.startswith(str(run)) and expected in message


@pytest.mark.parametrize("size", [P, 5])
def test_a_policy_acts_on_the_body_as_it_did_whatever_else_is_observed(saved, size):
    K, B = 3, 5
    env = Body(observation_size=size)
    params, statistics = load_policy(saved, env, PPO, K)
    source = jax.jit(jax.vmap(partial(make_agent, 4)))(jnp.array([0, 1, 0]))
    key_body, key_rest = jax.random.split(jax.random.key(1))
    body = 3.0 + 2.0 * jax.random.normal(key_body, (K, B, P))
    rest = 1e6 * jax.random.normal(key_rest, (K, B, size - P))
    # What only the source observes is at its mean there.
    middle = jnp.broadcast_to(jnp.asarray(source.obs_statistics.mean)[:, None, P:], (K, B, 2))

    def act(params, statistics, obs):
        obs = normalize.normalize(statistics, obs)
        policy = Policy(A, HIDDEN)
        return policy.distribution(params, obs).loc, policy.value(params, obs)

    act = jax.jit(jax.vmap(act))
    expected = act(source.params, source.obs_statistics, jnp.concatenate([body, middle], -1))
    got = act(params, statistics, jnp.concatenate([body, rest], -1))
    assert np.ptp(expected[0][0]) > 0.1 and np.ptp(expected[1][0]) > 0.01
    assert_trees_equal(got, expected, rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(params.log_std, source.params.log_std)
    kernel = params.actor["params"]["Dense_0"]["kernel"]
    assert kernel.shape == (K, size, HIDDEN[0]) and not kernel[:, P:].any()


def test_policies_of_other_layers_or_bodies_are_refused(saved):
    message = refusal(load_policy, saved, Body(), PPOConfig(hidden_sizes=(4,)))
    assert "collect/description.json: hidden_sizes: expected [4], " in message and message.endswith("got [4, 3]")
    message = refusal(load_policy, saved, Body(body="hiro"), PPO)
    assert "collect/description.json: proprioception: expected 'hiro'" in message
    assert f"{saved / 'options' / 'agents' / 'collect'}: expected a run" in refusal(
        load_policy, saved / "options", Body(), PPO
    )
