"""Environments of your own, as `docs/environments.md` makes them; each runs by the YAML file beside it."""
