"""The runs that the figures need, and a table of them: `python -m taic_jax.experiments.evidence --list`."""
