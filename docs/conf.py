"""Sphinx: the pages, the keys of the configuration from the schema, and the API from the docstrings."""

import dataclasses
import re
import sys
import typing
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from docs.contents import BELOW, CONTENTS, toctree  # noqa: E402
from docs.keys import allowed  # noqa: E402

project = "Evade"
copyright = "The Evade authors"
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.napoleon"]
myst_enable_extensions = ["attrs_block", "colon_fence"]
myst_heading_anchors = 3  # links to #headings, as on GitHub
nb_execution_mode = "off"  # python -m docs.run_notebooks writes their outputs, a test runs them
highlight_language = "text"
html_theme = "furo"
html_title = "Evade"
html_static_path = ["_static"]
html_css_files = ["evade.css"]
templates_path = ["_templates"]
autosummary_generate = True
autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_mock_imports = ["ray", "mlflow"]
autodoc_typehints_format = "short"
maximum_signature_line_length = 80
napoleon_use_ivar = True
html_extra_path = ["replay.html", "films"]  # written by commands, as the figures are
exclude_patterns = ["_build", "_templates"]


def _skip_fields(_app, _what, _name, member, skip, _options):
    """Whether to leave a member out: fields of a NamedTuple, which its docstring describes; validators."""
    return (
        skip
        or isinstance(member, classmethod)
        or (getattr(member, "__doc__", None) or "").startswith("Alias for field number")
    )


def _escape(_app, _what, _name, _obj, _options, lines):
    """Bars and stars of formulas as they are: docstrings have no reST markup but backquotes.

    An entry for several attributes becomes one with a single name, which napoleon can read.
    """
    several = re.compile(r"^( {4}\w+)((?:, \w+)+): ")
    lines[:] = [several.sub(lambda found: f"{found[1]}: (also{found[2][1:]}) ", line) for line in lines]
    lines[:] = [line if "`" in line else line.replace("|", r"\|").replace("*", r"\*") for line in lines]


def _drop_types(_app, _what, _name, obj, _options, _signature, _returned):
    """No signature for settings: what each field may be is said in words."""
    return ("", None) if _is_settings(obj) else None


def _say_types(_app, _what, _name, obj, _options, lines):
    """What each field of a class of settings may be, in words."""
    if _is_settings(obj):
        hints = typing.get_type_hints(obj, include_extras=True)
        lines += ["", "Allowed values:", ""]
        lines += [f"* ``{field.name}``: {allowed(hints[field.name])}".replace("`", "``").replace("````", "``")
                  for field in dataclasses.fields(obj)]  # fmt: skip


def _is_settings(obj):
    return dataclasses.is_dataclass(obj) and hasattr(obj, "__pydantic_config__")


def _fill_in(app, docname, source):
    """Add the contents to the pages that head them; lead the table of modules to the site's own pages."""
    there = app.env.found_docs
    if docname == "index":
        trees = [
            toctree(tuple(page for page in own if page in there), name) for name, own in CONTENTS.items()
        ]
        source[0] += "\n" + "\n".join(trees)
    elif docname in BELOW:
        source[0] += "\n\n" + toctree(tuple(page for page in BELOW[docname] if page in there))
    if docname == "api":
        source[0] = re.sub(r"\[`([\w.]+)`\]\(\.\./[^)]+\)", r"[`\1`](api/\1.rst)", source[0])


def _read_again(*_):
    """The contents, which depend on what other pages there are."""
    return ["index", *BELOW]


def setup(app):
    """Called by Sphinx."""
    app.connect("autodoc-skip-member", _skip_fields)
    app.connect("autodoc-process-signature", _drop_types)
    app.connect("autodoc-process-docstring", _escape, priority=400)  # before napoleon
    app.connect("autodoc-process-docstring", _say_types)
    app.connect("source-read", _fill_in)
    app.connect("env-get-outdated", _read_again)
