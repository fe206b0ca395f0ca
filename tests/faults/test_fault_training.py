"""Faults beside a training: nothing is lost but the steps since its last checkpoint."""

import os
import re
import shutil
import signal
import tempfile

import pytest

from jobs.training.ppo.train import FIGURES, LOSSES
from jobs.training.train import METRICS
from tests.support.faults import (
    FINE,
    JUMPS,
    TRAIN,
    check_complete,
    check_second_refused,
    cut,
    fill,
    flip,
    launch,
    outcome,
    start,
)

pytestmark = pytest.mark.faults
SAME = ["env_steps", *(name for name in [*METRICS, *LOSSES, *FIGURES] if not name.startswith("perf/"))]


def checkpoints(job):
    """Its checkpoints, the newest last."""
    return sorted(job.run.glob("train/PPO*/checkpoint_*"))


def test_a_killed_driver_continues_by_the_printed_command(tmp_path):
    # Long enough to be still at work when the other has started.
    job = launch(tmp_path, *TRAIN, *FINE, "train.env_steps=6400")
    job.wait(lambda: job.steps() >= 128)
    check_second_refused(tmp_path, job)
    job.wait(lambda: job.steps() >= 320)
    job.kill_alone()
    before = job.rows()
    again = start(tmp_path, job.printed_command())  # at once: what the other started may still be ending
    check_complete(again)
    assert again.rows()[: len(before)] == before
    outcome("driver killed, training", "the printed command continues; each step reported once", "0 results")
    outcome("second driver, training", "refused while the first works, not after its SIGKILL", "nothing")


def test_ctrl_c_stops_a_training_that_the_same_command_continues(tmp_path):
    job = launch(tmp_path, *TRAIN, *FINE)
    job.wait(lambda: job.steps() >= 192)
    job.process.send_signal(signal.SIGINT)
    assert job.end() == 130, job.said
    assert "interrupted; the same command continues where it stopped" in job.said
    assert not (job.run / "policy").exists()
    assert not (job.run / "stages" / "train.json").exists()
    check_complete(start(tmp_path, job.printed_command()))
    outcome("Ctrl+C, training", "status 130; the same command continues", "0 results")


def largest(checkpoint):
    return max(checkpoint.rglob("*.*"), key=lambda path: path.stat().st_size)


def newest(job):
    return checkpoints(job)[-2:]  # the kill may have come before the newest was named


HARMS = {
    "checkpoint cut": lambda job: [cut(largest(path)) for path in newest(job)],
    "checkpoint changed in one bit": lambda job: [flip(largest(path)) for path in newest(job)],
    "checkpoint gone": lambda job: [shutil.rmtree(path) for path in newest(job)],
    "Tune's state cut": lambda job: cut(*job.run.glob("train/experiment_state-*.json")),
}
SAID = {
    "checkpoint": r"Checkpoint damaged \(.*takes its place",
    "Tune's": "State of the training damaged, the one before takes its place",
}


@pytest.mark.parametrize("harm", HARMS)
def test_what_is_damaged_is_left_for_what_was_kept_before(tmp_path, harm):
    job = launch(tmp_path, *TRAIN, *FINE)
    job.wait(lambda: job.steps() >= 320 and len(checkpoints(job)) >= 3)
    job.kill()
    HARMS[harm](job)
    again = start(tmp_path, job.printed_command())
    check_complete(again)
    assert re.search(SAID[harm.split()[0]], again.said, re.DOTALL)
    outcome(harm, "said aloud, the newest whole one is taken", "the steps since that one")


BUG = """
whole_step = CorridorVectorEnv.step
count = 0
def step(self, actions):
    global count
    count += 1
    if count > 100:
        raise ValueError("episode 3, step 7, seed 0: the reward must be finite; got nan")
    return whole_step(self, actions)
CorridorVectorEnv.step = step
"""
CRASH = BUG.replace("raise ValueError", "__import__('os')._exit(3);")
HANG = BUG.replace("raise ValueError", "import time; time.sleep(10**6);")


NO_WORLD = """
def refuse(self, *values, **named):
    raise TypeError("there is no such world")
CorridorVectorEnv.__init__ = refuse
"""
NAN = "ValueError: episode 3, step 7, seed 0: the reward must be finite; got nan"


@pytest.mark.parametrize(
    ("code", "reason", "runners"),
    [
        (BUG, NAN, 0),
        (BUG, NAN, 1),
        (NO_WORLD, "TypeError: there is no such world", 0),
        (NO_WORLD, "TypeError: there is no such world", 2),
    ],
)
def test_a_bug_in_the_simulation_or_no_world_stops_at_once_with_its_reason(tmp_path, code, reason, runners):
    job = launch(tmp_path, *TRAIN, *FINE, f"algo.num_env_runners={runners}", after={"envs.corridor": code})
    assert job.end() == 1
    said = f"evade: failed: training stopped: {reason}; the same command"
    assert job.said.splitlines()[-1].startswith(said)
    assert job.said.count("goes on") == 0
    what = "NaN or a bug" if code == BUG else "no world"
    outcome(
        f"{what}, {runners} env runners",
        "stops at the first time, with its reason",
        "steps since a checkpoint",
    )


