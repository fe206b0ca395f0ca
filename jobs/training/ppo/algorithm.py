"""RLlib's PPO in rounds of sampling; interruptions do not change a byte of its result."""

from pathlib import Path
from typing import Any

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

from jobs.run.files import RunError
from jobs.training.sampling.rounds import Rounds
from jobs.training.sampling.snapshots import (
    Snapshot,
    generators,
    read_snapshots,
    set_generators,
    write_snapshots,
)
from jobs.training.trainable import Guarded

LEARNER = "learner"  # name of this process in a checkpoint
NOTICE = "notice"  # key of a result: one line for the user
NEW_EPISODES = "Continues with new episodes, so its result will differ from an uninterrupted training"


class PPO(Guarded, RLlibPPO):
    """RLlib's PPO, under RLlib's name, because Tune resumes a training only under its first name."""

    _rounds: Any = None

    def setup(self, config: Any) -> None:
        """Build the algorithm and its rounds of sampling."""
        super().setup(config)
        if self._refused is None:
            try:
                self._rounds = Rounds(self.env_runner_group)
            except Exception as error:
                self._refused = error

    def save_checkpoint(self, checkpoint_dir: str) -> None:
        """Write a checkpoint with all state on which the rest of the training depends."""
        super().save_checkpoint(checkpoint_dir)
        runners = {str(index): snapshot for index, snapshot in self._rounds.snapshots.items()}
        (answer,) = self.learner_group.foreach_learner(lambda learner: learner.own_state())
        own = Snapshot({}, {**generators(), **answer.get()})
        write_snapshots(Path(checkpoint_dir), {LEARNER: own, **runners})

    def load_checkpoint(self, checkpoint: Any) -> None:
        """Resume from a checkpoint; an error of building or reading is raised by the first iteration."""
        super().load_checkpoint(checkpoint)
        if self._refused is None:
            try:
                self._resume(read_snapshots(Path(checkpoint)))
            except RunError as error:
                self._refused = error

    def _resume(self, found: dict[str, Snapshot] | None) -> None:
        """Restore the state of every process when the checkpoint was written.

        Raises:
            RunError: The checkpoint is of other processes.
        """
        if found is None:
            self._rounds.problems.append("the checkpoint is of an earlier version, and does not hold the old")
            return
        asked = {LEARNER, *map(str, self._rounds.snapshots)}
        if found.keys() != asked:
            raise RunError(f"a checkpoint must be of the processes {sorted(asked)}, got {sorted(found)}")
        self._rounds.snapshots = {index: found[str(index)] for index in self._rounds.snapshots}
        self._rounds.resume(list(self._rounds.snapshots))
        self.learner_group.foreach_learner(lambda learner: learner.set_own_state(found[LEARNER].arrays))
        set_generators(found[LEARNER].arrays)

    def restore_env_runners(self, env_runner_group: Any) -> list[int]:
        """Do nothing: a round of sampling restarts the missing env runners."""
        return []

    def training_step(self) -> None:
        """Sample whole rounds with every env runner, update the weights, and send them to the env runners."""
        with self.metrics.log_time((TIMERS, ENV_RUNNER_SAMPLING_TIMER)):
            episodes, metrics = list[Any](), list[Any]()
            while sum(map(len, episodes)) < self.config.total_train_batch_size:
                for part in self._rounds.take():
                    episodes += part.episodes
                    metrics.append(part.metrics)
            self.metrics.aggregate(metrics, key=ENV_RUNNER_RESULTS)
        sampled = self.metrics.peek((ENV_RUNNER_RESULTS, NUM_ENV_STEPS_SAMPLED_LIFETIME))
        with self.metrics.log_time((TIMERS, LEARNER_UPDATE_TIMER)):
            learned = self.learner_group.update(
                episodes=episodes,
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
        """Run one iteration; if episodes had to be restarted, report why."""
        result = super().step()
        if self._rounds.problems:
            result[NOTICE] = f"{NEW_EPISODES}: {self._rounds.problems.pop()}"
            self._rounds.problems.clear()
        return result
