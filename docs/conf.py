"""Sphinx: the guide, and the API from the docstrings."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

project = "Evade"
copyright = "The Evade authors"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_heading_anchors = 3  # links to #headings, as on GitHub
html_theme = "furo"
html_title = "Evade"
autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_mock_imports = ["ray", "mlflow"]
html_extra_path = ["replay.html"]  # written by commands, as the figures are
exclude_patterns = ["_build"]


def _skip_fields(_app, _what, _name, member, skip, _options):
    """Whether to leave a member out: fields of a NamedTuple are described by its docstring."""
    return skip or (getattr(member, "__doc__", None) or "").startswith("Alias for field number")


def setup(app):
    """Called by Sphinx."""
    app.connect("autodoc-skip-member", _skip_fields)
