"""RLlib's algorithms as Tune runs them here: whole checkpoints, and errors that reach the user."""

from pathlib import Path
from typing import Any

import pyarrow.fs
from ray import tune

from jobs.run.checkpoints import drop_unfinished, unfinished


class Trainable(tune.Trainable):
    """Tune's Trainable, which writes a checkpoint next to the finished ones; a failed save leaves nothing."""

    _storage: Any = None  # Tune's; None without Tune

    def checkpoints(self) -> Path | None:
        """Return the folder of the finished checkpoints; None without Tune or with an object store."""
        local = self._storage and isinstance(self._storage.storage_filesystem, pyarrow.fs.LocalFileSystem)
        return Path(self._storage.trial_fs_path) if local else None

    def save(self, checkpoint_dir: str | None = None) -> Any:
        """Write a checkpoint; Tune copies what it finds in the folder to its place."""
        if checkpoint_dir or not self._storage:
            return super().save(checkpoint_dir)
        with unfinished(self.checkpoints()) as folder:
            return super().save(folder)


class Guarded(Trainable):
    """Mixed into an algorithm of RLlib's: an error of its construction is raised by the first iteration.

    Ray ends an actor whose construction failed once everything it owns is released, and env runners
    never are: the launcher would wait forever.
    """

    _refused: Exception | None = None
    _built = False

    def setup(self, config: Any) -> None:
        """Build the algorithm."""
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
        """Return Tune's metrics without the configuration, whose copy took a tenth of an iteration."""
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
        """Release what was built."""
        if self._built:
            super().cleanup()


def guarded(algorithm: type) -> type:
    """Return an algorithm of RLlib's under its own name, by which Tune finds a training again."""
    return type(algorithm.__name__, (Guarded, algorithm), {})
