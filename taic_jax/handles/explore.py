"""Move through the options of a finished run in the browser: `taic explore RUN`; see docs/use.md."""

import contextlib
import io
import signal
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from taic_jax.config import ConfigError, impossible
from taic_jax.handles import command
from taic_jax.handles.command import answer

if TYPE_CHECKING:
    from taic_jax.handles.load import Handle

PROGRAM = "taic explore"


@dataclass(frozen=True)
class Command(command.OnTask):
    """Serve a page that executes options by their codes, with ghosts, paths between two codes, and a map."""

    seed: int = 0
    """Seed of the run whose options are shown, counted from 0."""
    port: int = 8080
    """Port of the page on this machine."""


def main(args: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code: 130 when Ctrl-C ends it, 2 for a mistake or a missing extra."""
    return answer(args, PROGRAM, Command, execute)


def execute(command: Command, handle: "Handle") -> None:
    """Serve the page until Ctrl-C."""
    model, env, last = handle.options, handle.env, len(handle.options) - 1
    for name, value, low, high in (("seed", command.seed, 0, last), ("port", command.port, 1, 65535)):
        if not low <= value <= high:
            raise impossible(f"--{name}", value, f"{low} to {high}", min(max(value, low), high))
    from taic_jax.envs.adapters.admission import extra
    from taic_jax.envs.scenes import make_scene
    from taic_jax.options.execution import make_executor

    with extra("explore"):
        from taic_jax.handles.option_page import OptionPage, ViserServer
    if (scene := make_scene(env)) is None:
        raise ConfigError(f"--env.name: expected a task with a model in MuJoCo, or nav2d; got {env.name}")
    model = model[command.seed]
    sizes = [model.state_size, model.networks.decoder.action_size]
    if sizes != [env.proprioceptive_size, env.action_size]:
        expected = f"a body with {sizes[0]} observations and {sizes[1]} actions, as the options were learnt on"
        raise impossible("--env.name", env.name, expected)
    with contextlib.redirect_stdout(io.StringIO()):  # its banner, which also names a port that is not the one asked for
        server = ViserServer("localhost", command.port, label="options", verbose=False)
    try:
        if (free := server.get_port()) != command.port:
            raise impossible("--port", command.port, "a free port", free)
        page = OptionPage(server, env, scene, make_executor(handle.config.options, model), command.key)
        print(f"http://localhost:{command.port} (Ctrl-C ends it)", flush=True)
        ended = threading.Event()
        signal.signal(signal.SIGINT, lambda *_: ended.set())  # raised in a library's callback, it could be lost
        page.play(ended)
        raise KeyboardInterrupt
    finally:
        server.stop()
