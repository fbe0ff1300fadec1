"""The part that the commands on a finished run share: its agents, on its task or on another one."""

import dataclasses
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import tyro

from taic_jax.command_line import tell, typed
from taic_jax.config import COLLECT, ConfigError, EnvConfig, impossible
from taic_jax.config.checks import validate
from taic_jax.config.files import nearest

if TYPE_CHECKING:  # it imports JAX, without which the command lines answer
    from taic_jax.handles.load import Handle
    from taic_jax.rl.agent import Agent


@dataclass(frozen=True)
class OnRun:
    """Arguments of a command on a finished run."""

    run: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="RUN")] = ""
    """Folder of a finished run, or of the agents of a method in it, or pretrained:NAME."""


@dataclass(frozen=True)
class OnTask(OnRun):
    """Arguments of a command that simulates a task, by default that of the run."""

    key: int = 0
    """Seed of the PRNG key that the episodes are drawn with."""
    env: Annotated[EnvConfig, tyro.conf.FlagConversionOff] = EnvConfig()


@dataclass(frozen=True)
class Command(OnTask):
    """Arguments of a command that lets the agents of a finished run act."""

    methods: tuple[str, ...] = ()
    """Methods by name, such as taic and flat; none takes those that the command is for."""
    explore: tyro.conf.FlagCreatePairsOff[bool] = False
    """Act with the noise of training, in place of the mean options or actions."""


C = TypeVar("C", bound=OnRun)


def answer(args: Sequence[str] | None, program: str, kind: type[C], execute: Callable[[C, "Handle"], object]) -> int:
    """Execute a command on the run that it names, whose task is the default one, and return the exit code."""
    args = sys.argv[1:] if args is None else args

    def work() -> None:
        if "-h" in args or "--help" in args:
            typed(args, program, kind)
        if not args or args[0].startswith("-"):
            raise ConfigError("RUN: expected the folder of a finished run first, got none")
        from taic_jax.handles.load import load
        from taic_jax.runtime.program_cache import keep_programs

        keep_programs()
        handle = load(args[0])
        own: dict[str, Any] = {"env": handle.config.env} if issubclass(kind, OnTask) else {}
        command = typed(args, program, kind, default=kind(args[0], **own))
        if isinstance(command, OnTask):
            handle = dataclasses.replace(handle, config=dataclasses.replace(handle.config, env=command.env))
            validate(handle.config)
        execute(command, handle)

    return tell(work)


def methods_of(command: Command, handle: "Handle", default: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the methods that the command is about, or raise ConfigError if the run has none such for this task."""
    own = [name for name in handle.agents if name != COLLECT]
    methods = command.methods or tuple(name for name in default if name in own) or tuple(own)
    env = handle.env
    if not methods:
        raise ConfigError(f"RUN: expected agents, got {command.run}, which has option models alone")
    for name in methods:
        agent = agent_of(handle, name, "--methods")
        sizes = [agent.observation_size, agent.action_size]
        if sizes != [env.observation_size, env.action_size]:
            expected = f"a task with {sizes[0]} observations and {sizes[1]} actions, as {name} was trained for"
            got = f"{env.name} with {env.observation_size} and {env.action_size}"
            raise impossible("--env.name", got, expected)
    return methods


def agent_of(handle: "Handle", method: str, option: str, seed: int = 0) -> "Agent":
    """Return the agent of a method, as named by a command line's `option`, and of a seed, or raise ConfigError."""
    if method not in handle.agents:
        if not handle.agents:
            raise ConfigError(f"{option}: expected a run with agents, this has option models alone")
        expected = f"some of {', '.join(handle.agents)}"
        raise ConfigError(f"{option}: expected {expected}, got {method}{nearest(method, handle.agents)}")
    last = len(handle.agents[method]) - 1
    if not 0 <= seed <= last:
        raise impossible("--seed", seed, f"0 to {last}", min(max(seed, 0), last))
    return handle.agents[method][seed]
