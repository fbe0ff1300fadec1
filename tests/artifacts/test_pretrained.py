"""Agents that ship with the package act as their cards say, and their options are a source of others' runs."""

import dataclasses
import json
import re
from pathlib import Path

import jax
import pytest
from probes import assert_trees_equal

import taic_jax as taic
from taic_jax.analysis.evaluate import evaluate
from taic_jax.artifacts.pretrained import locate, pretrained_names
from taic_jax.config import TAIC, EnvConfig, replace
from taic_jax.runtime.checkpoint import ArtifactError
from taic_jax.sources import make_envs, take_over

PAGE = Path(__file__).parents[2] / "docs/use.md"


@pytest.mark.parametrize("name", pretrained_names())
def test_an_agent_returns_as_its_card_says(name):
    handle = taic.load(f"pretrained:{name}")
    card = json.loads((locate(f"pretrained:{name}") / "card.json").read_text())
    result = jax.jit(lambda agent, key: evaluate(handle.env, agent, key, 32, 0.0))(
        handle.agents[TAIC][0], jax.random.key(9)
    )
    returns = card["return_mean_option"]  # without those of flat PPO if the collector has another task
    values = [f"{returns[method]:,.0f}" if method in returns else "" for method in (TAIC, "flat")]
    assert re.search(rf"\| `{name}` \| {values[0]} \| ?{values[1]} \|", PAGE.read_text())
    assert card["task"] == handle.config.env.name and set(handle.agents) == {TAIC, "collect"}
    # The ant's return is the difference of speed and control cost, each of a thousand.
    tolerance = 200.0 if name == "steering" else 0.0
    assert result["return"] == pytest.approx(card["return_mean_option"][TAIC], rel=0.3, abs=tolerance)


@pytest.mark.parametrize(("name", "task"), [("ant_steering", "ant_maze"), ("ant", "ant_turn"), ("nav2d", "nav2d")])
def test_options_are_a_source_for_another_task(name, task):
    source, own = f"pretrained:{name}", taic.load(f"pretrained:{name}")
    options = dataclasses.replace(own.config.options, source=source)
    config = dataclasses.replace(own.config, env=EnvConfig(task), options=options, seeds=2)
    config = replace(replace(config, "collect.env", ""), "train.baselines", ("transfer",))
    taken = take_over(config, *make_envs(config))
    assert_trees_equal(jax.tree.map(lambda x: x[1], taken.model), own.options[0])
    assert taken.flat is not None


def test_unknown_names_are_refused_with_the_nearest():
    with pytest.raises(ArtifactError, match="unknown pretrained agents 'half_cheeta'; the nearest is half_cheetah"):
        taic.load("pretrained:half_cheeta")
    with pytest.raises(ArtifactError, match="unknown pretrained agents 'zebra'; there are ant, ant_steering"):
        locate("pretrained:zebra")
