"""Errors a user can cause; one line each, naming the nearest valid value."""

import difflib
from collections.abc import Iterable


class UnknownNameError(ValueError):
    """A name (of an environment, a backend, a pipeline) that does not exist."""

    def __init__(self, kind: str, given: str, valid: Iterable[str]):
        valid = list(valid)
        nearest = difflib.get_close_matches(given, valid, n=1, cutoff=0.0)
        hint = f"did you mean {nearest[0]!r}? " if nearest else ""
        super().__init__(f"unknown {kind} {given!r}: {hint}valid: {', '.join(valid)}")
