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
exclude_patterns = ["_build"]
