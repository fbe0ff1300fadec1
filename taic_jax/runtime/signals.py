"""Early ends of a run: at a signal, after its iteration and saved, or because no seed is left."""

import signal
import sys
from types import FrameType
from typing import Any


class Interrupted(BaseException):  # like KeyboardInterrupt, which no `except Exception` catches either
    """A stop at a signal, after all results are saved."""

    def __init__(self, received: int):
        super().__init__(signal.Signals(received).name)
        self.received = received


class DivergedError(ArithmeticError):
    """The end of the last seed with finite numbers."""


class Signals:
    """Note SIGINT and SIGTERM while in the context, instead of ending in the middle of an iteration.

    After the first one the next SIGINT ends the process at once, by the system's default: Python's handlers would wait
    until the compiled program returns. Files are complete either way. Only a main thread may enter the context.
    """

    def __init__(self) -> None:
        self.received: int | None = None
        self._before: dict[int, Any] = {}

    def __enter__(self) -> "Signals":
        for number in (signal.SIGINT, signal.SIGTERM):
            self._before[number] = signal.signal(number, self._receive)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def check(self) -> None:
        """Raise `Interrupted` if a signal was received."""
        if self.received is not None:
            raise Interrupted(self.received)

    def _receive(self, number: int, frame: FrameType | None) -> None:
        self.received = number
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        print("taic_jax: stopping after this iteration; Ctrl-C ends at once", file=sys.stderr, flush=True)
