"""Processes that outgrow the memory, stand still, or do the same work twice; clocks that jump."""

import os
import re
import signal
import time
from pathlib import Path

import pytest

from jobs.tracking.tracker import open_store
from tests.support.faults import (
    FINE,
    JUMPS,
    OUTGROW,
    SEEING,
    TASKS,
    TRAIN,
    check_complete,
    check_ended_by_kernel,
    check_once,
    command_line,
    descendants,
    launch,
    noting,
    outcome,
    standing_still,
    start,
)

pytestmark = pytest.mark.faults

GROWING_RUNNER = """
whole_step, count = CorridorVectorEnv.step, 0
def step(self, actions):
    global count
    count += 1
    if count == 60 and not os.path.exists({mark!r}):
        open({mark!r}, "w").close()
        outgrow()
    return whole_step(self, actions)
CorridorVectorEnv.step = step
"""
GROWING_DRIVER = """
whole_result = Relay.on_trial_result
def on_trial_result(self, iteration, trials, trial, result, **info):
    whole_result(self, iteration, trials, trial, result, **info)
    if result[ENV_STEPS] >= 480:
        outgrow()
Relay.on_trial_result = on_trial_result
"""


def test_a_training_goes_on_when_the_kernel_ends_its_env_runner_and_then_its_driver(tmp_path, small_memory):
    outgrow = OUTGROW.format(group=str(small_memory))
    after = {
        "envs.corridor": outgrow + GROWING_RUNNER.format(mark=str(tmp_path / "grown")),
        "jobs.training.train": outgrow + GROWING_DRIVER,
    }
    job = launch(tmp_path, *TRAIN, *FINE, after=after)
    assert job.end() == -signal.SIGKILL, job.said
    check_ended_by_kernel(small_memory, 2)
    before = job.rows()
    assert before[-1]["perf/env_runner_restarts"] == 1
    again = start(tmp_path, job.printed_command())
    check_complete(again)
    assert again.rows()[: len(before)] == before
    outcome("kernel ends an env runner for its memory", "started again", "its unfinished steps")
    outcome("kernel ends the driver for its memory", "the printed command continues", "0 results")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((*TRAIN, *FINE), r"training stopped: its process was ended (by Ray, .*); stop other programs, .*"),
        (SEEING, r"nothing could be evaluated: its process ended \((by Ray, .*)\) 1 times; .*"),
    ],
    ids=["training", "sweep"],
)
def test_a_machine_that_is_short_of_memory_stops_a_job_with_that_reason(tmp_path, words, said):
    once = "MAX_FAILURES = 0"
    after = {"jobs.training.train": once, "jobs.rollout.tune_executor": once}
    job = launch(tmp_path, *words, after=after, RAY_memory_usage_threshold="0.001")
    assert job.end() == 1, job.said
    last = re.fullmatch(f"evade: failed: {said}", job.said.splitlines()[-1])
    assert last, job.said
    assert re.fullmatch(r"by Ray, for lack of memory: [\d.]+GB of [\d.]+GB in use", last[1])
    outcome(
        f"machine short of memory, {name_of(words)}", "Ray ends processes; the job says so", "as if killed"
    )


# While a file exists, sampling has a short limit; another file says that it has begun.
UNDER_A_LIMIT = """
import contextlib, os, time
whole_limit = ending_after
@contextlib.contextmanager
def ending_after(seconds):
    limited = os.path.exists({mark!r})
    with whole_limit(10.0 if limited else seconds):
        if limited:
            open({begun!r}, "w").close()
            time.sleep(5.0)
        yield
"""


def name_of(words):
    return "sweep" if words == SEEING else "training"


def results(rows):
    """What must repeat: all but speeds, restarts, and the checksum over them."""
    return [{k: x for k, x in row.items() if not k.startswith("perf/") and k != "checksum"} for row in rows]


def test_a_training_that_stood_still_gives_the_same_results(tmp_path):
    mark, begun = tmp_path / "limited", tmp_path / "begun"
    words = (*TRAIN, *FINE, "train.env_steps=2560")  # still at work when it stands still for the last time
    undisturbed = launch(tmp_path / "undisturbed", *words)
    check_complete(undisturbed)
    code = {"jobs.training.sampling.env_runner": UNDER_A_LIMIT.format(mark=str(mark), begun=str(begun))}
    job = launch(tmp_path / "stopped", *words, after=code)
    job.wait(lambda: job.steps() >= 128)
    with standing_still(job.workers("ray::PlainEnvRunner")):
        time.sleep(3.0)
    job.wait(lambda: job.steps() >= 256)
    with standing_still([job.process.pid, *descendants(job.process.pid)]):
        time.sleep(8.0)
    job.wait(lambda: job.steps() >= 512)
    before = job.rows()
    assert {row["perf/env_runner_restarts"] for row in before} == {0}
    assert results(before) == results(undisturbed.rows()[: len(before)])
    outcome("training stopped for seconds and continued", "the same results", "nothing")
    mark.touch()
    job.wait(begun.exists)
    with standing_still(job.workers("ray::PlainEnvRunner")):
        mark.unlink()
        time.sleep(11.0)
    check_complete(job)
    assert job.rows()[-1]["perf/env_runner_restarts"] == 1
    outcome("env runner stopped for longer than its limit", "ended, started again", "its unfinished steps")


