"""Rounds of sampling in which every env runner takes part exactly once, even if its process is lost.

RLlib continues without a lost env runner, and the replacement starts new episodes. Here the replacement is
restored to the lost env runner's state at the start of the round and samples what the lost one would have
sampled. The training then has the same bytes as one without losses.
"""

from collections.abc import Callable, Sequence
from typing import Any

import ray
from ray.exceptions import ActorDiedError
from ray.rllib.env.env_runner_group import EnvRunnerGroup

from jobs.run.ray_cluster import logs_folder
from jobs.run.trial_errors import low_memory
from jobs.training.sampling.env_runner import MAX_SAMPLE_S, Part, RolloutError
from jobs.training.sampling.rllib_internals import GROUP, require
from jobs.training.sampling.snapshots import Snapshot

MAX_RESTARTS = 3  # of a failing env runner; RLlib's 1000 would hide a broken environment for hours
MAX_PAUSE_S = 600.0  # until an env runner has started again: a busy machine takes minutes
SAMPLE_TIMEOUT_S = MAX_SAMPLE_S + 60.0  # a process that hangs ends itself earlier
LOCAL = 0  # index of the env runner in this process


class Rounds:
    """Samples rounds with the env runners of a training, or with the local one if there are no others.

    Attributes:
        snapshots: State of each env runner after the last round, or before the first round.
        problems: Reasons why episodes had to be restarted, in a few words each.
    """

    def __init__(self, group: EnvRunnerGroup) -> None:
        """Store the initial state of the env runners.

        Raises:
            RolloutError: An env runner has died for good, or does not answer.
        """
        require(group, GROUP)
        self.problems: list[str] = []
        self._group, self._manager = group, group._worker_manager
        self._indices = sorted(self._manager.actor_ids())
        if self._indices:
            begin = self._until_answered(lambda runner: (runner.snapshot(),), self._indices)
            self.snapshots: dict[int, Snapshot] = {index: begin[index][0] for index in self._indices}
        else:
            self.snapshots = {LOCAL: group.local_env_runner.snapshot()}

    def take(self) -> list[Part]:
        """Sample one round with every env runner; return their parts by index.

        Raises:
            RolloutError: An env runner raised an error, has died for good, or does not come back.
        """
        parts: dict[int, Part] = {}
        while due := [index for index in self.snapshots if index not in parts]:
            parts |= {part.runner: part for part in self._sampled(due) if self._fits(part)}
            self.resume([index for index in due if index not in parts])
        self.snapshots = {index: parts[index].after for index in self.snapshots}
        return [parts[index] for index in self.snapshots]

    def resume(self, indices: Sequence[int]) -> None:
        """Restore the state of env runners after the last round, with the newest weights.

        Raises:
            RolloutError: An env runner has died for good, or does not come back.
        """
        if not indices:
            return
        local = self._group.local_env_runner
        if not self._indices:
            said = [local.resume(self.snapshots[LOCAL])]
        else:
            weights = ray.put(local.get_state())
            places = {index: ray.put(self.snapshots[index]) for index in indices}

            def lead(runner: Any) -> tuple[str]:
                runner.set_state(ray.get(weights))
                return (runner.resume(ray.get(places[runner.worker_index])),)

            said = [answer[0] for answer in self._until_answered(lead, indices).values()]
        self.problems += filter(None, said)

    def _sampled(self, due: list[int]) -> list[Part]:
        """Return the parts of the env runners that answered."""
        if not self._indices:
            return [self._group.local_env_runner.take_part()]
        results = self._manager.foreach_actor(
            lambda runner: runner.take_part(), remote_actor_ids=due, timeout_seconds=SAMPLE_TIMEOUT_S
        )
        self._check_alive(results)
        return [Part(*result.get()) for result in results if result.ok]

    def _fits(self, part: Part) -> bool:
        """Whether an env runner sampled from its snapshot with the newest weights; if not, it must repeat.

        Ray may have restarted its process unnoticed, and RLlib omits a message with weights while the
        previous one is on its way.
        """
        rounds, weights = part.began
        same = rounds == self.snapshots[part.runner].values["metrics"]["rounds"]
        if not same:
            self._manager.set_actor_state(part.runner, healthy=False)  # counts as a restart when it answers
        return same and weights == self._group.local_env_runner._weights_seq_no

    def _until_answered(
        self, ask: Callable[[Any], tuple[Any, ...]], indices: Sequence[int]
    ) -> dict[int, Any]:
        """Return the answers of env runners by index; wait for env runners that are being restarted."""
        answers: dict[int, Any] = {}
        while missing := [index for index in indices if index not in answers]:
            results = self._manager.foreach_actor(
                ask,
                remote_actor_ids=missing,
                healthy_only=False,
                mark_healthy=True,
                timeout_seconds=MAX_PAUSE_S,
            )
            self._check_alive(results)
            silent = set(missing) - {result.actor_id for result in results}
            if silent:
                silence = f"has not started again for {MAX_PAUSE_S:.0f} s"
                raise RolloutError(f"env runner {min(silent)} {silence}; see {logs_folder()}")
            answers |= {result.actor_id: result.get() for result in results if result.ok}
        return answers

    @staticmethod
    def _check_alive(results: Any) -> None:
        """Raise RolloutError if an env runner will not be restarted."""
        for result in results:
            if not result.ok and isinstance(result.get(), ActorDiedError):
                ended = low_memory(str(result.get()))
                ended = f"was ended {ended}" if ended else f"has died {MAX_RESTARTS + 1} times"
                raise RolloutError(f"env runner {result.actor_id} {ended}; see {logs_folder()}")
