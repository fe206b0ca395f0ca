"""Look up objects by references "module:attribute", as used in the tables of plug-ins."""

import importlib
from typing import Any


def resolve(reference: str) -> Any:
    """Import the module of a reference "module:attribute" and return the attribute."""
    module, _, name = reference.partition(":")
    return getattr(importlib.import_module(module), name)
