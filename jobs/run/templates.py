"""Fill jinja2 templates, which are in the folders of the modules that use them."""

from pathlib import Path

import jinja2


def render(template: Path, **values: object) -> str:
    """Fill a template; raise jinja2.UndefinedError if it uses a name without a value.

    Args:
        template: Markdown file with jinja2 markup.
        **values: Values of the names in the template.
    """
    environment = jinja2.Environment(  # noqa: S701 - Markdown, not HTML
        undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True
    )
    return environment.from_string(template.read_text()).render(values)
