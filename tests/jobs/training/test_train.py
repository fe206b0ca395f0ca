import dataclasses
import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from ray.exceptions import ActorDiedError, RayTaskError

from jobs.run.folder import open_run
from jobs.training import train as training
from jobs.training.ppo.train import PPO
from jobs.training.sampling.metrics import EpisodeMetrics
from jobs.training.train import TrainingError, read_metrics, read_results
from models.policy import load_policy
from tests.support.configs import TINY, make_config
from tests.support.patience import HANG_S
from tests.support.sockets import check_ray, listening

ROOT = Path(__file__).resolve().parents[3]


def result(**learner):
    losses = {"policy_loss": 0.1, "vf_loss": 2.0, "vf_explained_var": 0.5, "entropy": 1.0}
    losses |= {"gradients_default_optimizer_global_norm": 0.7}
    return {
        "num_env_steps_sampled_lifetime": 4096,
        "env_runners": {"num_env_steps_sampled": 2048, "episode_return": 12.5, "num_episodes_lifetime": 3},
        "learners": {"default_policy": losses | learner},
        "fault_tolerance": {"num_remote_worker_restarts": 0},
        "trial_restarts": 0,
    }


def test_metrics_are_read_from_a_result_and_what_was_not_measured_is_nan():
    metrics = read_metrics(result(), 2.0, PPO)
    assert metrics["train/episode_return"] == 12.5
    assert metrics["train/value_loss"] == 2.0
    assert metrics["perf/env_steps_per_second"] == 1024.0
    assert math.isnan(metrics["train/success_rate"])
    assert 12 <= len(metrics) <= 21


def test_a_loss_that_is_not_finite_stops_the_training():
    for bad in (math.nan, math.inf):
        with pytest.raises(TrainingError, match=r"train/value_loss = .* at environment step 4096"):
            read_metrics(result(vf_loss=bad), 2.0, PPO)
    told = read_metrics(result(vf_loss=math.nan, num_module_steps_trained=math.nan), 2.0, PPO)
    assert math.isnan(told["train/value_loss"])  # an iteration without a gradient step, as of RLlib's IMPALA


# What Ray's memory monitor writes, shortened.
LOW_MEMORY = """1 worker(s) were killed due to the node running low on memory. \
Memory on the node (IP: 127.0.0.1, ID: d3) was 6.76GB used / 23.54GB limit (0.287376)
OOM kill reason: Memory usage 7265206272B exceeded threshold of 505530272B (2.0% of 25276514304B limit)
Refer to the documentation on how to address the out of memory issue."""


class Trial:
    """A trial whose errors Tune has written down, the newest last."""

    num_failures = 1

    def __init__(self, folder, *errors):
        self.error_file = str(folder / "error.txt") if errors else None
        head = "Failure # {} (occurred at 2026-01-01_00-00-00)\n{}\n"
        (folder / "error.txt").write_text("".join(head.format(*error) for error in enumerate(errors)))


def test_what_the_code_raised_stops_and_what_a_lost_process_ended_goes_on(tmp_path, capsys):
    relay = training.Relay()
    raised = str(RayTaskError("train", "ray::PPO.train()\n  File 'a'\nValueError: no", ValueError("no")))
    lost = str(ActorDiedError())
    within = str(
        RayTaskError("train", "ray::PPO.train()\nray.exceptions.ActorDiedError: gone", ActorDiedError())
    )
    in_flight = raised.replace("ValueError", "jobs.training.sampling.env_runner.RolloutError: KeyError")
    stops = r"^training stopped: \w+Error: no; the same command continues"
    for errors in ((raised,), (lost, raised), (in_flight,)):
        with pytest.raises(TrainingError, match=stops):
            relay.on_trial_recover(1, [], Trial(tmp_path, *errors))
    for errors in ((), (lost,), (within,), (raised, lost), (raised, LOW_MEMORY)):
        relay.on_trial_recover(1, [], Trial(tmp_path, *errors))
    said = capsys.readouterr().out.replace("\n", " ")
    assert said.count("goes on from its last checkpoint") == 5
    assert "by Ray, for lack of memory: 6.76GB of 23.54GB in use; stop other programs" in said


def test_a_step_is_reported_once_even_after_a_kill_that_left_half_a_line(tmp_path):
    folder, seen = open_run(make_config(f"runs_dir={tmp_path}")), []
    file = folder.train / "results.jsonl"
    for steps in ((64, 128), (128, 192)):
        with training._listening(folder, lambda step, metrics: seen.append(step)) as last:
            assert last.get("train/episode_return") == (12.5 if seen else None)
            for step in steps:
                training._listeners[-1]({**result(), "num_env_steps_sampled_lifetime": step})
        with file.open("a") as half:
            half.write('{"env_st')
    rows = [json.loads(line) for line in file.read_text().splitlines()[:-1]]
    assert [row["env_steps"] for row in rows] == seen == [64, 128, 192]
    assert rows[0]["train/success_rate"] is None
    assert training._listeners == []


