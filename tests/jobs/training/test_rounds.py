import copy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from ray.exceptions import ActorDiedError, ActorUnavailableError

from jobs.training.algorithms import build_algorithm
from jobs.training.sampling import rounds
from jobs.training.sampling.env_runner import PlainEnvRunner, RolloutError
from jobs.training.sampling.rounds import Rounds
from jobs.training.sampling.snapshots import generators, set_generators
from tests.support.configs import SHORT, make_config

pytestmark = pytest.mark.system  # they build RLlib's algorithm many times

RUNNERS = (1, 2)
SILENT = "silent"


class Process:
    """An env runner with random numbers of its own, as if it were alone in a process."""

    def __init__(self, ppo, index):
        self.runner = PlainEnvRunner(config=ppo, worker_index=index)
        self.generators = generators()

    def call(self, function):
        set_generators(self.generators)
        answer = copy.deepcopy(function(self.runner))
        self.generators = generators()
        return answer


class Result:
    def __init__(self, actor_id, value):
        self.actor_id, self.value, self.ok = actor_id, value, not isinstance(value, Exception)

    def get(self):
        return self.value


class Manager:
    """RLlib's, of processes that a test disturbs.

    Attributes:
        faults: Of each env runner what becomes of its next calls: an error, silence, or None.
        restarts: As RLlib counts them.
    """

    def __init__(self, ppo):
        self.ppo, self.restarts, self.faults = ppo, 0, {index: [] for index in RUNNERS}
        self.processes = {index: Process(ppo, index) for index in RUNNERS}
        self.healthy = dict.fromkeys(RUNNERS, True)

    def actor_ids(self):
        return list(RUNNERS)

    def set_actor_state(self, index, healthy):
        self.healthy[index] = healthy

    def restart(self, index):
        self.processes[index].runner.stop()
        self.processes[index] = Process(self.ppo, index)

    def foreach_actor(self, ask, remote_actor_ids, timeout_seconds, healthy_only=True, mark_healthy=False):
        results = []
        for index in remote_actor_ids:
            if healthy_only and not self.healthy[index]:
                continue
            fault = self.faults[index].pop(0) if self.faults[index] else None
            if fault == SILENT:
                self.processes[index].call(ask)
                continue
            if fault is not None:
                self.processes[index].call(ask)  # the process was lost after its work, before its answer
                self.restart(index)
                self.healthy[index] = False
                results.append(Result(index, fault))
                continue
            results.append(Result(index, self.processes[index].call(ask)))
            self.restarts += mark_healthy and not self.healthy[index]
            self.healthy[index] |= mark_healthy
        return results


@pytest.fixture(scope="module")
def ppo():
    return build_algorithm(make_config(*SHORT, "model=event_columns", "algo.train_batch_size_per_learner=40"))


@pytest.fixture(scope="module")
def make(ppo):
    """A function that makes the rounds of a training without Ray, and the manager of its processes."""
    managers = []

    def made():
        local = SimpleNamespace(_weights_seq_no=0, state={})
        local.get_state = lambda: local.state
        managers.append(Manager(ppo))
        return Rounds(SimpleNamespace(_worker_manager=managers[-1], local_env_runner=local)), managers[-1]

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(rounds, "ray", SimpleNamespace(put=lambda value: value, get=lambda value: value))
        patched.setattr(rounds, "logs_folder", lambda: Path("/the/logs"))
        yield made
    for manager in managers:
        for process in manager.processes.values():
            process.runner.stop()


def sent(taking, manager, number, leave_out=()):
    """Send new weights to all but some env runners, as the learner does after each round."""
    state = manager.processes[1].runner.module.get_state()
    torch.manual_seed(number)
    weights = {name: value + torch.randn(value.shape).numpy() for name, value in state.items()}
    local = taking._group.local_env_runner
    local._weights_seq_no, local.state = number, {"rl_module": weights, "weights_seq_no": number}
    for index in set(RUNNERS) - set(leave_out):
        manager.processes[index].call(lambda runner: runner.set_state(local.state))


def bytes_of(parts):
    told = [
        (chunk.get_observations().tobytes(), chunk.get_actions().tobytes(), chunk.get_infos(-1)["distance_m"])
        for part in parts
        for chunk in part.episodes
    ]
    metrics = [part.metrics[name].peek() for part in parts for name in ("events_per_step", "num_episodes")]
    rounds_before = [part.after.values["metrics"]["rounds"] for part in parts]
    return [part.runner for part in parts], told, metrics, rounds_before


def lost_in_its_work(taking, manager):
    manager.faults[2] = [ActorUnavailableError("gone", None)]


def lost_twice(taking, manager):
    manager.faults[1] = [ActorUnavailableError("gone", None)] * 2


def started_again_unnoticed(taking, manager):
    manager.restart(1)
    manager.processes[1].call(lambda runner: runner.set_state(taking._group.local_env_runner.state))


def silent_for_too_long(taking, manager):
    manager.faults[2] = [SILENT]


def three_rounds(made, disturb=None, at=1, leave_out=()):
    """The bytes of three rounds, of which one is disturbed, or not all env runners have its weights."""
    parts = []
    for number in range(3):
        if number:
            sent(*made, number, leave_out if number == at else ())
        if disturb is not None and number == at:
            disturb(*made)
        parts += bytes_of(made[0].take())
    return parts


@pytest.fixture(scope="module")
def undisturbed(make):
    return three_rounds(make())


@pytest.mark.parametrize(
    ("disturb", "at", "leave_out", "restarts"),
    [
        (lost_in_its_work, 0, (), 1),
        (lost_in_its_work, 1, (), 1),
        (lost_twice, 1, (), 1),
        (started_again_unnoticed, 1, (), 1),
        (None, 1, (2,), 0),
        (silent_for_too_long, 0, (), 0),
    ],
)
def test_rounds_have_the_same_bytes_whatever_becomes_of_a_process(
    make, undisturbed, disturb, at, leave_out, restarts
):
    taking, manager = make()
    np.testing.assert_equal(three_rounds((taking, manager), disturb, at, leave_out), undisturbed)
    assert manager.restarts == restarts
    assert taking.problems == []


@pytest.mark.parametrize(
    ("fault", "words"),
    [(ActorDiedError(), "has died 4 times"), (SILENT, "has not started again for 600 s")],
)
def test_one_that_does_not_come_back_stops_the_training(make, fault, words):
    taking, manager = make()
    manager.faults[2] = [ActorUnavailableError("gone", None), fault]
    with pytest.raises(RolloutError, match=f"^env runner 2 {words}; see /the/logs$"):
        taking.take()


def test_what_an_env_runner_raises_is_not_tried_again(make):
    taking, manager = make()

    def broken(**asked):
        raise ValueError("episode 3, step 7, seed 0: the reward must be finite; got nan")

    manager.processes[1].runner._sample = broken
    with pytest.raises(RolloutError, match="step 7, seed 0: the reward must be finite; got nan"):
        taking.take()
    assert manager.restarts == 0
