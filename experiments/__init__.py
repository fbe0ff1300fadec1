"""Experiments: presets, one YAML file each, and the scripts that draw the paper's figures."""

if __name__ == "experiments":
    raise ImportError("this folder is the package taic_jax.experiments: write `import taic_jax.experiments`")
