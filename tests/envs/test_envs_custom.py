"""Environments of the user's own: what is found, what is refused and how, and the guide's two examples."""

import re
import shlex
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from quadruped import write_checkout

from taic_jax import run
from taic_jax.command_line import typed
from taic_jax.envs import AutoReset, Env, TimeLimit, check_contract, custom, make_env
from taic_jax.envs.custom import CustomEnvError, load_custom
from taic_jax.envs.errors import UnknownNameError
from taic_jax.handles import pictures

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "experiments" / "examples"
PENDULUM, ARM = (f"experiments/examples/{name}" for name in ("pendulum.py:Pendulum", "reacher_arm.py:ReacherArm"))
GUIDE = (ROOT / "docs" / "environments.md").read_text()

MINE = """
from taic_jax.envs import Env

class Base(Env):
    name = "mine"
    def reset(self, key): ...
    def step(self, state, action): ...
    def render(self, physics, *, height=240, width=320): ...

class Plain(Base):
    pass

class Threads(Base):
    def __init__(self, num_threads):
        self.given = num_threads

class Both(Base):
    def __init__(self, mass=1.0, *, backend, num_threads):
        self.given = mass, backend, num_threads

class Heavy(Base):
    def __init__(self, mass):
        pass

class Broken(Base):
    def __init__(self):
        raise RuntimeError("out of\\nplaces")

class Abstract(Env):
    def reset(self, key): ...

class Other:
    pass

number = 3
"""
FILES = {
    "mine.py": MINE,
    "empty.py": "from taic_jax.envs import Env",
    "typo.py": "x = 1\nclass A(:",
    "fails.py": "import math\n\nmath.sqrt(-1)",
    "deep.py": "import re\n\nre.compile('(')",
    "stops.py": "import sys\nsys.exit(7)",
    "needs.py": "import not_there_at_all",
    "inside/__init__.py": "",
    "inside/mine.py": MINE,
    "inside/needs.py": "from inside import not_there",
}


@pytest.fixture(autouse=True)
def folder(request, tmp_path, monkeypatch):
    """Work in a folder that holds `FILES`, from which Python imports too, as with `python -m`."""
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    before = set(sys.modules)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path
    for name in set(sys.modules) - before:
        if name.partition(".")[0] in ("inside", "mine") or name.startswith("custom_env_"):
            del sys.modules[name]


def test_a_class_gets_the_parameters_it_names_and_no_others():
    assert type(load_custom("mine.py:Plain", "mjx", 3)).__name__ == "Plain"
    assert vars(load_custom("mine.py:Threads", "mjx", 3))["given"] == 3
    assert vars(load_custom("inside.mine:Both", "mjx", 3))["given"] == (1.0, "mjx", 3)


def test_a_file_is_imported_once_and_does_not_collide(folder):
    first, again = load_custom("mine.py:Plain"), load_custom(f"{folder}/inside/../mine.py:Plain")
    assert type(first) is type(again)
    elsewhere = load_custom("inside/mine.py:Plain")
    assert type(elsewhere) is not type(first) and "mine" not in sys.modules
    assert sys.modules[type(first).__module__].__file__ == str(folder / "mine.py")
    assert "." not in type(first).__module__, "or it would have a parent, and relative imports would look there"


