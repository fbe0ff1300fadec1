"""Why a run ends before its end: signals ask it to, after its iteration and saved, or no seed is left."""

import signal
import sys
from types import FrameType
from typing import Any


class Interrupted(BaseException):  # like KeyboardInterrupt, which no `except Exception` catches either
    """A run stopped as it was asked to, with all that it had done saved."""

    def __init__(self, received: int):
        super().__init__(signal.Signals(received).name)
        self.received = received


class DivergedError(ArithmeticError):
    """No seed is left whose numbers are finite."""


class Signals:
    """Note SIGINT and SIGTERM while in the context, instead of ending in the middle of an iteration.

    After the first SIGINT the next one ends the process at once, by the system's own doing: Python would only hear
    of it when the compiled program returns. What was saved is whole either way. Outside the context nothing is
    received. Only a main thread may enter it.
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
