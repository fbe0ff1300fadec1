"""Report a call into the engine that does not return, instead of a silent hang."""

import sys
import threading
import time
import weakref


class Watchdog:
    """A context around calls from any threads; one of more than `limit` seconds gets `message` on standard error, once.

    A thread of its own watches from the first call until the watchdog is garbage. It costs a call two assignments.
    """

    def __init__(self, limit: float, message: str):
        self.limit, self.message = limit, message
        self._since: dict[int, float] = {}  # by the caller's thread
        self._thread: threading.Thread | None = None

    def __enter__(self) -> None:
        self._since[threading.get_ident()] = time.monotonic()
        if self._thread is None:
            self._thread = threading.Thread(target=_watch, args=(weakref.ref(self), self.limit / 4), daemon=True)
            self._thread.start()

    def __exit__(self, *_: object) -> None:
        del self._since[threading.get_ident()]

    def late(self, reported: float | None) -> float | None:
        """Return the start of the longest running call if it is late, and report it unless that is `reported`."""
        since = min(self._since.copy().values(), default=None)
        if since is None or time.monotonic() - since < self.limit:
            return None
        if since != reported:
            print(f"taic_jax: {self.message}", file=sys.stderr, flush=True)
        return since


def _watch(watchdog: "weakref.ref[Watchdog]", interval: float) -> None:
    reported = None
    while True:
        time.sleep(interval)
        alive = watchdog()
        if alive is None:
            return
        reported = alive.late(reported)
        del alive  # or it would never be collected
