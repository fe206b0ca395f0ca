"""Faults beside a training: nothing is lost but the steps since its last checkpoint."""

import json
import os
import re
import shutil
import signal
import tempfile

import pytest

from jobs.training.ppo.train import FIGURES, LOSSES
from jobs.training.train import METRICS
from tests.support.faults import FINE, TRAIN, check_complete, launch, outcome, start

pytestmark = pytest.mark.faults
SAME = ["env_steps", *(name for name in [*METRICS, *LOSSES, *FIGURES] if not name.startswith("perf/"))]


def checkpoints(job):
    """Its checkpoints, the newest last."""
    return sorted(job.run.glob("train/PPO*/checkpoint_*"))


def test_an_env_runner_that_is_killed_is_started_again_and_counted(tmp_path):
    job = launch(tmp_path, *TRAIN, *FINE)
    job.wait(lambda: job.steps() >= 128)
    (pid,) = job.workers("ray::PlainEnvRunner")
    before = job.steps()
    os.kill(pid, signal.SIGKILL)
    check_complete(job)
    restarts = json.loads((job.run / "stages" / "train.json").read_text())["figures"][
        "perf/env_runner_restarts"
    ]
    assert restarts == 1
    repeated = [row["env_steps"] for row in job.rows() if row["env_steps"] > before]
    outcome("env runner killed", "started again, goes on where it was (restarts in results: 1)", "nothing")
    assert repeated


def test_a_killed_driver_continues_by_the_printed_command(tmp_path):
    # Long enough to be still at work when the other has started.
    job = launch(tmp_path, *TRAIN, *FINE, "train.env_steps=6400")
    job.wait(lambda: job.steps() >= 128)
    refused = start(tmp_path, job.printed_command())
    assert refused.end() == 1
    assert f"{job.run}: process {job.process.pid} of " in refused.said
    assert "works there; wait until it has ended" in refused.said
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


def cut(checkpoint):
    file = largest(checkpoint)
    file.write_bytes(file.read_bytes()[:-100])


def flip(checkpoint):
    file = largest(checkpoint)
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


def largest(checkpoint):
    return max(checkpoint.rglob("*.*"), key=lambda path: path.stat().st_size)


@pytest.mark.parametrize(
    ("how", "harm"), [("cut", cut), ("changed in one bit", flip), ("gone", shutil.rmtree)]
)
def test_a_damaged_checkpoint_is_left_for_the_one_before(tmp_path, how, harm):
    job = launch(tmp_path, *TRAIN, *FINE)
    job.wait(lambda: job.steps() >= 320 and len(checkpoints(job)) >= 3)
    job.kill()
    for path in checkpoints(job)[-2:]:  # the kill may have come before the newest was named
        harm(path)
    again = start(tmp_path, job.printed_command())
    check_complete(again)
    assert "Checkpoint damaged (" in again.said
    assert "takes its place" in again.said
    outcome(f"checkpoint {how}", "said aloud, the newest whole one is taken", "the steps since that one")


def test_what_tune_knows_is_kept_whole(tmp_path):
    job = launch(tmp_path, *TRAIN, *FINE)
    job.wait(lambda: job.steps() >= 320 and len(checkpoints(job)) >= 3)
    job.kill()
    (state,) = job.run.glob("train/experiment_state-*.json")
    state.write_bytes(state.read_bytes()[:-100])  # as a full disk does
    again = start(tmp_path, job.printed_command())
    check_complete(again)
    assert "State of the training damaged, the one before takes its place" in again.said
    outcome("Tune's state cut", "said aloud, the one that was kept is taken", "steps since a checkpoint")


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


@pytest.mark.parametrize("runners", [0, 1])
def test_a_bug_in_the_simulation_stops_at_once_with_its_reason(tmp_path, runners):
    job = launch(tmp_path, *TRAIN, *FINE, f"algo.num_env_runners={runners}", after={"envs.corridor": BUG})
    assert job.end() == 1
    reason = "ValueError: episode 3, step 7, seed 0: the reward must be finite; got nan"
    assert job.said.splitlines()[-1].startswith(
        f"evade: failed: training stopped: {reason}; the same command"
    )
    assert job.said.count("goes on") == 0
    where = "the learner's process" if runners == 0 else "an env runner"
    outcome(
        f"NaN or a bug in {where}", "stops at the first time, with its reason", "steps since a checkpoint"
    )


NO_WORLD = """
def refuse(self, *values, **named):
    raise TypeError("there is no such world")
CorridorVectorEnv.__init__ = refuse
"""


@pytest.mark.parametrize("runners", [0, 2])
def test_a_world_that_cannot_be_made_stops_at_once_with_its_reason(tmp_path, runners):
    job = launch(
        tmp_path, *TRAIN, *FINE, f"algo.num_env_runners={runners}", after={"envs.corridor": NO_WORLD}
    )
    assert job.end() == 1
    reason = "evade: failed: training stopped: TypeError: there is no such world; the same command"
    assert job.said.splitlines()[-1].startswith(reason)
    assert job.said.count("goes on") == 0
    outcome(f"no world, {runners} env runners", "stops at once, with its reason", "nothing")


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
    jumps = """
import time
real, begun = time.time, time.monotonic()
time.time = lambda: real() + (3600.0, -3600.0, 0.0)[int(time.monotonic() - begun) // 2 % 3]
"""
    job = launch(tmp_path, *TRAIN, *FINE, first=jumps)
    job.wait(lambda: job.steps() >= 320)
    job.kill()
    again = start(tmp_path, job.printed_command(), first=jumps)
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
    filler = small_disk / "filler"
    job.wait(lambda: job.steps() >= 256)
    fill(filler)
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


def fill(file):
    """Take all the room that there is."""
    with file.open("wb", buffering=0) as stream:
        for size in (1 << 20, 1 << 12):
            try:
                while True:
                    stream.write(b"\0" * size)
            except OSError:
                continue


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
