"""RLlib's PPO, made to end with the same bytes whatever interrupts it."""

from pathlib import Path
from typing import Any

import pyarrow.fs
from ray import tune
from ray.rllib.algorithms.ppo import PPO as RLlibPPO
from ray.rllib.core import DEFAULT_MODULE_ID
from ray.rllib.utils.metrics import (
    ENV_RUNNER_RESULTS,
    ENV_RUNNER_SAMPLING_TIMER,
    LEARNER_RESULTS,
    LEARNER_UPDATE_TIMER,
    NUM_ENV_STEPS_SAMPLED_LIFETIME,
    SYNCH_WORKER_WEIGHTS_TIMER,
    TIMERS,
)

from jobs.run.checkpoints import drop_unfinished, unfinished
from jobs.run.files import RunError
from jobs.training.env_runner import Part
from jobs.training.rounds import Rounds
from jobs.training.snapshots import Snapshot, generators, read_snapshots, set_generators, write_snapshots

LEARNER = "learner"  # name of this process in a checkpoint
NOTICE = "notice"  # of a result: what the user has to know, one line
NEW_EPISODES = "Goes on with new episodes, so that its end will differ from that of an undisturbed training"


class Trainable(tune.Trainable):
    """Tune's, but it makes its checkpoints beside the finished ones, and a save that fails leaves nothing."""

    _storage: Any = None  # Tune's; without Tune there is none

    def checkpoints(self) -> Path | None:
        """The folder of the finished ones; None without Tune, or where an object store keeps them."""
        kept = self._storage and isinstance(self._storage.storage_filesystem, pyarrow.fs.LocalFileSystem)
        return Path(self._storage.trial_fs_path) if kept else None

    def save(self, checkpoint_dir: str | None = None) -> Any:
        """As Tune's, which copies what it finds in the folder to where it stays."""
        if checkpoint_dir or not self._storage:
            return super().save(checkpoint_dir)
        with unfinished(self.checkpoints()) as folder:
            return super().save(folder)


class PPO(Trainable, RLlibPPO):
    """RLlib's PPO; an error of its construction is raised by the first iteration instead.

    Ray ends an actor whose construction failed once everything it owns is released, and env runners
    never are: the launcher would wait forever. Its name is RLlib's, because Tune continues a training
    only under the name that it began with.
    """

    _refused: Exception | None = None
    _rounds: Any = None  # once it is built

    def setup(self, config: Any) -> None:
        """Build it."""
        try:
            drop_unfinished(self.checkpoints())
            super().setup(config)
            self._rounds = Rounds(self.env_runner_group)
        except Exception as error:
            self._refused = error

    def save_checkpoint(self, checkpoint_dir: str) -> None:
        """Write what the future of the training depends on."""
        super().save_checkpoint(checkpoint_dir)
        runners = {str(index): snapshot for index, snapshot in self._rounds.snapshots.items()}
        (answer,) = self.learner_group.foreach_learner(lambda learner: learner.kept())
        own = Snapshot({}, {**generators(), **answer.get()})
        write_snapshots(Path(checkpoint_dir), {LEARNER: own, **runners})

    def load_checkpoint(self, checkpoint: Any) -> None:
        """Go on from a checkpoint; what could not be built or read is said by the first iteration."""
        if self._refused is not None:
            return
        super().load_checkpoint(checkpoint)
        try:
            self._resume(read_snapshots(Path(checkpoint)))
        except RunError as error:
            self._refused = error

    def _resume(self, found: dict[str, Snapshot] | None) -> None:
        """Lead every process to where it stood.

        Raises:
            RunError: They are others.
        """
        if found is None:
            self._rounds.problems.append("the checkpoint is of an earlier version, and does not hold the old")
            return
        asked = {LEARNER, *map(str, self._rounds.snapshots)}
        if found.keys() != asked:
            raise RunError(f"a checkpoint must be of the processes {sorted(asked)}, got {sorted(found)}")
        self._rounds.snapshots = {index: found[str(index)] for index in self._rounds.snapshots}
        self._rounds.resume(list(self._rounds.snapshots))
        self.learner_group.foreach_learner(lambda learner: learner.keep(found[LEARNER].arrays))
        set_generators(found[LEARNER].arrays)

    def get_auto_filled_metrics(self, *told: Any, **named: Any) -> dict[str, object]:
        """As Tune's, without the configuration: to copy and send it took a tenth of an iteration."""
        return {**tune.Trainable.get_auto_filled_metrics(self, *told, **named), "config": {}}

    def restore_env_runners(self, env_runner_group: Any) -> list[int]:
        """Nothing: a round of sampling brings back whoever is missing."""
        return []

    def training_step(self) -> None:
        """As RLlib's, but of whole rounds of sampling; it never goes on without one of the env runners."""
        with self.metrics.log_time((TIMERS, ENV_RUNNER_SAMPLING_TIMER)):
            parts: list[Part] = []
            while (
                sum(len(episode) for part in parts for episode in part.episodes)
                < self.config.total_train_batch_size
            ):
                parts += self._rounds.take()
            self.metrics.aggregate([part.metrics for part in parts], key=ENV_RUNNER_RESULTS)
        sampled = self.metrics.peek((ENV_RUNNER_RESULTS, NUM_ENV_STEPS_SAMPLED_LIFETIME))
        with self.metrics.log_time((TIMERS, LEARNER_UPDATE_TIMER)):
            learned = self.learner_group.update(
                episodes=[episode for part in parts for episode in part.episodes],
                timesteps={NUM_ENV_STEPS_SAMPLED_LIFETIME: sampled},
                num_epochs=self.config.num_epochs,
                minibatch_size=self.config.minibatch_size,
            )
            self.metrics.aggregate(learned, key=LEARNER_RESULTS)
        with self.metrics.log_time((TIMERS, SYNCH_WORKER_WEIGHTS_TIMER)):
            self.env_runner_group.sync_weights(
                from_worker_or_learner_group=self.learner_group,
                policies=[DEFAULT_MODULE_ID],
                inference_only=True,
            )

    def step(self) -> Any:
        """One iteration."""
        if self._refused is not None:
            raise self._refused
        result = super().step()
        if self._rounds.problems:
            result[NOTICE] = f"{NEW_EPISODES}: {self._rounds.problems.pop()}"
            self._rounds.problems.clear()
        return result

    def cleanup(self) -> None:
        """Let go of what was built."""
        if self._rounds is not None:
            super().cleanup()
