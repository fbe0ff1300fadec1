"""The paper's figures, drawn from the table of finished runs: `python -m taic_jax.experiments.figures 7`."""