STANDING_TASK = """
import os
noted = evaluate_part
def evaluate_part(part):
    if (part.task.env.faults.sparsity, part.task.policy.group) == (0.5, "bytestream"):
        if not os.path.exists({mark!r}):
            with open({mark!r}, "w") as file:
                file.write(f"{{os.getpid()}}\\n")
            time.sleep(5.0)
    return noted(part)
"""
ITS_LIMIT = """
whole_limit_s = time_limit_s
def time_limit_s(batch):
    stands = [(part.task.env.faults.sparsity, part.task.policy.group) for part in batch]
    return 30.0 if (0.5, "bytestream") in stands else whole_limit_s(batch)
"""


def test_a_sweep_that_stood_still_gives_the_same_episodes(tmp_path):
    mark = tmp_path / "stands"
    code = noting(tmp_path)
    code["jobs.rollout.executors"] += STANDING_TASK.format(mark=str(mark))
    job = launch(tmp_path, *SEEING, after={**code, "jobs.rollout.tune_executor": ITS_LIMIT})
    job.wait(lambda: mark.exists() and mark.read_text().endswith("\n"))
    begun = time.monotonic()
    with standing_still([int(mark.read_text())]) as pids:
        others = {job.process.pid, *descendants(job.process.pid)} - set(pids)
        with standing_still(others):
            time.sleep(5.0)
        job.wait(lambda: len(job.kept()) == TASKS - 1)  # the others go on
        job.wait(lambda: time.monotonic() > begun + 31.0)
    check_once(job, tmp_path, again_at_most=0)
    said = "its process ended (it may take 30 s) 1 times, tried again: sparsity 0.5 bytestream s0"
    assert said in job.said
    outcome("sweep stopped for seconds and continued", "the same episodes", "nothing")
    outcome("sweep worker stopped for longer than its limit", "ended, tried again; others go on", "that part")


def test_clock_jumps_change_no_episode_and_no_duration_of_a_sweep(tmp_path):
    job = launch(tmp_path, *SEEING, first=JUMPS, after=noting(tmp_path))
    check_once(job, tmp_path, again_at_most=0)
    client, experiment = open_store(f"sqlite:///{tmp_path}/mlflow.db", "evade")
    runs = client.search_runs([experiment])
    assert len(runs) > TASKS
    assert all(0 <= run.info.end_time - run.info.start_time < 3000e3 for run in runs)
    (parent,) = (run for run in runs if run.data.tags["kind"] == "sweep")
    assert all(
        parent.info.start_time <= run.info.start_time <= run.info.end_time <= parent.info.end_time
        for run in runs
    )
    outcome("clock jumps an hour, to and fro, sweep", "the same episodes, true durations", "nothing")


FULL_STORE = """
def _start_local(settings, whole=_start_local):
    whole({**settings, "object_store_memory": 80 * 2**20})
    import numpy, ray
    ray.held = [ray.put(numpy.zeros(2**22)) for _ in range(6)]  # 32 MiB each
"""


def spilled(job):
    """The files of the objects for which the store of a job's own Ray had no room."""
    lines = (command_line(pid) for pid in descendants(job.process.pid))
    folders = {found[1] for found in (re.search(r"--session_dir=(\S+)", line) for line in lines) if found}
    return [file for folder in folders for file in Path(folder).glob("ray_spilled_objects*/*")]


@pytest.mark.parametrize("words", [(*TRAIN, *FINE), SEEING], ids=["training", "sweep"])
def test_a_full_object_store_spills_to_the_disk(tmp_path, words):
    with_store = {**noting(tmp_path), "jobs.run.ray_cluster": FULL_STORE}
    job = launch(tmp_path, *words, after=with_store)
    job.wait(lambda: spilled(job))
    if words == SEEING:
        check_once(job, tmp_path, again_at_most=0)
    else:
        check_complete(job)
    outcome(f"object store full, {name_of(words)}", "spilled to the temporary folder", "nothing")


SMOKE = ("+exp=bytestream", "budget=smoke", "env.time_limit_s=0.2", "evaluate.episodes=1")
QUICK = ("evaluate.renderers=[raycast]", "evaluate.video=false", "train.env_steps=512")


def test_of_two_pipelines_started_at_once_one_is_refused_and_the_other_ends_well(tmp_path):
    jobs = [launch(tmp_path, *SMOKE, *QUICK) for _ in "ab"]
    while all(job.process.poll() is None for job in jobs):
        time.sleep(0.1)
    (refused,) = (job for job in jobs if job.process.poll() is not None)
    (working,) = (job for job in jobs if job is not refused)
    assert refused.process.returncode == 1, refused.said
    # Which of them works, the other may read before it is written.
    who = f"(process {working.process.pid} of {os.uname().nodename}|another process)"
    said = f"evade: failed: {re.escape(str(working.run))}: {who} works there; wait until it has ended"
    assert re.fullmatch(said, refused.said.splitlines()[-1]), refused.said
    working.kill_alone()
    again = start(tmp_path, working.printed_command())  # at once
    assert again.end() == 0, again.said
    stages = {path.stem for path in (again.run / "stages").iterdir()}
    assert stages == {"collect", "pretrain", "train", "evaluate"}
    outcome("two drivers of one run folder at once", "one works, the other is refused", "nothing")
    outcome("a driver right after another was killed", "continues", "as if killed")
