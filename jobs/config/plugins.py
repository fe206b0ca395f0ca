"""Plug-ins: Python files outside this repository that add scenes, faults and kinds of policy.

A plug-in is a file, the folder of a package, or an installed module. Importing it adds rows to `LAYOUTS`,
`SHAPES`, `ADDED_FAULTS`, `VEHICLES`, `TASKS` and `KINDS`, in which every job looks up names. The key
`plugins` lists the plug-ins. Ray ships their code to each worker, which imports them before anything else
(docs/extend.md).
"""

import hashlib
import importlib
import importlib.metadata
import importlib.util
import os
import re
import sys
import traceback
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from core.places import resolve
from envs.config import ADDED_FAULTS, TASKS, VEHICLES
from envs.scene.layouts import LAYOUTS
from envs.scene.shapes import SHAPES
from jobs.config.errors import ConfigError
from models.kinds import KINDS, PolicySpec, TrialError

GROUP = "evade.plugins"  # group of entry points of installed packages
VARIABLE = "EVADE_PLUGINS"  # environment variable of a Ray worker: the names of its plug-ins
ROWS: dict[str, dict[str, Any]] = {
    **{"scene": LAYOUTS, "shape": SHAPES, "fault": ADDED_FAULTS, "kind of policy": KINDS},
    **{"vehicle": VEHICLES, "task": TASKS},
}

_loaded: dict[str, ModuleType] = {}


def load_plugins(names: object) -> None:
    """Import the plug-ins that a configuration names, each once, and check what they add.

    Args:
        names: Each the path of a file or of a package's folder, the name of an entry point of `GROUP`,
            or a module that Python finds.

    Raises:
        ConfigError: A plug-in cannot be imported, reuses a name, or adds something that cannot be used.
    """
    for name in names if isinstance(names, list) else ():  # another type is rejected later, with its key
        before, known = {what: dict(rows) for what, rows in ROWS.items()}, set(_loaded)
        try:
            _load(str(name), before)
        except Exception as error:
            said = one_line(error)
            for what, rows in ROWS.items():
                rows.clear()
                rows.update(before[what])
            for stem in _loaded.keys() - known:
                del _loaded[stem]
                sys.modules.pop(stem, None)
            raise ConfigError(f"plugins: {name}: {said}") from error


def _load(name: str, before: Mapping[str, Mapping[str, Any]]) -> None:
    """Import a plug-in, unless it is loaded already, and check the rows that are new since `before`."""
    path = Path(name).resolve() if name.endswith(".py") or os.sep in name else None
    stem = path.stem if path else _module_of(name)
    shipped = stem in os.environ.get(VARIABLE, "").split(",")  # workers import it from another place
    if stem in _loaded and (path is None or shipped or path in _files(_loaded[stem])):
        return
    if path is None:
        _import_module(stem)
    else:
        _import_file(stem, path)
    for what, rows in before.items():
        taken = [row for row, value in rows.items() if ROWS[what].get(row) is not value]
        if taken:
            raise ValueError(f"replaces the {what} {taken[0]!r}; give its own another name")
    for what, rows in ROWS.items():
        for row in rows.keys() - before[what].keys():
            try:
                _check(what, row, rows[row])
            except (ValueError, ImportError, AttributeError) as error:
                raise ValueError(f"its {what} {row!r}: {error}") from error


def _module_of(name: str) -> str:
    """Return the module of the installed entry point of this name, or else the name itself.

    Raises:
        ValueError: The entry points do not name exactly one module, or nothing has this name.
    """
    points = importlib.metadata.entry_points(group=GROUP)
    modules = {point.value for point in points if point.name == name} or {name}
    if len(modules) > 1 or ":" in "".join(modules):
        raise ValueError(f"entry points {GROUP} must name one module, got {', '.join(sorted(modules))}")
    if name not in points.names and importlib.util.find_spec(name.partition(".")[0]) is None:
        known = ", ".join(sorted(points.names)) or "none"
        raise ValueError(f"must be a path, a module or an entry point {GROUP} (installed: {known})")
    return modules.pop()


def _import_module(name: str) -> None:
    """Import a module that Python finds. Register it before it runs, so that errors name its line.

    Raises:
        ValueError: It has no file (a folder without __init__.py), so it cannot be shipped or hashed.
    """
    if spec := importlib.util.find_spec(name):
        _loaded[name] = importlib.util.module_from_spec(spec)
    module = _loaded[name] = importlib.import_module(name)
    top = sys.modules[name.partition(".")[0]]  # what is shipped to workers
    for one in (top, module):
        if getattr(one, "__file__", None) is None:
            rule = "must be a module or a package of Python files"
            raise ValueError(
                f"{rule}, got {one.__name__!r}, which has none; add an __init__.py to its folder"
            )


def _import_file(stem: str, path: Path) -> None:
    """Import a file or a package's folder under the name by which workers import it."""
    file = path / "__init__.py" if path.is_dir() else path
    if not file.is_file() or not stem.isidentifier():
        raise ValueError("must be a module, a .py file or the folder of a package")
    if stem in sys.modules or importlib.util.find_spec(stem) is not None:
        raise ValueError(f"its name {stem!r} is that of another module; rename it")
    inside = [str(path)] if path.is_dir() else None
    spec = importlib.util.spec_from_file_location(stem, file, submodule_search_locations=inside)
    assert spec is not None  # noqa: S101  for the type checker
    assert spec.loader is not None  # noqa: S101  as above
    module = _loaded[stem] = sys.modules[stem] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)


