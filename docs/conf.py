"""Configure Sphinx: pages, keys of the configuration from the schema, and the API from docstrings."""

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
html_extra_path = ["replay.html", "films"]  # written by commands, like the figures
exclude_patterns = ["_build", "_templates"]


def _skip_fields(_app, _what, _name, member, skip, _options):
    """Whether to leave out a member: a validator, or a field of a NamedTuple, which its docstring covers."""
    return (
        skip
        or isinstance(member, classmethod)
        or (getattr(member, "__doc__", None) or "").startswith("Alias for field number")
    )


def _escape(_app, _what, _name, _obj, _options, lines):
    """Escape bars and stars of formulas, because docstrings have no reST markup except backquotes.

    An entry for several attributes gets a single name, because napoleon cannot read several.
    """
    several = re.compile(r"^( {4}\w+)((?:, \w+)+): ")
    lines[:] = [several.sub(lambda found: f"{found[1]}: (also{found[2][1:]}) ", line) for line in lines]
    lines[:] = [line if "`" in line else line.replace("|", r"\|").replace("*", r"\*") for line in lines]


def _drop_types(_app, _what, _name, obj, _options, _signature, _returned):
    """Remove the signature of settings, whose allowed values `_say_types` describes in words."""
    return ("", None) if _is_settings(obj) else None


def _say_types(_app, _what, _name, obj, _options, lines):
    """Append the allowed values of each field of a settings class, in words."""
    if _is_settings(obj):
        hints = typing.get_type_hints(obj, include_extras=True)
        lines += ["", "Allowed values:", ""]
        lines += [f"* ``{field.name}``: {allowed(hints[field.name])}".replace("`", "``").replace("````", "``")
                  for field in dataclasses.fields(obj)]  # fmt: skip


def _is_settings(obj):
    return dataclasses.is_dataclass(obj) and hasattr(obj, "__pydantic_config__")


def _fill_in(app, docname, source):
    """Add the contents to their pages; let the table of modules link to the site's own pages."""
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
    """Return the pages with contents, which depend on the other pages that exist."""
    return ["index", *BELOW]


def setup(app):
    """Connect the functions above to Sphinx, which calls this."""
    app.connect("autodoc-skip-member", _skip_fields)
    app.connect("autodoc-process-signature", _drop_types)
    app.connect("autodoc-process-docstring", _escape, priority=400)  # before napoleon
    app.connect("autodoc-process-docstring", _say_types)
    app.connect("source-read", _fill_in)
    app.connect("env-get-outdated", _read_again)