REFUSED = {
    "no class": ("mine.py", UnknownNameError, "unknown environment 'mine.py:'", "did you mean 'mine.py:"),
    "no source": (":Plain", CustomEnvError, "expected FILE.py:CLASS or MODULE:CLASS", "':Plain'"),
    "no file": ("mnie.py:Plain", CustomEnvError, "mnie.py: no such file", "the nearest is mine.py"),
    "no file there": ("inside/mnie.py:Plain", CustomEnvError, "no such file", "the nearest is inside/mine.py"),
    "no folder": ("outside/mine.py:Plain", CustomEnvError, "no such file", "outside holds no .py files"),
    "a folder": ("inside:Plain", CustomEnvError, "got nothing of this name", "inside has none"),
    "no module": ("inside.mnie:Plain", CustomEnvError, "no module inside.mnie", "the nearest is inside.mine"),
    "no package": ("insite.mine:Plain", CustomEnvError, "no module insite", "the nearest is inside"),
    "relative": (".mine:Plain", CustomEnvError, "importing .mine: TypeError", "package"),
    "no such class": ("mine.py:Plane", UnknownNameError, "'mine.py:Plane'", "did you mean 'mine.py:Plain'?"),
    "in a module": ("inside.mine:Plane", UnknownNameError, "'inside.mine:Plane'", "'inside.mine:Plain'?"),
    "nothing inside": ("empty.py:Plain", CustomEnvError, "got nothing of this name", "empty.py has none"),
    "another class": ("mine.py:Other", CustomEnvError, "subclass of taic_jax.envs.Env, got class Other", "nearest is"),
    "no class at all": ("mine.py:number", CustomEnvError, "subclass of taic_jax.envs.Env, got 3", "the nearest is"),
    "abstract": ("mine.py:Abstract", CustomEnvError, "mine.py:Abstract: expected it to define render, step", ""),
    "syntax": ("typo.py:A", CustomEnvError, "importing typo.py: SyntaxError: invalid syntax", "typo.py, line 2"),
    "import": ("fails.py:A", CustomEnvError, "importing fails.py: ValueError: ", "(line 3 of "),
    "deep inside": ("deep.py:A", CustomEnvError, "importing deep.py: ", "deep.py)"),
    "exit": ("stops.py:A", CustomEnvError, "importing stops.py: SystemExit: 7", "(line 2 of "),
    "its import": ("needs.py:A", CustomEnvError, "importing needs.py: ModuleNotFoundError: No module", "(line 1 of "),
    "a module's": ("inside.needs:A", CustomEnvError, "importing inside.needs: ImportError: cannot", "not_there"),
    "making": ("mine.py:Broken", CustomEnvError, "making mine.py:Broken: RuntimeError: out of places (line 27", ""),
    "parameter": ("mine.py:Heavy", CustomEnvError, "making mine.py:Heavy: TypeError: ", "'mass'"),
}


@pytest.mark.parametrize(("name", "kind", "first", "second"), REFUSED.values(), ids=REFUSED)
def test_mistakes_are_told_in_one_line(name, kind, first, second):
    with pytest.raises(kind) as error:
        load_custom(name)
    message = str(error.value)
    assert first in message and second in message and "\n" not in message
    if re.match("(importing|making) ", message):
        assert error.value.__cause__ is not None


def test_a_file_that_failed_is_imported_anew(folder):
    for _ in range(2):
        with pytest.raises(CustomEnvError, match="ValueError"):
            load_custom("fails.py:Plain")
    (folder / "fails.py").write_text(MINE)
    assert load_custom("fails.py:Plain").name == "mine"


@pytest.mark.parametrize(
    ("name", "says"),
    [("mine.py:Plane", "did you mean 'mine.py:Plain'"), ("typo.py:A", "SyntaxError"), ("mine.py:Plain", "is missing")],
)
def test_the_command_line_tells_them_in_one_line_and_writes_nothing(name, says, folder, capfd):
    assert run.main(["--env.name", name, "--run-dir", "new"]) == 2
    out, err = capfd.readouterr()
    assert out == "" and err.startswith("taic_jax: error: ") and says in err and err.count("\n") == 1
    assert not (folder / "new").exists()


def random_run(env: Env, ticks: int):
    """Act at random from one start, with automatic resets; return the states after each tick, leading axis T."""
    env = AutoReset(env)

    def tick(state, key):
        state = env.step(state, jax.random.uniform(key, (env.action_size,), minval=-1.0))
        return state, state.replace(key=None)

    keys = jax.random.split(jax.random.key(1), ticks)
    return jax.device_get(jax.jit(lambda key: jax.lax.scan(tick, env.reset(key), keys)[1])(jax.random.key(0)))


@pytest.mark.parametrize(("name", "backend"), [(PENDULUM, "auto"), (ARM, "mujoco"), (ARM, "mjx")])
def test_examples_keep_the_contract(name, backend, monkeypatch):
    monkeypatch.chdir(ROOT)
    env = load_custom(name, backend)
    check_contract(env)
    states = random_run(TimeLimit(env, 5), 12)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(states))
    np.testing.assert_array_equal(np.flatnonzero(states.truncated), [4, 9])
    assert not states.terminated.any() and (states.reward != 0).all()
    assert len(np.unique(states.obs, axis=0)) == 12


