"""Delete compiled kernels that are older than their sources."""

import contextlib
import hashlib
import json
import os
import pickle
import re
from collections.abc import Sequence
from pathlib import Path

INDEX = "kernels.json"  # in the `__pycache__` of a package
IMPORT = r"(?:from|import) +({}(?:\.\w+)*)(?: +import +(\([^)]*\)|[^\n]*))?"


def forget_stale_kernels(folder: Path, *used: Path) -> None:
    """Delete compiled kernels that are truncated, or whose sources have changed.

    The sources of a kernel are its file, the files of its package that this file imports, directly or not,
    and this package. numba checks the kernel's own file alone: after an edit of a kernel that it calls, or of
    an argument's type, numba would run the old machine code. numba also writes a kernel's index entry
    before the kernel: a full disk or a kill in between would leave the new entry with the old machine code.
    And numba raises an error if a file is empty or truncated.

    Args:
        folder: The package, such as `envs`. Its `__pycache__/kernels.json` holds the hashes of the sources.
        used: Other packages. An edit in any of them invalidates every kernel of `folder`.
    """
    index = folder / "__pycache__" / INDEX
    now = _digests(folder, (Path(__file__).parent, *used))
    # Another process may have deleted a file first, or the folder may be read-only: then leave it to numba.
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


def _digests(folder: Path, used: Sequence[Path]) -> dict[str, str]:
    """Return a hash for each file of a package: of the file, its imports from there, and all of `used`."""
    shared = b"".join(path.read_bytes() for room in used for path in sorted(room.rglob("*.py")))
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
        parts = shared + b"".join(hashes[source] for source in sorted(reached))
        digests[path.relative_to(folder).as_posix()] = hashlib.sha256(parts).hexdigest()
    return digests


def _imports(folder: Path, text: str) -> set[Path]:
    """Return the files that the import statements of a source text may refer to."""
    modules: set[str] = set()
    for module, names in re.findall(IMPORT.format(folder.name), text):
        modules.update((module, *(f"{module}.{name}" for name in re.findall(r"\w+", names))))
    places = {folder.parent.joinpath(*module.split(".")) for module in modules} - {folder}
    return {file for place in places for file in (place.with_suffix(".py"), place / "__init__.py")}


def _is_whole(compiled: Path) -> bool:
    """Whether a pickle file is complete; a missing file counts as complete."""
    with contextlib.suppress(FileNotFoundError), compiled.open("rb") as file:
        try:
            file.seek(-1, os.SEEK_END)
        except OSError:  # empty
            return False
        return file.read(1) == pickle.STOP
    return True
