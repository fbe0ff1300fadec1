"""Sphinx's settings. The sources are the pages of the repository, so that the same links hold in both places."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
import reference

import taic_jax

project, author, copyright = "taic_jax", "the taic_jax contributors", "2026, the taic_jax contributors"
version = release = taic_jax.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
root_doc = "docs/site/index"
include_patterns = ["docs/*.md", "docs/site/*.md", "README.md", "RESULTS.md", "CHANGELOG.md", "CONTRIBUTING.md"]
include_patterns += ["SECURITY.md", "experiments/README.md", "experiments/logbook.md", "experiments/results/options.md"]
myst_heading_anchors = 3
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # signatures with the shape of every array are wider than the page
html_theme, html_title = "furo", "taic_jax"


def setup(app) -> None:
    """Fill in what is made from the source: public names, fields of the config, commands; and read docstrings."""
    app.connect("source-read", reference.fill)
    app.connect("autodoc-process-docstring", reference.as_rst, priority=400)  # before napoleon
    app.connect("autodoc-process-signature", reference.without_defaults)
