"""`taic export`: its files act as the agent does, each by the program that the guide gives for it; mistakes."""

import json
import runpy
import subprocess
import sys
import zlib
from itertools import pairwise
from pathlib import Path

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_runs import CONFIG, files_of, with_fields

import taic_jax as taic
from taic_jax.__main__ import main
from taic_jax.artifacts.agents import save_agents
from taic_jax.artifacts.models import empty_model, save_options
from taic_jax.networks import GreedyPolicy, Policy, SquashedPolicy
from taic_jax.options.execution import IdentityExecutor, make_executor
from taic_jax.rl import normalize
from taic_jax.rl.agent import Agent

EXAMPLES = Path(__file__).parents[2] / "experiments" / "examples"
ENV, CART_POLE = f"{EXAMPLES / 'pendulum.py'}:Pendulum", f"{Path(__file__).parents[1] / 'cart_pole.py'}:CartPole"
EPISODES, TICKS, LENGTH = 10, 24, 4
KINDS = [(decoder, rule) for decoder in ("open", "closed") for rule in ("fixed", "output", "predict")] + [
    ("", ""),
    ("", "sac"),
    ("", "dqn"),
    ("open", "dqn"),
]
RUNNERS = {"jax": "run_stablehlo.py", "onnx": "run_onnx.py", "npz": "run_npz.py"}
pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")


class Replay(gymnasium.Env):
    """Show recorded observations, whatever the actions, and keep these."""

    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, size: int) -> None:
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.obs = np.random.default_rng(0).normal(size=(EPISODES, TICKS + 1, size)).astype(np.float32)
        self.actions = np.full((EPISODES, TICKS, 1), np.nan)

    def reset(self, *, seed=None, options=None):
        """Begin the episode of a seed."""
        self.episode, self.tick = seed, 0
        return self.obs[seed, 0], {}

    def step(self, action):
        """Show the next observation."""
        self.actions[self.episode, self.tick] = action
        self.tick += 1
        return self.obs[self.episode, self.tick], 0.0, False, self.tick == TICKS, {}


def scattered(tree, rng):
    """Return a tree of random arrays, two rows each."""
    return jax.tree.map(lambda x: rng.normal(0, 0.7, (2, *x.shape)).astype(np.float32), tree)


def agents_of(env, config, decoder: str, learner: str) -> Agent:
    """Return two untrained agents [2] whose actions and ends of options depend on the observation."""
    rng, executor = (
        np.random.default_rng(0 if env.discrete else 2),
        IdentityExecutor(env.action_size, discrete=env.discrete),
    )
    size = env.observation_size
    if decoder:
        model = scattered(empty_model(env, config.options), rng)
        scales = [x.replace(std=0.5 + x.std**2) for x in (model.state_scale, model.change_scale)]
        model = model.replace(state_scale=scales[0], change_scale=scales[1], delta=jnp.full(2, 4.0))
        executor = make_executor(config.options, model)
        executor = executor if executor.std is None else executor.replace(std=jnp.ones(2))
    policy = (SquashedPolicy if learner == "sac" else Policy)(executor.option_size, (4,))
    if learner == "dqn":
        policy = GreedyPolicy(executor.option_size, (4, 4), layer_norm=True)
    statistics = jax.tree.map(lambda x: jnp.stack([jnp.asarray(x)] * 2), normalize.init((size,)))
    std = jnp.array([[1.0, 0.5, 0.05, 1.0][:size]] * 2)  # clips
    statistics = statistics.replace(mean=jnp.full((2, size), 0.5), std=std)
    params = scattered(policy.init(jax.random.key(0), size, 0.0), rng)
    if learner == "sac":
        params = params.replace(bound=np.array([1.0, 0.75], np.float32))
    return Agent(executor, params, statistics, policy)


@pytest.fixture(scope="module", params=KINDS, ids="-".join)
def source(request, tmp_path_factory) -> tuple[Path, str]:
    """Return saved agents of each kind, and the name of their method."""
    decoder, rule = request.param
    learner, rule = (rule, "") if rule in ("sac", "dqn") else ("ppo", rule)
    fields = {"length": LENGTH, "decoder": decoder or "open", "termination": rule or "fixed"}
    name = ENV
    if learner == "dqn":  # an export takes the most probable actions
        fields, name = fields | {"codes": 3, "sample_actions": True}, CART_POLE
    fields = {f"options__{name}": value for name, value in fields.items()}
    config = with_fields(CONFIG, env__name=name, collect__learner=learner, train__learner=learner, **fields)
    config = with_fields(config, collect__dqn__hidden_sizes=(4, 4), train__dqn__hidden_sizes=(4, 4))
    env, method = taic.make_env(name), "taic" if decoder else "flat"
    folder = tmp_path_factory.mktemp("agents") / method
    save_agents(folder, agents_of(env, config, decoder, learner), env, config, method)
    return folder, method


flat = pytest.mark.parametrize("source", [("", "")], indirect=True, ids=["flat"])
"""Tests that one kind of agents is enough for."""


def export(source: tuple[Path, str], out: Path, *args: str) -> int:
    return main(["export", str(source[0]), "--method", source[1], "--seed", "1", "--out", str(out), *args])


