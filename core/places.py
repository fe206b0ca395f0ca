"""Objects by the place where they stand: "module:attribute", as tables of plug-ins hold them."""

import importlib
from typing import Any


def resolve(reference: str) -> Any:
    """Return the object of a "module:attribute"; the module is imported only now."""
    module, _, name = reference.partition(":")
    return getattr(importlib.import_module(module), name)
