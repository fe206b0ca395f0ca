import dataclasses
import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from ray.exceptions import ActorDiedError, RayTaskError

from jobs.run.folder import open_run
from jobs.training import train as training
from jobs.training.ppo.train import PPO
from jobs.training.sampling.metrics import EpisodeMetrics
from jobs.training.train import TrainingError, read_metrics, reported_so_far
from models.policy import load_policy
from tests.support.configs import TINY, make_config
from tests.support.patience import HANG_S
from tests.support.sockets import check_ray, listening

ROOT = Path(__file__).resolve().parents[3]


def result(**learner):
    losses = {
        "policy_loss": 0.1,
        "vf_loss": 2.0,
        "vf_explained_var": 0.5,
        "entropy": 1.0,
        "gradients_default_optimizer_global_norm": 0.7,
    }
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


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_loss_that_is_not_finite_stops_the_training(bad):
    with pytest.raises(TrainingError, match=r"train/value_loss = .* at environment step 4096"):
        read_metrics(result(vf_loss=bad), 2.0, PPO)


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
        texts = [
            f"Failure # {k} (occurred at 2026-01-01_00-00-00)\n{text}\n" for k, text in enumerate(errors)
        ]
        (folder / "error.txt").write_text("".join(texts))


def test_what_the_code_raised_stops_and_what_a_lost_process_ended_goes_on(tmp_path, capsys):
    relay = training.Relay()
    raised = str(RayTaskError("train", "ray::PPO.train()\n  File 'a'\nValueError: no", ValueError("no")))
    lost = str(ActorDiedError())
    within = str(
        RayTaskError("train", "ray::PPO.train()\nray.exceptions.ActorDiedError: gone", ActorDiedError())
    )
    for errors in (
        (raised,),
        (lost, raised),
        (raised.replace("ValueError", "jobs.training.sampling.env_runner.RolloutError: KeyError"),),
    ):
        with pytest.raises(
            TrainingError, match=r"^training stopped: \w+Error: no; the same command continues"
        ):
            relay.on_trial_recover(1, [], Trial(tmp_path, *errors))
    for errors in ((), (lost,), (within,), (raised, lost), (raised, LOW_MEMORY)):
        relay.on_trial_recover(1, [], Trial(tmp_path, *errors))
    said = capsys.readouterr().out
    assert said.count("goes on from its last checkpoint") == 5
    assert "by Ray, for lack of memory: 6.76GB of 23.54GB in use; stop other programs" in said.replace(
        "\n", " "
    )


def test_a_results_file_cut_by_a_kill_counts_its_whole_lines(tmp_path):
    file = tmp_path / "results.jsonl"
    assert reported_so_far(file)[0] == 0
    file.write_text('{"env_steps": 64}\n{"env_steps": 128}\n{"env_st')
    assert reported_so_far(file)[0] == 128


def test_half_a_line_left_by_a_kill_is_not_written_on_to(tmp_path):
    folder = open_run(make_config(f"runs_dir={tmp_path}"))
    file = folder.train / "results.jsonl"
    file.parent.mkdir(parents=True)
    file.write_text('{"env_steps": 64, "train/entropy": 0.5}\n{"env_st')
    with training._listening(folder, lambda step, metrics: None) as last:
        assert last == {"train/entropy": 0.5}
        training._listeners[-1]({**result(), "num_env_steps_sampled_lifetime": 128})
    assert [json.loads(line)["env_steps"] for line in file.read_text().splitlines()] == [64, 128]


def test_a_step_is_reported_once_even_after_a_restart(tmp_path):
    folder, seen = open_run(make_config(f"runs_dir={tmp_path}")), []
    for steps in ((64, 128), (128, 192)):
        with training._listening(folder, lambda step, metrics: seen.append(step)) as last:
            for step in steps:
                training._listeners[-1]({**result(), "num_env_steps_sampled_lifetime": step})
    assert seen == [64, 128, 192]
    assert last["train/episode_return"] == 12.5
    lines = (folder.train / "results.jsonl").read_text().splitlines()
    assert [json.loads(line)["env_steps"] for line in lines] == seen
    assert json.loads(lines[0])["train/success_rate"] is None
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


@pytest.mark.system
def test_a_training_listens_on_loopback_alone_and_after_a_kill_goes_on_to_a_policy(tmp_path, encoder):
    command = [sys.executable, "-c", SCRIPT, str(tmp_path), str(encoder)]
    config = make_config(*TINY, f"runs_dir={tmp_path}")
    folder = open_run(config)
    results = folder.train / "results.jsonl"
    killed = subprocess.Popen(command, cwd=ROOT, env=os.environ | {"HOME": "/nowhere"})
    while reported_so_far(results)[0] < 256 and killed.poll() is None:
        time.sleep(0.05)
    found = listening(killed.pid)
    killed.send_signal(signal.SIGKILL)
    killed.wait()
    check_ray(found)
    before = reported_so_far(results)[0]
    assert 256 <= before < 1600
    subprocess.run(command, cwd=ROOT, check=True, timeout=HANG_S)
    steps = [json.loads(line)["env_steps"] for line in results.read_text().splitlines()]
    assert steps == sorted(set(steps))
    assert steps[-1] >= 1600
    rows = [json.loads(line) for line in results.read_text().splitlines()]
    assert {row["evae/drift"] is None for row in rows} == {True, False}  # not measured in each iteration
    assert json.loads((folder.policy / "encoder.json").read_text())["figures"] == {"reconstruction_step": 0.5}
    episodes = [json.loads(line)["train/episodes"] for line in results.read_text().splitlines()]
    assert episodes == sorted(episodes)  # counted on, not anew
    policy = load_policy(folder.policy)
    window = np.zeros((1, 4097, 4), np.int32)
    window[0, 0, 2] = 5000
    assert np.isfinite(policy.logits(window)).all()
    assert policy.manifest["algo"] == dataclasses.asdict(config.algo)


class Chunk:
    """A piece of an episode, as RLlib hands it to callbacks."""

    def __init__(self, name, rewards, done, success=False):
        self.id_, self.rewards, self.is_done = name, rewards, done
        self.info = {
            "num_events": 3,
            "dropped_events": 0,
            "success": success,
            "collision": not success,
            "distance_m": 7.0,
        }

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

    def fly(*samples):
        metrics.on_sample_end(metrics_logger=logger, samples=list(samples))
        return logger.get("episode_return"), logger.get("success_rate")

    return fly


def test_flights_count_whole_and_stay_in_the_mean_over_iterations(fly_round):
    assert fly_round(Chunk("a", [1.0, 2.0], False), Chunk("b", [4.0], True)) == (None, None)
    assert fly_round(Chunk("a", [5.0], True, success=True)) == (6.0, 0.5)  # 8 for a, 4 for b
    assert fly_round(Chunk("c", [1.0], False)) == (6.0, 0.5)


def test_a_short_flight_waits_for_those_that_began_with_it(fly_round):
    assert (
        fly_round(Chunk("a", [0.0], False), Chunk("b", [0.0], False), Chunk("c", [0.0], True)) == (None,) * 2
    )
    assert fly_round(Chunk("a", [0.0], False), Chunk("b", [0.0], True, True), Chunk("d", [0.0], True)) == (
        None,
        None,
    )
    assert fly_round(Chunk("a", [0.0], True, success=True))[1] == 0.5  # a and b won, c and d crashed


def test_a_flight_that_is_broken_off_holds_up_no_other(fly_round):
    fly_round(Chunk("a", [0.0], False), Chunk("b", [0.0], True, success=True))
    assert fly_round(Chunk("c", [0.0], False))[1] == 1.0
