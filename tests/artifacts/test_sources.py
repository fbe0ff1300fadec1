"""What a run starts from: experience of others, end to end, and what is refused before anything is written."""

import json
from pathlib import Path

import jax
import numpy as np
import pytest
from safetensors.numpy import load_file
from tiny_runs import CONFIG, files_of, last_state, tiny_steps, with_fields

from taic_jax.artifacts.experience import ExperienceStore
from taic_jax.artifacts.models import describe
from taic_jax.config import Config
from taic_jax.config.files import to_yaml
from taic_jax.envs import make_env
from taic_jax.options import learning
from taic_jax.options.dataset import Experience
from taic_jax.options.model import make_networks
from taic_jax.run import main
from taic_jax.runtime.driver import STAGE_STREAMS
from taic_jax.types import as_arrays

# Nothing is collected where no baseline is asked for.
LEARNER = with_fields(
    CONFIG, evaluate__video_ticks=0, train__baselines=(), options__fraction=1.0, options__select="random", seeds=2
)


@pytest.fixture(scope="module", autouse=True)
def tiny():
    with tiny_steps():
        yield


@pytest.fixture(autouse=True)
def in_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def main_with(config: Config, *args: str) -> int:
    Path("mine.yaml").write_text(to_yaml(config))
    return main(["mine.yaml", "--run-dir", "new", "--quiet", *args])


def experience(ticks: int, first: float, seeds: int = 1) -> Experience:
    """Return experience [K, T, 2, ...] whose observations grow by one a tick, from `first`."""
    count = first + np.arange(ticks, dtype=np.float32)[None, :, None, None]
    obs = np.broadcast_to(count, (seeds, ticks, 2, 2)) + np.arange(seeds, dtype=np.float32)[:, None, None, None]
    action = np.full((seeds, ticks, 2, 2), 0.5, np.float32)
    return Experience(obs, action, np.ones((seeds, ticks, 2), np.float32), np.zeros((seeds, ticks, 2), bool))


def make_run(folder: str, ticks: int, first: float, seeds: int = 1, env: str = "nav2d_random") -> None:
    description = describe(make_env(env)) | {"seeds": seeds}
    ExperienceStore(Path(folder) / "experience", 1, description).write(0, experience(ticks, first, seeds))


def make_demonstrations(path: str, ticks: int, first: float) -> None:
    column = jax.tree.map(lambda x: x[0, :, 0], experience(ticks, first))
    np.savez(path, obs=column.obs, action=column.action, reward=column.reward, done=column.done)


def options() -> dict[str, np.ndarray]:
    return load_file("new/options/arrays.safetensors")


def mean_states() -> list[float]:
    """Return the mean of the first entry over the windows that each option model was learnt from."""
    return options()["state_scale.mean"][:, 0].tolist()


def test_two_runs_and_demonstrations_are_merged():
    """Windows of 2 ticks start at all but the last two ticks of each environment."""
    make_run("a", 12, 0.0)  # 10 starts in each of 2 environments: 0 ... 9
    make_run("b", 12, 100.0, seeds=2)  # 100 ... 109, and 101 ... 110 for the second seed
    make_demonstrations("demo.npz", 22, 1000.0)  # 20 starts: 1000 ... 1019
    config = with_fields(LEARNER, options__experience=("a", "b/experience", "demo.npz"))
    assert main_with(config) == 0
    np.testing.assert_allclose(mean_states(), [(4.5 + 104.5 + 1009.5) / 3, (4.5 + 105.5 + 1009.5) / 3], rtol=0.01)
    assert {path.name for path in Path("new/checkpoints").iterdir()} == {"learn", "train"}
    assert not Path("new/experience").exists()
    assert np.isfinite(last_state(Path("new").absolute(), "train")["state.params.log_std"]).all()


def test_demonstrations_alone_teach_every_seed():
    make_demonstrations("demo.npz", 22, 1000.0)
    assert main_with(with_fields(LEARNER, options__experience=("demo.npz",))) == 0
    np.testing.assert_allclose(mean_states(), [1009.5] * 2, rtol=0.01)
    assert json.loads(Path("new/summary.json").read_text())["ticks"] == 2 * 48


