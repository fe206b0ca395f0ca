"""Compiled kernels that are older than their sources."""

import contextlib
import hashlib
import json
import os
import pickle
import re
from pathlib import Path

INDEX = "kernels.json"  # in the `__pycache__` of a package
IMPORT = r"(?:from|import) +({}(?:\.\w+)*)(?: +import +(\([^)]*\)|[^\n]*))?"


def forget_stale_kernels(folder: Path) -> None:
    """Delete compiled kernels that are cut, or whose file or what it imports from its package has changed.

    numba checks the file of a kernel alone, not the files of the kernels that it calls, nor of the types
    of its arguments, which its annotations import: after an edit there, it would go on running the old
    machine code. It writes the name of a kernel before the kernel: a full disk or a kill in between would
    leave the new name with the old machine code. And it raises where a file is empty or ends too early.

    Args:
        folder: The package, such as `envs`. Its `__pycache__/kernels.json` holds the hashes of the sources.
    """
    index = folder / "__pycache__" / INDEX
    now = _digests(folder)
    # Another process may be faster, or the folder not ours: numba then decides.
    with contextlib.suppress(OSError):
        try:
            before = json.loads(index.read_bytes())
        except (OSError, ValueError):
            before = {}
        for compiled in folder.rglob("__pycache__/*.nb[ci]"):
            source = compiled.parent.parent / f"{compiled.name.partition('.')[0]}.py"
            name = source.relative_to(folder).as_posix()
            if name not in now or now[name] != before.get(name) or not _is_whole(compiled):
                compiled.unlink(missing_ok=True)
        if now != before:  # only after the deletions: a kill in between repeats them
            part = index.with_name(f"{index.name}.{os.getpid()}")
            part.parent.mkdir(exist_ok=True)
            part.write_text(json.dumps(now))
            part.replace(index)


def _digests(folder: Path) -> dict[str, str]:
    """For each file of a package a hash of it and of what it imports from there, directly or not."""
    sources = {path: path.read_bytes() for path in folder.rglob("*.py")}
    imports = {path: _imports(folder, text.decode()) & sources.keys() for path, text in sources.items()}
    hashes = {path: hashlib.sha256(text).digest() for path, text in sources.items()}
    digests = {}
    for path in sources:
        reached, ahead = {path}, [path]
        while ahead:
            new = imports[ahead.pop()] - reached
            reached |= new
            ahead += new
        parts = b"".join(hashes[source] for source in sorted(reached))
        digests[path.relative_to(folder).as_posix()] = hashlib.sha256(parts).hexdigest()
    return digests


def _imports(folder: Path, text: str) -> set[Path]:
    """Files that the import statements of a text may mean, wherever they stand."""
    modules: set[str] = set()
    for module, names in re.findall(IMPORT.format(folder.name), text):
        modules.update((module, *(f"{module}.{name}" for name in re.findall(r"\w+", names))))
    places = {folder.parent.joinpath(*module.split(".")) for module in modules} - {folder}
    return {file for place in places for file in (place.with_suffix(".py"), place / "__init__.py")}


def _is_whole(compiled: Path) -> bool:
    """Whether a file, which is a pickle, has its end; a file that is gone counts as whole."""
    with contextlib.suppress(FileNotFoundError), compiled.open("rb") as file:
        try:
            file.seek(-1, os.SEEK_END)
        except OSError:  # empty
            return False
        return file.read(1) == pickle.STOP
    return True
