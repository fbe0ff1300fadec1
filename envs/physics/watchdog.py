"""Say so when a call into the engine does not return, instead of hanging in silence."""

import sys
import threading
import time
import weakref


class Watchdog:
    """A context around calls; one that takes longer than `limit` seconds gets `message` on standard error, once.

    Several threads may be in it. One more looks on from the first call until the watchdog is no longer used. It costs a
    call two assignments.
    """

    def __init__(self, limit: float, message: str):
        self.limit, self.message = limit, message
        self._since: dict[int, float] = {}  # by the caller's thread
        self._thread: threading.Thread | None = None

    def __enter__(self) -> None:
        self._since[threading.get_ident()] = time.monotonic()
        if self._thread is None:
            self._thread = threading.Thread(target=_look_on, args=(weakref.ref(self), self.limit / 4), daemon=True)
            self._thread.start()

    def __exit__(self, *_: object) -> None:
        del self._since[threading.get_ident()]

    def late(self, reported: float | None) -> float | None:
        """Return when the longest running call began if it is late; report it too, unless that is `reported`."""
        since = min(self._since.copy().values(), default=None)
        if since is None or time.monotonic() - since < self.limit:
            return None
        if since != reported:
            print(f"taic_jax: {self.message}", file=sys.stderr, flush=True)
        return since


def _look_on(watchdog: "weakref.ref[Watchdog]", interval: float) -> None:
    reported = None
    while True:
        time.sleep(interval)
        watched = watchdog()
        if watched is None:
            return
        reported = watched.late(reported)
        del watched  # or it would never be collected