def test_a_bug_that_ends_the_process_each_time_stops_after_a_few_restarts(tmp_path):
    job = launch(tmp_path, *TRAIN, *FINE, after={"envs.corridor": CRASH})
    assert job.end() == 1
    assert "failed: " in job.said
    outcome("env runner crashes always", "stops after a few restarts", "steps since a checkpoint")


def test_an_env_runner_that_hangs_is_ended_and_started_again(tmp_path):
    limit = "MAX_SAMPLE_S = 60.0"
    once = HANG.replace("count > 100", "count == 100 and not __import__('os').path.exists(MARK)").replace(
        "import time;", "open(MARK, 'w'); import time;"
    )
    code = f"MARK = {str(tmp_path / 'hung')!r}\n{once}"
    job = launch(
        tmp_path, *TRAIN, *FINE, after={"jobs.training.sampling.env_runner": limit, "envs.corridor": code}
    )
    check_complete(job)
    assert (tmp_path / "hung").exists()
    assert job.rows()[-1]["perf/env_runner_restarts"] >= 1
    outcome("env runner hangs", "ended after its limit (900 s), goes on where it was", "nothing")


def test_clock_jumps_change_no_result(tmp_path):
    job = launch(tmp_path, *TRAIN, *FINE, first=JUMPS)
    job.wait(lambda: job.steps() >= 320)
    job.kill()
    again = start(tmp_path, job.printed_command(), first=JUMPS)
    check_complete(again)
    speeds = [row["perf/env_steps_per_second"] for row in again.rows()]
    assert all(speed is None or 0 < speed < 1e5 for speed in speeds)
    outcome("clock jumps an hour, to and fro", "training and resuming go on; speeds stay true", "nothing")


def test_a_home_that_cannot_be_written_is_not_needed(tmp_path):
    home = {"HOME": "/proc/nowhere", "XDG_CACHE_HOME": "", "XDG_CONFIG_HOME": ""}
    words = [word for word in TRAIN if not word.startswith("job=")]
    few = ("evaluate.episodes=1", "evaluate.renderers=[raycast]", "train.env_steps=128")
    job = launch(tmp_path, *words, *few, **home)
    assert job.end() == 0, job.said
    assert {path.stem for path in (job.run / "stages").iterdir()} == {"train", "evaluate"}
    outcome("HOME not writable", "trains, evaluates and films as ever", "nothing")


@pytest.fixture
def short_folder():
    """A folder on another file system than the small one, whose name leaves room for Ray's sockets."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        yield folder


def test_a_disk_that_is_full_stops_with_its_reason_and_the_same_command_continues(small_disk, short_folder):
    job = launch(small_disk, *TRAIN, "train.env_steps=960", "train.checkpoint_every=1", TMPDIR=short_folder)
    job.wait(lambda: job.steps() >= 256)
    filler = fill(small_disk)
    assert job.end() == 1, job.said
    # A file met the full disk first, or the store did.
    assert re.search("No space left on device|database or disk is full", job.said.splitlines()[-1]), job.said
    filler.unlink()
    check_complete(start(small_disk, job.printed_command(), TMPDIR=short_folder))
    outcome(
        "disk full, training",
        "stops with the reason; with room, the same command continues",
        "steps since a checkpoint",
    )


def test_a_training_that_is_disturbed_ends_with_the_bytes_of_one_that_is_not(tmp_path):
    words = *TRAIN, *FINE, "algo.num_env_runners=2", "train.checkpoint_every=3", "env.time_limit_s=0.2"
    whole = launch(tmp_path / "whole", *words)
    check_complete(whole)
    job = launch(tmp_path / "disturbed", *words)
    job.wait(lambda: job.steps() >= 128)
    os.kill(job.workers("ray::PlainEnvRunner")[0], signal.SIGKILL)
    before = job.steps()
    job.wait(lambda: job.steps() > before + 64)
    assert job.rows()[-1]["perf/env_runner_restarts"] == 1
    job.kill()
    again = start(tmp_path / "disturbed", job.printed_command())
    check_complete(again)
    assert "new episodes" not in again.said
    told = [[{name: row[name] for name in SAME} for row in one.rows()] for one in (whole, again)]
    assert told[0] == told[1]
    policies = [sorted((one.run / "policy").glob("*.safetensors")) for one in (whole, again)]
    assert [path.read_bytes() for path in policies[0]] == [path.read_bytes() for path in policies[1]]
    assert policies[0]
    outcome("env runner and driver killed", "the same bytes as undisturbed", "nothing")
