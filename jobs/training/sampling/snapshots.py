"""The state of a training besides its weights and its optimiser, as plain values and arrays.

It consists of each process's random generators and, for each env runner, the running episodes, the metrics
of ended ones, and the newest windows that its encoder has read. A checkpoint has it as JSON and as arrays.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from jobs.run.files import RunError, read_json, write_json

FOLDER = "snapshots"  # in a checkpoint
LAYOUT = 1  # version of a snapshot's layout; other versions are rejected
ABOUT = "layout.json"


@dataclass(frozen=True)
class Snapshot:
    """The state of a process.

    Attributes:
        values: Values that JSON can represent.
        arrays: The rest, restored byte for byte.
    """

    values: dict[str, Any]
    arrays: dict[str, np.ndarray]


def generators() -> dict[str, np.ndarray]:
    """Return the states of torch's and numpy's generators of this process."""
    _, words, *rest = np.random.get_state()  # noqa: NPY002  the one that RLlib seeds
    return {
        "torch_generator": torch.get_rng_state().numpy(),
        "numpy_generator": words,
        "numpy_position": np.array(rest, np.float64),  # and the cached normal number
    }


def set_generators(arrays: dict[str, np.ndarray]) -> None:
    """Restore the states of `generators`."""
    torch.set_rng_state(torch.from_numpy(arrays["torch_generator"]))
    position, kept, normal = arrays["numpy_position"].tolist()
    np.random.set_state(("MT19937", arrays["numpy_generator"], int(position), int(kept), normal))  # noqa: NPY002


def write_snapshots(checkpoint: Path, snapshots: dict[str, Snapshot]) -> None:
    """Add the snapshots of named processes to a checkpoint."""
    folder = checkpoint / FOLDER
    folder.mkdir()
    for name, snapshot in snapshots.items():
        # NaN is not valid JSON, but Python reads and writes it.
        (folder / f"{name}.json").write_text(json.dumps(snapshot.values))
        # Compression would take a second for 20 MB and save 8 %, and all processes would wait.
        np.savez(folder / f"{name}.npz", **snapshot.arrays)  # type: ignore[arg-type]
    write_json(folder / ABOUT, {"layout": LAYOUT, "processes": list(snapshots)})


def read_snapshots(checkpoint: Path) -> dict[str, Snapshot] | None:
    """Return the snapshots of a checkpoint; None if it has none, because it is of an earlier version.

    Raises:
        RunError: The snapshots have another layout.
    """
    folder = checkpoint / FOLDER
    if not folder.is_dir():
        return None
    about = read_json(folder / ABOUT)
    if about.get("layout") != LAYOUT:
        remedy = "continue with the version that wrote it, or delete the run's train/ to train again"
        raise RunError(f"{folder}: layout must be {LAYOUT}, got {about.get('layout')!r}; {remedy}")
    return {name: _read(folder / name) for name in about["processes"]}


def _read(path: Path) -> Snapshot:
    """Return one snapshot; `path` is the path of its two files without suffix."""
    with np.load(path.with_suffix(".npz"), allow_pickle=False) as arrays:
        return Snapshot(json.loads(path.with_suffix(".json").read_text()), dict(arrays))
