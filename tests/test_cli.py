"""The command line: what it accepts, and that every mistake is one line, exit code 2, nothing written."""

import dataclasses
import inspect
import signal
import subprocess
import sys
import types
from pathlib import Path

import pytest

from taic_jax import __version__, command_line, run
from taic_jax.config import CONFIG_CLASSES, Config, ConfigError
from taic_jax.config.files import load_config, to_yaml
from taic_jax.run import PROGRAM, Command, main
from taic_jax.runtime.checkpoint import ArtifactError
from taic_jax.runtime.signals import Interrupted


def parse(args):
    return command_line.parse(args, PROGRAM, Command)


@pytest.fixture(autouse=True)
def in_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def pipeline(monkeypatch):
    """Stand in for the pipeline, and record what it is asked to run."""
    calls = []

    def run_pipeline(config, run_dir, *, resume, overwrite, quiet, signals, checkpoint_seconds, shard):
        calls.append((config, run_dir, resume, overwrite))
        return None, {}

    fake = types.SimpleNamespace(run_pipeline=run_pipeline, check_run=lambda *args, **settings: ("env", "source"))
    summary = types.SimpleNamespace(plan=lambda *args: "the plan", as_table=lambda *args: "the table")
    monkeypatch.setitem(sys.modules, "taic_jax.pipeline", fake)
    monkeypatch.setitem(sys.modules, "taic_jax.summary", summary)
    return calls


def test_without_arguments_the_default_preset_runs(pipeline):
    assert main([]) == 0
    ((config, run_dir, resume, overwrite),) = pipeline
    assert config == load_config("nav2d") and not resume and not overwrite
    assert run_dir.parent == Path("runs") and run_dir.name.startswith("nav2d-")


def test_options_override_the_preset_however_they_are_spelled():
    args = ["half_cheetah", "--train.ppo.learning-rate", "1e-2", "--train.ppo.num_envs=32", "--seeds", "3"]
    config = parse([*args, "--options.mlp-sizes", "8", "4", "--train.baselines", "--train.ppo.lambda_", "0.5"]).config
    assert (config.train.ppo.learning_rate, config.train.ppo.num_envs, config.seeds) == (1e-2, 32, 3)
    assert (config.options.mlp_sizes, config.train.baselines, config.train.ppo.lambda_) == ((8, 4), (), 0.5)
    assert config.collect == load_config("half_cheetah").collect


def test_the_config_may_stand_last_or_be_a_file():
    Path("mine.yaml").write_text("seed: 5\nenv: {name: ant}")
    for args in (["--seeds", "2", "mine.yaml"], ["mine.yaml", "--seeds", "2"], ["./mine.yaml", "--seeds=2"]):
        config = parse(args).config
        assert (config.seed, config.seeds, config.env.name) == (5, 2, "ant")


def test_resume_takes_the_config_of_the_run(pipeline):
    Path("old").mkdir()
    Path("old/config.yaml").write_text(to_yaml(load_config("ant")))
    assert main(["--resume", "--run-dir", "old"]) == 0
    assert main(["nav2d", "--resume", "--run-dir", "old"]) == 0
    assert [call[0].env.name for call in pipeline] == ["ant", "nav2d"]
    assert pipeline[0][1:] == (Path("old"), True, False)


def test_the_end_is_a_table_the_next_commands_and_the_path(pipeline, capsys):
    assert main(["--run-dir", "a"]) == 0
    assert main(["--run-dir", "a", "--quiet"]) == 0
    table, report, curves, path, alone = capsys.readouterr().out.splitlines()
    assert table == "the table" and report.endswith("python -m taic_jax.report a")
    assert curves.endswith("tensorboard --logdir a") and path == alone == "a/summary.json"


def test_integers_may_have_an_exponent():
    for args in (["--train.ticks", "1e6"], ["--train.ticks=1.0E6"], ["--train.ticks", "1_000_000"]):
        assert parse(args).config.train.ticks == 1_000_000
    assert parse(["--options.mlp-sizes", "1e2", "3"]).config.options.mlp_sizes == (100, 3)
    Path("mine.yaml").write_text("train: {ticks: 1e6}\ncollect: {ticks: 1.5e6}\nseed: 1.0e+1")
    config = parse(["mine.yaml"]).config
    assert (config.train.ticks, config.collect.ticks, config.seed) == (1_000_000, 1_500_000, 10)


