"""Faults beside a sweep: every (condition, policy, seed) is evaluated once, and what cannot be is named."""

import signal
from collections import Counter

import pytest

from jobs.tracking.tracker import open_store
from tests.support.faults import (
    OUTGROW,
    SEEING,
    SWEEP,
    TASKS,
    check_ended_by_kernel,
    check_once,
    check_second_refused,
    launch,
    noting,
    outcome,
    start,
)

pytestmark = pytest.mark.faults


def test_a_killed_driver_continues_by_the_printed_command(tmp_path):
    job = launch(tmp_path, *SEEING, after=noting(tmp_path))
    job.wait(lambda: len(job.kept()) >= 3)
    job.process.send_signal(signal.SIGSTOP)  # or a busy machine lets it end before the second one looks
    check_second_refused(tmp_path, job)
    job.kill_alone()
    before = job.kept()
    assert before
    again = start(tmp_path, job.printed_command(), after=noting(tmp_path))  # at once
    check_once(again, tmp_path, again_at_most=2 * 2)  # two tasks of two episodes
    assert before.items() <= again.kept().items()
    outcome(
        "driver killed, sweep", "the printed command continues; each episode counts once", "0 kept episodes"
    )
    outcome("second driver, sweep", "refused while the first works, not after its SIGKILL", "nothing")


def test_ctrl_c_stops_a_sweep_that_the_same_command_continues(tmp_path):
    job = launch(tmp_path, *SEEING, after=noting(tmp_path))
    job.wait(lambda: len(job.kept()) >= 2)
    job.process.send_signal(signal.SIGINT)
    assert job.end() == 130, job.said
    assert "interrupted; the same command continues where it stopped" in job.said
    assert not (job.run / "stages" / "study.json").exists()
    again = start(tmp_path, job.printed_command(), after=noting(tmp_path))
    check_once(again, tmp_path, again_at_most=2 * 2)
    outcome("Ctrl+C, sweep", "status 130; the same command continues", "0 kept episodes")


BROKEN = """
import math, time
whole = roll_out_together
def roll_out_together(agent, flights):
    sparsity = {flight.config.faults.sparsity for flight in flights}
    if 0.25 in sparsity:
        raise ZeroDivisionError("no")
    if 0.5 in sparsity:
        time.sleep(10**6)
    if 0.9 in sparsity:
        outgrow()
    episodes = whole(agent, flights)
    if 0.75 in sparsity:
        episodes["distance_m"][1] = math.nan
    return episodes
"""


def test_a_task_that_raises_hangs_returns_nan_outgrows_or_has_no_opengl_stops_no_other(
    tmp_path, small_memory
):
    sparsity = "+study.axes.sparsity={faults.sparsity:[0.0,0.25,0.5,0.75,0.9]}"
    renderer = "+study.axes.renderer={renderer:[raycast,pyrender]}"
    words = (*SWEEP, "~study.axes", sparsity, renderer, "study.policies=[event_set-s0]")
    code = {
        "jobs.rollout.tune_executor": "MAX_START_S, MAX_STEP_S, MAX_FAILURES = 40.0, 0.0, 1",
        "jobs.rollout.executors": OUTGROW.format(group=str(small_memory)) + BROKEN,
    }
    job = launch(tmp_path, *words, after=code, EGL_DEVICE_ID="999")
    assert job.end() == 0, job.said
    table = (job.run / "study" / "table.md").read_text()
    reasons = {
        "sparsity | 0.25 | event_set | 0 | ZeroDivisionError: no |": "a trial that raises",
        "sparsity | 0.5 | event_set | 0 | its process ended (it may take 40 s) 2 times": "a trial that hangs",
        "sparsity | 0.75 | event_set | 0 | ValueError: episodes must be finite": "a trial that returns NaN",
        "sparsity | 0.9 | event_set | 0 | its process ended (killed, often for lack of memory, or crashed) "
        "2 times": "a trial that outgrows its memory",
        "renderer | pyrender | event_set | 0 | RuntimeError: ": "no OpenGL context in a worker",
    }
    for line, fault in reasons.items():
        assert line in table, table
        outcome(fault, "named in the table, tried again by the next run; others go on", "that task")
    assert "its process ended (it may take 40 s) 1 times, tried again: sparsity 0.5 event_set s0" in job.said
    check_ended_by_kernel(small_memory, 2)
    assert len(job.kept()) == 2


def test_two_sweeps_started_at_once_share_a_store(tmp_path):
    first, other = (launch(tmp_path, *SEEING, f"seed={seed}") for seed in (0, 1))
    assert first.end() == 0, first.said
    assert other.end() == 0, other.said
    assert len(list(first.runs.glob("*/study/episodes/*.json"))) == 2 * TASKS
    client, experiment = open_store(f"sqlite:///{tmp_path}/mlflow.db", "evade")
    runs = client.search_runs([experiment])
    assert {run.info.status for run in runs} == {"FINISHED"}
    assert Counter(run.data.tags["kind"] for run in runs) == {
        "sweep": 2,
        "condition": 2 * TASKS + 2 * 2,
        "group": 2 * 2,
    }
    outcome("two sweeps at once, one store", "both complete", "nothing")
