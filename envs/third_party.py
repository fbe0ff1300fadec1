"""The setting of calls into MJX and Brax: loose promotion, and no idle notes."""

import contextlib
import io
import warnings
from collections.abc import Iterator

import jax

_NOTES = (
    "Brax System, piplines and environments are not actively being maintained",
    "JAXopt is no longer maintained",
    "Accessing `[a-z]*` directly from `Data` is deprecated",  # Brax's own use of MJX
)


@contextlib.contextmanager
def third_party() -> Iterator[None]:
    """Import or call MJX or Brax: promote dtypes and ranks as JAX does by default, and hide idle notes.

    Standard output is discarded: MJX prints at its import that the optional Warp is not installed, and Warp a greeting.
    """
    with (
        jax.numpy_dtype_promotion("standard"),
        jax.numpy_rank_promotion("allow"),
        contextlib.redirect_stdout(io.StringIO()),
        warnings.catch_warnings(),
    ):
        for note in _NOTES:
            warnings.filterwarnings("ignore", note)
        yield
