"""Strict modes for every test: no silent promotion of dtypes or ranks."""

import hypothesis
import jax

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# The first example of a property compiles, the others do not: a deadline would only measure that.
hypothesis.settings.register_profile("taic_jax", deadline=None, max_examples=25)
hypothesis.settings.load_profile("taic_jax")