def test_the_version_is_that_of_the_package(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"taic_jax {__version__}\n"


def test_dry_run_prints_the_differences_and_the_plan_and_stops(pipeline, capsys):
    Path("empty.yaml").write_text("{}")
    for args in (["ant", "--seed", "3", "--train.baselines"], ["transfer_ant_maze", "--options", "a"], ["empty.yaml"]):
        assert main([*args, "--dry-run", "--quiet"]) == 0
        Path("printed.yaml").write_text((out := capsys.readouterr().out).replace("the plan", ""))
        assert load_config("printed.yaml") == parse(args).config
        assert ("# by default nav2d\n" in out) == ("ant" in args[0]) and "gamma: 0.99 " not in out
        assert out.endswith("\n\nthe plan\n") and pipeline == []


def test_options_of_a_run_are_short_for_their_source():
    for args in (["--options", "runs/a"], ["--options=runs/a"], ["--options.source", "runs/a"]):
        assert parse(["ant", *args]).config.options.source == "runs/a"
        config = parse(["transfer_ant_turn", *args, "--options.length", "4"]).config
        assert (config.options.source, config.options.length, config.env.name) == ("runs/a", 4, "ant_turn")


BAD_ARGUMENTS = {
    "transfer from nowhere": (
        "ant --train.baselines transfer",
        "train.baselines: expected with transfer a run",
        "add --options RUN",
    ),
    "options of nothing": ("ant --options", "--options: expected text", "nothing"),
    "options and experience": (
        "ant --options a --options.experience b",
        "options.experience: expected none with options.source",
        "got ['b']",
    ),
    "unknown preset": ("nav2", "unknown preset 'nav2'", "nearest is nav2d"),
    "missing file": ("missing.yaml", "missing.yaml", "No such file"),
    "folder": ("./", "./", "directory"),
    "two configs": ("nav2d ant", "unexpected argument", "one CONFIG"),
    "unknown option": (
        "--train.ppo.learning-rat 1",
        "--train.ppo.learning-rat;",
        "--train.ppo.learning_rate",
    ),
    "option without group": (
        "--learning_rate_estimator 1",
        "unknown option",
        "--options.learning_rate_estimator",
    ),
    "unknown group": ("--trian.ticks 3", "--trian.ticks", "--train.ticks"),
    "hyphen at the end": ("--train.ppo.lambda- 0.9", "unknown option --train.ppo.lambda-;", "is --train.ppo.lambda_"),
    "group as option": ("--train.ppo 3", "unknown option --train.ppo;", "nearest is --train.ppo."),
    "short option": ("-x", "unknown option -x", "--help lists them"),
    "like no option": ("--zebra 3", "unknown option --zebra; --help lists them", "--zebra"),
    "another library's word": ("--lr 1", "unknown option --lr;", "nearest is --train.ppo.learning_rate"),
    "such a word in a group": ("--collect.ppo.lr 1", "option --collect.ppo.lr;", "is --collect.ppo.learning_rate"),
    "the task by another word": ("--env ant", "unknown option --env;", "nearest is --env.name"),
    "like no preset": ("zebra", "unknown preset 'zebra'; there are ant, ", "a file's name ends in .yaml"),
    "text for float": ("--train.ppo.clip wide", "--train.ppo.clip: expected a number", "'wide'"),
    "float for integer": ("--seeds 2.6", "--seeds: expected an integer, got '2.6'", "nearest is 3"),
    "exponent for a fraction": ("--train.ticks 15e-1", "--train.ticks: expected an integer", "nearest is 2"),
    "empty value": ("--seed=", "--seed: expected an integer", "nothing"),
    "no value": ("--seed", "--seed: expected an integer", "nothing"),
    "no folder": ("--run-dir", "--run-dir: expected", "nothing"),
    "unknown choice": ("--env.backend mujco", "--env.backend: expected one of auto", "nearest is mujoco"),
    "case of a bool": (
        "--train.ppo.learning-rate-decay false",
        "--train.ppo.learning-rate-decay: expected one of True, False",
        "nearest is False",
    ),
    "unknown baseline": (
        "--train.baselines flat totl",
        "--train.baselines: expected a list of some of flat, repeat, total, transfer",
        "nearest is",
    ),
    "text in a list": ("--options.mlp-sizes 8 x", "--options.mlp-sizes: expected a list", "'8 x'"),
    "config after a list": ("--options.mlp-sizes 8 ant", "--options.mlp-sizes: expected a list", "'8 ant'"),
    "empty list": ("--options.mlp-sizes", "options.mlp_sizes: expected at least one", "64"),
    "second of two": ("--seed 1 --train.ppo.epochs x", "--train.ppo.epochs: expected an integer", "'x'"),
    "zero": ("--seeds 0", "seeds: expected", "got 0; the nearest valid value is 1"),
    "negative": ("--seed -1", "seed: expected", "got -1; the nearest valid value is 0"),
    "outside": ("--options.fraction 1.5", "options.fraction: expected", "nearest valid value is 1"),
    "not a number": ("--train.ppo.gamma nan", "train.ppo.gamma: expected", "got nan"),
    "budget below one iteration": (
        "half_cheetah --train.ticks 9",
        "train.ticks: expected",
        "nearest valid value is 8192",
    ),
    "option longer than rollout": (
        "--options.length 9999",
        "options.length: expected",
        "train.ppo.rollout_length",
    ),
    "quantile of nothing learnt": (
        "--options.termination predict --options.steps 0",
        "options.delta_unit: expected error with options.steps 0",
        "nearest valid value is error",
    ),
    "minibatch above rollout": (
        "half_cheetah --train.ppo.minibatch-size 99999",
        "train.ppo.minibatch_size",
        "8192",
    ),
    "resume what": ("--resume", "--resume: expected", "--run-dir"),
    "resume and overwrite": ("--resume --overwrite --run-dir x", "--resume and --overwrite", "at most one"),
    "no hosts": ("--hosts 0", "--hosts: expected at least 1", "got 0; the nearest valid value is 1"),
    "host beyond the last": ("--hosts 2 --host 2", "--host: expected 0 to 1", "got 2; the nearest valid value is 1"),
    "hosts without a folder": ("--hosts 2 --coordinator a:1", "--hosts: expected --run-dir DIR too", "every host"),
    "hosts that meet nowhere": ("--hosts 2 --run-dir x", "--coordinator: expected HOST:PORT", "got ''"),
    "port beyond the last": ("--hosts 2 --run-dir x --coordinator a:99999", "--coordinator: expected", "1 to 65535"),
    "hosts with nothing split": (
        "--hosts 2 --run-dir x --coordinator a:1 --shard none",
        "--shard: expected what to split over the hosts",
        "got none",
    ),
}


@pytest.mark.parametrize(("args", "first", "second"), BAD_ARGUMENTS.values(), ids=BAD_ARGUMENTS)
def test_bad_arguments_are_told_in_one_line(capfd, args, first, second):
    assert main(args.split()) == 2
    out, err = capfd.readouterr()
    assert out == "" and err.count("\n") == 1 and err.startswith("taic_jax: error: ")
    assert first in err and second in err
    assert list(Path().iterdir()) == []


def test_malformed_yaml_is_told_in_one_line(capfd):
    Path("bad.yaml").write_text("train: [\n")
    assert main(["bad.yaml", "--run-dir", "new"]) == 2
    out, err = capfd.readouterr()
    assert out == "" and err.count("\n") == 1 and "bad.yaml" in err and "line 2" in err
    assert not Path("new").exists()


@pytest.mark.parametrize(
    "error", [ConfigError("of config"), ArtifactError("of\nartifact"), PermissionError(13, "no", "x")]
)
def test_mistakes_found_later_are_told_alike(monkeypatch, capsys, error):
    monkeypatch.setattr(run, "execute", lambda command: (_ for _ in ()).throw(error))
    assert main([]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_errors_of_the_program_keep_their_traceback(monkeypatch):
    monkeypatch.setattr(run, "execute", lambda command: int("not a mistake of the user"))
    with pytest.raises(ValueError, match="invalid literal"):
        main([])


@pytest.mark.parametrize("stop", [KeyboardInterrupt(), Interrupted(signal.SIGINT)])
def test_interrupt_exits_130_and_tells_how_to_continue(pipeline, monkeypatch, capsys, stop):
    module = sys.modules["taic_jax.pipeline"]
    monkeypatch.setattr(module, "run_pipeline", lambda *args, **kwargs: (_ for _ in ()).throw(stop))
    assert main(["--run-dir", "mine"]) == 130
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and "--resume --run-dir mine" in err


def test_help_shows_every_field_with_its_help(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["half_cheetah", "--help-all"])
    out = " ".join(capsys.readouterr().out.split())
    assert stop.value.code == 0
    for part in (
        "[OPTIONS] CONFIG",
        "--run-dir DIR",
        "--train.ppo.learning-rate FLOAT",
        "half_cheetah",
        "Discount per tick.",
    ):
        assert part in out


def test_every_field_has_help():
    for cls in CONFIG_CLASSES:
        lines = [line for kind in cls.__mro__[:-1] for line in inspect.getsource(kind).splitlines()]
        for field in dataclasses.fields(cls):
            if not dataclasses.is_dataclass(field.type):
                at = next(i for i, line in enumerate(lines) if line.startswith(f"    {field.name}: "))
                assert lines[at + 1].startswith('    """'), f"{cls.__name__}.{field.name} has no help"


PARSE_WITHOUT_JAX = """
import signal
import sys
from taic_jax import run
run.execute = lambda command: print(sorted({"jax", "mujoco"} & sys.modules.keys()), command.config.seed)
sys.exit(run.main(["half_cheetah", "--seed", "7"]))
"""


def test_arguments_are_parsed_before_jax_is_imported():
    root = Path(run.__file__).parents[1]
    done = subprocess.run([sys.executable, "-c", PARSE_WITHOUT_JAX], cwd=root, capture_output=True, text=True)
    assert (done.stdout, done.returncode) == ("[] 7\n", 0), done.stderr


def test_the_module_exits_with_the_code_of_main():
    root = Path(run.__file__).parents[1]
    command = [sys.executable, "-m", "taic_jax.run", "--seeds", "0"]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and done.stdout == ""


def test_config_is_frozen():
    with pytest.raises(AttributeError):
        Config().seed = 3  # pyright: ignore[reportAttributeAccessIssue]
