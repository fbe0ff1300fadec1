"""Errors a user can cause or mend; one line each."""

import difflib
from collections.abc import Iterable


class UnknownNameError(ValueError):
    """A name, of an environment say, that does not exist; the message gives the nearest that does."""

    def __init__(self, kind: str, given: str, valid: Iterable[str]):
        valid = list(valid)
        nearest = difflib.get_close_matches(given, valid, n=1, cutoff=0.0)
        hint = f"did you mean {nearest[0]!r}? " if nearest else ""
        super().__init__(f"unknown {kind} {given!r}: {hint}valid: {', '.join(valid)}")


class RenderingError(RuntimeError):
    """This machine cannot draw MuJoCo scenes."""