def test_every_file_acts_as_the_agent_by_the_program_that_the_guide_gives(source, tmp_path, monkeypatch, capsys):
    out = tmp_path / "new" / "export"
    assert export(source, out, "--format", *RUNNERS) == 0
    names = ["agent.stablehlo", "agent.onnx", "agent.npz", "agent.json"]
    assert capsys.readouterr().out.splitlines() == [str(out / name) for name in names]
    about = json.loads((out / "agent.json").read_text())
    assert about["crc32"] == {name: zlib.crc32((out / name).read_bytes()) for name in names[:3]}
    handle = taic.load(source[0])
    assert (about["method"], about["seed"], about["dt"]) == (source[1], 1, handle.env.dt)
    agent, env = handle.agents[source[1]][1], Replay(handle.env.observation_size)
    expected, durations = np.empty_like(env.actions), []
    for episode in range(EPISODES):
        carry = agent.start(env.obs[episode, 0])
        for t in range(TICKS):
            carry, action, tick = agent.act(carry, env.obs[episode, t])
            expected[episode, t] = np.argmax(action) if about["discrete"] else action
            durations.append(int(tick.duration))
    early = sum(new == 1 and LENGTH > old > 1 for old, new in pairwise(durations))
    assert (early > 0) == (about["termination"] in ("output", "predict"))
    assert np.std(expected) > 0.2 and np.mean(np.abs(expected) < 1) > 0.15  # discrete ones are 0 or 1
    for kind, runner in RUNNERS.items():
        env.actions[:] = np.nan
        monkeypatch.setattr(gymnasium, "make", lambda name: env)
        monkeypatch.setattr(sys, "argv", [runner, str(out), "Replay"])
        runpy.run_path(str(EXAMPLES / runner))
        np.testing.assert_allclose(env.actions, expected, rtol=0, atol=1e-5, err_msg=kind)


@flat
def test_the_programs_print_the_same_returns_in_gymnasium(source, tmp_path):
    """The pendulum's returns, as texts, may differ in the last digits: actions do in the seventh."""
    out, returns = tmp_path / "export", {}
    assert export(source, out, "--format", *RUNNERS, "--seed", "0") == 0
    programs = {kind: [name, str(out), "Pendulum-v1"] for kind, name in RUNNERS.items()}
    programs["agent"] = ["run_agent.py", str(source[0]), "Pendulum-v1", "flat"]
    for kind, (name, *args) in programs.items():
        done = subprocess.run([sys.executable, EXAMPLES / name, *args], capture_output=True, text=True, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        returns[kind] = [float(line.removeprefix("return ")) for line in done.stdout.splitlines()]
    assert len(set(returns["agent"])) == EPISODES and max(returns["agent"]) < -100
    for kind in RUNNERS:
        np.testing.assert_allclose(returns[kind], returns["agent"], rtol=1e-2, err_msg=kind)


@flat
def test_a_new_export_replaces_all_files_of_the_last_one(source, tmp_path):
    assert export(source, tmp_path, "--format", "npz", "onnx") == 0 and export(source, tmp_path) == 0
    assert set(files_of(tmp_path)) == {"agent.json", "agent.stablehlo"}


MISTAKES = [
    (["--method", "flt"], "--method: expected some of flat, got flt; the nearest is flat"),
    (["--seed", "2"], "--seed: expected 0 to 1, got 2; the nearest valid value is 1"),
    (["--seed", "-1"], "--seed: expected 0 to 1, got -1; the nearest valid value is 0"),
    (["--format", "onxx"], "onnx"),
    (["--format"], "--format"),
    (["--format", "npz", "onnx"], "the package onnx is not installed: pip install 'taic-jax[onnx]'"),
]


@flat
@pytest.mark.parametrize(("args", "expected"), MISTAKES, ids=lambda x: " ".join(x) if isinstance(x, list) else "")
def test_a_mistake_is_one_line_and_leaves_the_last_export(source, args, expected, tmp_path, monkeypatch, capsys):
    assert export(source, tmp_path) == 0
    before = files_of(tmp_path)
    monkeypatch.setitem(sys.modules, "onnx", None)
    monkeypatch.delitem(sys.modules, "taic_jax.handles.onnx_graph", raising=False)
    capsys.readouterr()
    assert export(source, tmp_path, *args) == 2
    told = capsys.readouterr().err
    assert expected in told and told.count("\n") == 1
    assert files_of(tmp_path) == before


@flat
def test_a_folder_that_cannot_be_made_is_named(source, tmp_path, capsys):
    (tmp_path / "file").touch()
    assert export(source, tmp_path / "file" / "export") in (2, 74)
    told = capsys.readouterr().err
    assert f"{tmp_path / 'file' / 'export'}: cannot be written" in told and told.count("\n") == 1


def test_options_alone_are_no_agent(tmp_path, capsys):
    env = taic.make_env(ENV)
    config = with_fields(CONFIG, env__name=ENV)
    save_options(
        tmp_path / "options", scattered(empty_model(env, config.options), np.random.default_rng(0)), env, config.options
    )
    assert main(["export", str(tmp_path / "options"), "--out", str(tmp_path / "export")]) == 2
    told = capsys.readouterr().err
    assert "--method: expected a run with agents, this has option models alone" in told and told.count("\n") == 1
    assert not (tmp_path / "export").exists()
