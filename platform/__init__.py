"""Stand-in for the standard library's `platform`, whose docstring replaces this one at import.

The repository's entry point is `python -m platform.launch`, so this folder hides the
standard library's module from every program run in the repository root. It therefore
runs that module's own code in this namespace: the same names, classes and docstring,
with only `__path__` added, so that pickles, reloads and `isinstance` keep working.
"""


def _become_the_standard_library_module():
    """Execute the first plain module (not a package, like this one) of this name on `sys.path`."""
    import sys
    from importlib.machinery import PathFinder

    for entry in sys.path:
        spec = PathFinder.find_spec(__name__, [entry])
        if spec and spec.submodule_search_locations is None:
            namespace = globals()
            del namespace["_become_the_standard_library_module"]
            namespace.update(__file__=spec.origin, __cached__=spec.cached)
            exec(spec.loader.get_code(__name__), namespace)  # noqa: S102  the standard library's own text
            return
    raise ImportError(f"The standard library's module {__name__!r} is not on sys.path: {sys.path}")


_become_the_standard_library_module()