def test_the_arm_is_the_same_on_both_backends(monkeypatch):
    monkeypatch.chdir(ROOT)
    envs = [make_env(ARM, backend) for backend in ("mujoco", "mjx")]
    assert [type(env.physics).__name__ for env in envs] == ["MujocoPhysics", "MjxPhysics"]
    mujoco, mjx = (random_run(env, 20).obs for env in envs)
    np.testing.assert_allclose(mujoco, mjx, atol=1e-4)


def test_the_pendulum_conserves_energy_but_for_damping_and_motor(monkeypatch):
    monkeypatch.chdir(ROOT)
    env = load_custom(PENDULUM)
    module = sys.modules[type(env).__module__]
    monkeypatch.setattr(module, "DAMPING", 0.0)
    start = env.reset(jax.random.key(0)).replace(physics=jnp.array([2.0, 0.0]))
    angle, speed = jax.lax.scan(lambda state, _: (env.step(state, jnp.zeros(1)),) * 2, start, length=60)[1].physics.T
    energy = speed**2 / 2 + module.GRAVITY * jnp.cos(angle)
    np.testing.assert_allclose(energy, energy[0], atol=1.2)  # of the integrator's; it swings through 5.7
    assert angle.max() > 4.2 and angle.min() < 2.1


TINY = """--collect.ticks 48 --collect.capacity 32 --train.ticks 48 --options.length 2 --options.hidden-size 4
    --options.mlp-sizes 4 --options.steps 4 --options.batch-size 8 --evaluate.episodes 1 --evaluate.video-ticks 3"""
TINY_PPO = ["num-envs", "2", "rollout-length", "8", "epochs", "1", "minibatch-size", "16", "hidden-sizes", "4"]


@pytest.mark.parametrize("name", ["pendulum", "reacher_arm"])
def test_examples_train_by_the_command_line(name, tmp_path, monkeypatch):
    monkeypatch.chdir(ROOT)
    ppo = [
        argument
        for stage in ("collect", "train")
        for field, value in zip(TINY_PPO[::2], TINY_PPO[1::2], strict=True)
        for argument in (f"--{stage}.ppo.{field}", value)
    ]
    source = f"experiments/examples/{name}.yaml"
    assert run.main([source, "--run-dir", str(tmp_path / "run"), *TINY.split(), *ppo]) == 0
    assert {"summary.json", "video.webp", "options"} <= {path.name for path in (tmp_path / "run").iterdir()}


SHOWN = sorted(path for name in ("pendulum", "reacher_arm", "sidestep") for path in EXAMPLES.glob(f"{name}.*"))


@pytest.mark.parametrize("path", SHOWN, ids=str)
def test_the_guide_holds_the_examples_word_for_word(path):
    language = {".py": "python", ".yaml": "yaml"}[path.suffix]
    blocks = re.findall(rf"^```{language}\n(.*?)^```$", GUIDE, re.MULTILINE | re.DOTALL)
    assert path.read_text() in blocks
    assert len(path.read_text().splitlines()) <= {"pendulum.py": 50}.get(path.name, 60)


def commands() -> list[str]:
    lines = re.findall(r"^((?:python -m taic_jax|taic ).*)$", GUIDE, re.MULTILINE)
    return [line.partition("#")[0].strip() for line in lines]


@pytest.mark.parametrize("command", commands())
def test_commands_of_the_guide_are_valid(command, monkeypatch, tmp_path):
    monkeypatch.chdir(ROOT)
    if "sidestep" in command:
        pytest.importorskip("mujoco_menagerie")
        monkeypatch.setenv("MENAGERIE_ROOT", str(write_checkout(tmp_path)))
    program, *args = shlex.split(command)
    if program == "python":
        assert args[1] == "taic_jax.run" and run.main([*args[2:], "--dry-run", "--quiet"]) == 0
    else:
        assert args[0] == "envs" and typed(args[1:], "", pictures.Arguments)


def test_the_guide_has_commands_and_names_the_forms():
    assert {"taic_jax.run", "envs"} <= {word for command in commands() for word in shlex.split(command)}
    assert all(form in GUIDE for form in custom.FORMS.split(" or "))