SCRIPT = """
import sys
from pathlib import Path
from jobs.run.folder import open_run
from jobs.training.train import train
from tests.support.configs import TINY, make_config
folder = open_run(make_config(*TINY, f"runs_dir={sys.argv[1]}"))
train(folder, Path(sys.argv[2]), lambda step, metrics: None)
"""


def reported(results, steps):
    """Whether a training has told of so many environment steps."""
    return any(env_steps >= steps for env_steps, _ in read_results(results))


@pytest.mark.system
def test_a_training_listens_on_loopback_alone_and_after_a_kill_goes_on_to_a_policy(tmp_path, encoder):
    command = [sys.executable, "-c", SCRIPT, str(tmp_path), str(encoder)]
    config = make_config(*TINY, f"runs_dir={tmp_path}")
    folder = open_run(config)
    results = folder.train / "results.jsonl"
    killed = subprocess.Popen(command, cwd=ROOT, env=os.environ | {"HOME": "/nowhere"})
    while not reported(results, 256) and killed.poll() is None:
        time.sleep(0.05)
    found = listening(killed.pid)
    killed.send_signal(signal.SIGKILL)
    killed.wait()
    check_ray(found)
    assert reported(results, 256)
    assert not reported(results, 1600)
    subprocess.run(command, cwd=ROOT, check=True, timeout=HANG_S)
    rows = [json.loads(line) for line in results.read_text().splitlines()]
    steps, episodes = ([row[name] for row in rows] for name in ("env_steps", "train/episodes"))
    assert steps == sorted(set(steps))
    assert steps[-1] >= 1600
    assert {row["evae/drift"] is None for row in rows} == {True, False}  # not measured in each iteration
    assert episodes == sorted(episodes)  # counted on, not anew
    assert json.loads((folder.policy / "encoder.json").read_text())["figures"] == {"reconstruction_step": 0.5}
    policy = load_policy(folder.policy)
    window = np.zeros((1, 4097, 4), np.int32)
    window[0, 0, 2] = 5000
    assert np.isfinite(policy.logits(window)).all()
    assert policy.manifest["algo"] == dataclasses.asdict(config.algo)


class Chunk:
    """A piece of an episode, as RLlib hands it to callbacks."""

    def __init__(self, name, rewards, done, success=False):
        self.id_, self.rewards, self.is_done = name, rewards, done
        outcome = {"success": success, "collision": not success, "distance_m": 7.0}
        self.info = {"num_events": 3, "dropped_events": 0, **outcome}

    def get_return(self):
        return sum(self.rewards)

    def get_infos(self, index=None):
        count = 1 + len(self.rewards)
        return self.info if index == -1 else {name: np.repeat(one, count) for name, one in self.info.items()}


class Logger(dict):
    def log_value(self, name, value, window):
        self[name] = value


@pytest.fixture
def fly_round():
    """Hands one round of sampling to the metrics; what they say then."""
    metrics, logger = EpisodeMetrics(), Logger()
    runner = SimpleNamespace(config=SimpleNamespace(env_config={}))

    def fly(*samples):
        metrics.on_sample_end(metrics_logger=logger, samples=list(samples), env_runner=runner)
        return logger.get("episode_return"), logger.get("success_rate")

    return fly


def test_flights_count_whole_and_stay_in_the_mean_over_iterations(fly_round):
    assert fly_round(Chunk("a", [1.0, 2.0], False), Chunk("b", [4.0], True)) == (None, None)
    assert fly_round(Chunk("a", [5.0], True, success=True)) == (6.0, 0.5)  # 8 for a, 4 for b
    assert fly_round(Chunk("c", [1.0], False)) == (6.0, 0.5)


def test_a_short_flight_waits_for_those_that_began_with_it(fly_round):
    air, crash = (lambda name, over=over: Chunk(name, [0.0], over) for over in (False, True))
    assert fly_round(air("a"), air("b"), crash("c")) == (None, None)
    assert fly_round(air("a"), Chunk("b", [0.0], True, success=True), crash("d")) == (None, None)
    assert fly_round(Chunk("a", [0.0], True, success=True))[1] == 0.5  # a and b won, c and d crashed


def test_a_flight_that_is_broken_off_holds_up_no_other(fly_round):
    fly_round(Chunk("a", [0.0], False), Chunk("b", [0.0], True, success=True))
    assert fly_round(Chunk("c", [0.0], False))[1] == 1.0
