"""Wrappers of RLlib's algorithms for Tune: complete checkpoints, and errors that reach the user."""

from pathlib import Path
from typing import Any

import pyarrow.fs
from ray import tune

from jobs.run.checkpoints import drop_unfinished, unfinished


class Trainable(tune.Trainable):
    """A Trainable that writes a checkpoint next to the finished ones; a failed save leaves nothing behind."""

    _storage: Any = None  # Tune's; None without Tune

    def checkpoints(self) -> Path | None:
        """Return the folder of the finished checkpoints; None without Tune or with an object store."""
        local = self._storage and isinstance(self._storage.storage_filesystem, pyarrow.fs.LocalFileSystem)
        return Path(self._storage.trial_fs_path) if local else None

    def save(self, checkpoint_dir: str | None = None) -> Any:
        """Write a checkpoint into a folder, from which Tune copies it to its place."""
        if checkpoint_dir or not self._storage:
            return super().save(checkpoint_dir)
        with unfinished(self.checkpoints()) as folder:
            return super().save(folder)


class Guarded(Trainable):
    """Mix-in of an RLlib algorithm: the first iteration raises an error of its construction.

    Ray ends an actor whose construction failed only once everything it owns is released. Env runners
    are never released, so the launcher would wait forever.
    """

    _refused: Exception | None = None
    _built = False

    def setup(self, config: Any) -> None:
        """Build the algorithm; store an error for the first iteration."""
        try:
            drop_unfinished(self.checkpoints())
            super().setup(config)
            self._built = True
        except Exception as error:
            self._refused = error

    def restore_from_path(self, *path: Any, **named: Any) -> None:
        """Load a checkpoint, as `Algorithm.from_checkpoint` does.

        Raises:
            Exception: The error of the construction, if there was one.
        """
        if self._refused is not None:
            raise self._refused
        super().restore_from_path(*path, **named)

    def load_checkpoint(self, checkpoint: Any) -> None:
        """Resume from a checkpoint, unless the construction failed."""
        if self._refused is None:
            super().load_checkpoint(checkpoint)

    def get_auto_filled_metrics(self, *told: Any, **named: Any) -> dict[str, object]:
        """Return Tune's metrics without the configuration: to copy it takes a tenth of an iteration."""
        return {**tune.Trainable.get_auto_filled_metrics(self, *told, **named), "config": {}}

    def step(self) -> Any:
        """Run one iteration.

        Raises:
            Exception: The error of the construction, if there was one.
        """
        if self._refused is not None:
            raise self._refused
        return super().step()

    def cleanup(self) -> None:
        """Release the algorithm, if it was built."""
        if self._built:
            super().cleanup()


def guarded(algorithm: type) -> type:
    """Return an RLlib algorithm with `Guarded`, under its own name, by which Tune resumes a training."""
    return type(algorithm.__name__, (Guarded, algorithm), {})
