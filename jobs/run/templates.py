"""Text from jinja2 templates, which lie in the folders of the modules that fill them."""

from pathlib import Path

import jinja2


def render(template: Path, **values: object) -> str:
    """Fill a template; a name in it that is not given raises.

    Args:
        template: File of Markdown with jinja2's marks.
        **values: What the template names.
    """
    environment = jinja2.Environment(  # noqa: S701 - Markdown, not HTML
        undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True
    )
    return environment.from_string(template.read_text()).render(values)