def _check(what: str, name: str, row: Any) -> None:
    """Raise ValueError for a row that jobs could not use."""
    if what == "scene":
        import numpy as np

        from envs.scene import make_scene  # loads numba, which takes long

        make_scene(name, np.random.default_rng(0))
    elif what == "fault" and not callable(row):
        raise ValueError(f"must be a function, got {row!r}")
    elif what in ("vehicle", "task"):
        resolve(row)
    elif what == "kind of policy":
        resolve(row.feature)
        resolve(row.network)


def kind_errors(spec: PolicySpec) -> Iterator[str]:
    """Yield what is wrong with the feature or the network of a plug-in's kind, tried on a few events.

    Args:
        spec: The policy; skipped if no plug-in added its kind, or if it has an encoder.
    """
    kind, name = KINDS[spec.model.name], spec.model.name
    owners = {part.partition(":")[0].partition(".")[0] for part in (kind.feature, kind.network)}
    culprits = owners & {module.partition(".")[0] for module in _loaded}
    if not culprits or spec.frozen or spec.finetuned:
        return
    from models.policy.trial import try_policy  # loads torch, which takes long

    try:
        try_policy(spec)
    except Exception as error:
        said = str(error) if isinstance(error, TrialError) else one_line(error)
        yield f"model.name: {name!r} of plug-in {', '.join(sorted(culprits))}: {said}"


def changed_plugins(digests: Mapping[str, str]) -> list[str]:
    """Return the names of the loaded plug-ins whose content differs from `digests` (name -> SHA-256)."""
    now = plugin_digests() if digests else {}
    return [name for name, digest in digests.items() if now.get(name, digest) != digest]


def with_plugins(runtime_env: Mapping[str, Any]) -> dict[str, Any]:
    """Return Ray's runtime environment with the plug-ins added, if there are any."""
    if not _loaded:
        return dict(runtime_env)
    tops = {sys.modules[name.partition(".")[0]] for name in _loaded}
    return {
        **runtime_env,
        "env_vars": {**runtime_env.get("env_vars", {}), VARIABLE: ",".join(_loaded)},
        "py_modules": sorted(str(_place(module)) for module in tops),
        "worker_process_setup_hook": f"{__name__}.load_in_worker",
    }


def load_in_worker() -> None:
    """Import the plug-ins of a Ray worker; `plugin_digests` reports those that cannot be imported."""
    for refusal in _load_shipped():
        sys.stderr.write(f"{refusal}\n")


def _load_shipped() -> Iterator[ConfigError]:
    """Import the plug-ins that a Ray worker has not imported yet; yield an error for each that fails."""
    for name in os.environ.get(VARIABLE, "").split(","):
        if name and name not in _loaded:
            try:
                _loaded[name] = importlib.import_module(name)
            except Exception as error:
                yield ConfigError(f"plugins: {name}: {one_line(error)}")


def plugin_digests() -> dict[str, str]:
    """Return name -> 12 digits of the SHA-256 of the content, for each plug-in.

    Raises:
        ConfigError: In a Ray worker, if one could not be imported.
    """
    for refusal in _load_shipped():
        raise refusal
    return {name: _digest(module) for name, module in sorted(_loaded.items())}


def one_line(error: BaseException) -> str:
    """Return type and text of an error, and the plug-in whose code raised it, if any."""
    said = " ".join(f"{type(error).__name__}: {error}".split())
    return with_culprit(said, "".join(traceback.format_exception(error)))


def with_culprit(said: str, trace: str) -> str:
    """Add to the text of an error the plug-in that its traceback passes through, here or in a worker."""
    for name, module in _loaded.items():
        place = _place(module)
        shipped = rf"[^\"]*/py_modules_files/[^\"/]+/{re.escape(place.name)}"
        lines = re.findall(rf'File "(?:{re.escape(str(place))}|{shipped})[^"]*", line (\d+)', trace)
        if lines and "(plug-in " not in said:
            return f"{said} (plug-in {name}, line {lines[-1]})"
    return said


def _place(module: ModuleType) -> Path:
    """Return the file of a module, or the folder of a package."""
    file = Path(str(module.__file__)).resolve()
    return file.parent if file.name == "__init__.py" else file


def _files(module: ModuleType) -> list[Path]:
    """Return the Python files of a module or a package; for a package also its folder."""
    place = _place(module)
    return [place, *sorted(place.rglob("*.py"))] if place.is_dir() else [place]


def _digest(module: ModuleType) -> str:
    place = _place(module)
    files = sorted(place.rglob("*")) if place.is_dir() else [place]
    return digest_of([file for file in files if "__pycache__" not in file.parts], place.parent)


def digest_of(files: Iterable[Path], root: Path) -> str:
    """Return 12 digits of the SHA-256 of files: of their paths relative to `root` and their content."""
    digest = hashlib.sha256()
    for file in files:
        if file.is_file():
            digest.update(f"{file.relative_to(root)}\0".encode() + file.read_bytes() + b"\0")
    return digest.hexdigest()[:12]
