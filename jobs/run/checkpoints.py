"""Seal the checkpoints of a training when they are written, and check them before use.

A power failure, a full disk or an interrupted copy leaves files that look intact. A checkpoint that has
changed since it was written is replaced by the newest intact one.
"""

import contextlib
import hashlib
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from jobs.run.files import RunError, read_json, write_json

SEAL = "sha256.json"
UNSEALED = "not sealed"
UNFINISHED = ".checkpoint-"  # prefix of folders of incomplete checkpoints; `mend` ignores them


@contextlib.contextmanager
def unfinished(place: Path | None) -> Iterator[str]:
    """Yield a folder for a new checkpoint, next to the finished ones; remove it when the block ends.

    The system's temporary folder may be in memory or have less space, so it is avoided.

    Args:
        place: Folder of the finished checkpoints, created if missing; None if it is not on this machine: the
            system's temporary folder is used.
    """
    if place is not None:
        place.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=UNFINISHED, dir=place, ignore_cleanup_errors=True) as folder:
        yield folder


def drop_unfinished(place: Path | None) -> None:
    """Remove the unfinished checkpoints that a killed process left in a folder."""
    for left in place.glob(f"{UNFINISHED}*") if place is not None else ():
        shutil.rmtree(left, ignore_errors=True)


def seal(checkpoint: Path) -> None:
    """Write the SHA-256 of each file of a checkpoint into its folder."""
    write_json(checkpoint / SEAL, _digests(checkpoint))


def damage(checkpoint: Path) -> str | None:
    """Return in a few words what is wrong with a checkpoint; None if it is intact.

    A checkpoint has no seal if the process was killed before writing it. Such a checkpoint may be intact.
    """
    if not checkpoint.is_dir():
        return "missing"
    if not (checkpoint / SEAL).is_file():
        return UNSEALED if any(checkpoint.iterdir()) else "empty"
    try:
        sealed = read_json(checkpoint / SEAL)
    except RunError:
        return f"{SEAL} changed"
    found = _digests(checkpoint)
    differ = sorted(name for name in sealed.keys() | found.keys() if sealed.get(name) != found.get(name))
    return None if not differ else f"{', '.join(differ)} changed"


def mend(checkpoint: Path) -> str | None:
    """Replace a damaged checkpoint by the newest intact one; return a message, None if nothing was done.

    A checkpoint without a seal, which may be intact, is used only if no sealed one is intact.

    Args:
        checkpoint: The checkpoint from which a training would continue, `checkpoint_<number>`.

    Raises:
        RunError: No checkpoint is intact.
    """
    reason = damage(checkpoint)
    if reason is None:
        return None
    others = sorted(
        (path for path in checkpoint.parent.glob("checkpoint_*") if path != checkpoint), reverse=True
    )
    wrong = {path: damage(path) for path in others}
    good = next((path for wanted in (None, UNSEALED) for path in others if wrong[path] == wanted), None)
    if reason == UNSEALED and (good is None or wrong[good] == UNSEALED):
        return None
    if good is None:
        experiment = checkpoint.parent.parent
        remedy = f"delete {experiment}, and the same command trains again from the start"
        raise RunError(f"{checkpoint}: damaged ({reason}), and no other is whole; {remedy}")
    shutil.rmtree(checkpoint, ignore_errors=True)
    part = checkpoint.with_name(f".{checkpoint.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    shutil.copytree(good, part)
    part.rename(checkpoint)
    return f"Checkpoint damaged ({reason}), {good.name} takes its place: {checkpoint}"


def sha256(file: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal digits."""
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _digests(checkpoint: Path) -> dict[str, str]:
    """Return file name -> SHA-256 for every file except the seal."""
    files = (path for path in sorted(checkpoint.rglob("*")) if path.is_file())
    return {str(path.relative_to(checkpoint)): sha256(path) for path in files if path != checkpoint / SEAL}
