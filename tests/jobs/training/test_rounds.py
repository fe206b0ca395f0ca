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

    def call_all(self, function):
        for process in self.processes.values():
            process.call(function)


@pytest.fixture(scope="module")
def ppo():
    return build_algorithm(make_config(*SHORT, "model=event_columns", "algo.train_batch_size_per_learner=40"))


@pytest.fixture
def make(ppo, monkeypatch):
    """A function that makes the rounds of a training without Ray, and the manager of its processes."""
    monkeypatch.setattr(rounds, "ray", SimpleNamespace(put=lambda value: value, get=lambda value: value))
    monkeypatch.setattr(rounds, "logs_folder", lambda: Path("/the/logs"))
    managers = []

    def made():
        local = SimpleNamespace(_weights_seq_no=0, state={})
        local.get_state = lambda: local.state
        managers.append(Manager(ppo))
        return Rounds(SimpleNamespace(_worker_manager=managers[-1], local_env_runner=local)), managers[-1]

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
    return (
        [part.runner for part in parts],
        told,
        metrics,
        [part.after.values["metrics"]["rounds"] for part in parts],
    )


def lost_in_its_work(taking, manager):
    manager.faults[2] = [ActorUnavailableError("gone", None)]


def lost_twice(taking, manager):
    manager.faults[1] = [ActorUnavailableError("gone", None)] * 2


def started_again_unnoticed(taking, manager):
    manager.restart(1)
    manager.processes[1].call(lambda runner: runner.set_state(taking._group.local_env_runner.state))


def silent_for_too_long(taking, manager):
    manager.faults[2] = [SILENT]


FAULTS = {lost_in_its_work: 1, lost_twice: 1, started_again_unnoticed: 1, silent_for_too_long: 0, None: 0}


@pytest.mark.parametrize(
    "fault",
    [pytest.param(fault, marks=pytest.mark.slow if fault is silent_for_too_long else ()) for fault in FAULTS],
)
def test_a_round_has_the_same_bytes_whatever_becomes_of_a_process(make, fault):
    told = []
    for disturb in (None, fault):
        taking, manager = make()
        parts = bytes_of(taking.take())
        for number in (1, 2):
            sent(taking, manager, number)
            if disturb is not None and number == 1:
                disturb(taking, manager)
            parts += bytes_of(taking.take())
        told.append(parts)
    np.testing.assert_equal(told[1], told[0])
    assert manager.restarts == FAULTS[fault]
    assert taking.problems == []


def test_weights_that_did_not_arrive_are_sent_again(make):
    told = []
    for leave_out in ((), (2,)):
        taking, manager = make()
        taking.take()
        sent(taking, manager, 1, leave_out)
        told.append(bytes_of(taking.take()))
    np.testing.assert_equal(told[1], told[0])
    assert manager.restarts == 0  # its process lives


def test_one_that_is_lost_before_its_first_round_begins_as_it_would_have(make):
    told = []
    for faults in ([], [ActorUnavailableError("gone", None)]):
        taking, manager = make()
        manager.faults[1] = faults
        told.append(bytes_of(taking.take()))
    np.testing.assert_equal(told[1], told[0])


def test_one_that_has_died_for_good_stops_the_training(make):
    taking, manager = make()
    manager.faults[2] = [ActorUnavailableError("gone", None), ActorDiedError()]
    with pytest.raises(RolloutError, match=r"^env runner 2 has died 4 times; see /the/logs$"):
        taking.take()


def test_one_that_does_not_come_back_stops_the_training(make):
    taking, manager = make()
    manager.faults[2] = [ActorUnavailableError("gone", None), SILENT]
    with pytest.raises(RolloutError, match=r"^env runner 2 has not started again for 600 s; see /the/logs$"):
        taking.take()


def test_what_an_env_runner_raises_is_not_tried_again(make):
    taking, manager = make()

    def broken(**asked):
        raise ValueError("episode 3, step 7, seed 0: the reward must be finite; got nan")

    manager.processes[1].runner._sample = broken
    with pytest.raises(RolloutError, match="step 7, seed 0: the reward must be finite; got nan"):
        taking.take()
    assert manager.restarts == 0