def test_without_steps_the_decoder_is_as_it_was_drawn():
    make_demonstrations("demo.npz", 22, 1000.0)
    config = with_fields(LEARNER, options__experience=("demo.npz",), options__steps=0)
    assert main_with(config) == 0
    networks = make_networks(config.options, 2, 2)
    for seed in range(2):
        key = jax.random.fold_in(jax.random.key(seed), STAGE_STREAMS["learn"])
        drawn = learning.init(as_arrays(config.options), networks, key).params["decoder"]["params"]["head"]["kernel"]
        np.testing.assert_allclose(options()["params.decoder.params.head.kernel"][seed], drawn, rtol=1e-5)
    assert {path.name for path in Path("new/checkpoints").iterdir()} == {"train"}
    np.testing.assert_allclose(mean_states(), [1009.5] * 2, rtol=0.01)


def said(capfd, code: int) -> str:
    """Return the one line that a refused command left, having checked that it left nothing else."""
    out, err = capfd.readouterr()
    assert code == 2 and out == "" and err.count("\n") == 1 and err.startswith("taic_jax: error: ")
    return err


def test_experience_without_a_whole_window_is_told_in_one_line(capfd):
    make_run("a", 2, 0.0)
    err = said(capfd, main_with(with_fields(LEARNER, options__experience=("a",))))
    assert "options.length: expected" in err and "got none of 2 in a between its shares 0 and 1" in err


def test_too_short_for_a_quantile_is_told_in_one_line(capfd):
    make_run("a", 12, 0.0)
    config = with_fields(LEARNER, options__experience=("a",), options__termination="predict")
    assert "options.delta_unit: quantile needs 160 ticks" in said(capfd, main_with(config))


def make_config(folder: str) -> None:
    Path(folder).mkdir()
    Path(folder, "config.yaml").write_text(to_yaml(LEARNER))


def write_thesis() -> None:
    Path("a/options").mkdir(parents=True)
    Path("a/options/thesis.txt").write_text("years of work")


REFUSED = {  # the source, what is there, and two parts of the line
    "no run": ("options__source", lambda: None, "a: expected a run that got this far, or its option model", "got none"),
    "foreign folder": ("options__source", write_thesis, "a/options: expected a run", "got none"),
    "no experience": ("options__experience", lambda: None, "a: expected a run that collected experience", "got none"),
    "folder of something": ("options__experience", write_thesis, "a: expected main_data.hdf5", "supported"),
    "run without experience": (
        "options__experience",
        lambda: make_config("a"),
        "a: expected a run that collected experience, or recorded data",
        "got none",
    ),
    "experience of another body": (
        "options__experience",
        lambda: make_run("a", 12, 0.0, env="hopper"),
        "a/experience/description.json: proprioception: expected 'point', which nav2d needs",
        "got 'hopper'",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_a_run_cannot_start_from_is_told_before_anything_is_written(capfd, case):
    field, make, first, second = REFUSED[case]
    make()
    there = files_of(Path())
    config = with_fields(LEARNER, **{field: "a" if field == "options__source" else ("collect", "a")})
    err = said(capfd, main_with(config))
    assert first in err and second in err
    assert set(files_of(Path())) == {*there, "mine.yaml"}


def test_a_transfer_needs_the_run_and_its_flat_policy(capfd):
    config = with_fields(LEARNER, train__baselines=("transfer",))
    assert "transfer" in (err := said(capfd, main_with(config))) and "add --options RUN" in err
    assert not Path("new").exists()


def test_what_a_run_starts_from_is_not_overwritten(capfd):
    make_run("new", 12, 0.0)
    Path("new/config.yaml").write_text(to_yaml(LEARNER))
    there = files_of(Path("new"))
    config = with_fields(LEARNER, options__experience=("new/experience",))
    err = said(capfd, main_with(config, "--overwrite"))
    assert "new holds what this run starts from, new/experience, so it is not overwritten" in err
    assert files_of(Path("new")) == there
