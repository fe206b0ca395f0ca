"""Faults beside a sweep: every (condition, policy, seed) is evaluated once, and what cannot be is named."""

import csv
import signal
from collections import Counter

import pytest

from jobs.tracking.tracker import open_store
from tests.support.faults import SWEEP, launch, outcome, start

pytestmark = pytest.mark.faults
SPARSITIES = "+sweep.axes.sparsity={faults.sparsity:[0.0,0.25,0.5,0.75]}"
WORDS = (*SWEEP, "~sweep.axes", SPARSITIES, "sweep.policies=[straight,oracle]")
TASKS = 4 * 2  # the nominal condition is that of sparsity 0
# Writes down each episode, and takes its time.
NOTED = """
import time
whole = roll_out
def roll_out(agent, config, seeds, *given, **named):
    episodes = whole(agent, config, seeds, *given, **named)
    with open({file!r}, "a") as notes:
        for seed in seeds:
            notes.write(f"{{type(agent).__name__}} {{config.faults.sparsity}} {{seed}}\\n")
    time.sleep(1.0)
    return episodes
"""


def noting(tmp_path):
    return {"jobs.rollout.executors": NOTED.format(file=str(tmp_path / "episodes"))}


def check_once(job, tmp_path, again_at_most):
    """Each episode stands once in the results; evaluated twice is at most what was under way at the fault."""
    with (job.run / "sweep" / "episodes.csv").open() as file:
        rows = [tuple(row.values()) for row in csv.DictReader(file)]
    assert len(rows) == len(set(rows))
    kept = [(key, row[0]) for key, rows in job.kept().items() for row in rows]
    assert len(kept) == len(set(kept)) == TASKS * 2
    evaluated = Counter((tmp_path / "episodes").read_text().splitlines())
    assert len(evaluated) == TASKS * 2
    assert sum(evaluated.values()) - len(evaluated) <= again_at_most


def test_a_killed_driver_continues_by_the_printed_command(tmp_path):
    job = launch(tmp_path, *WORDS, after=noting(tmp_path))
    job.wait(lambda: len(job.kept()) >= 3)
    job.kill()
    before = job.kept()
    assert len(before) < TASKS
    again = start(tmp_path, job.printed_command(), after=noting(tmp_path))
    assert again.end() == 0, again.said
    assert before.items() <= again.kept().items()
    check_once(again, tmp_path, again_at_most=2 * 2)  # two tasks of two episodes
    outcome(
        "driver killed, sweep", "the printed command continues; each episode counts once", "0 kept episodes"
    )


def test_ctrl_c_stops_a_sweep_that_the_same_command_continues(tmp_path):
    job = launch(tmp_path, *WORDS, after=noting(tmp_path))
    job.wait(lambda: len(job.kept()) >= 2)
    job.process.send_signal(signal.SIGINT)
    assert job.end() == 130, job.said
    assert "interrupted; the same command continues where it stopped" in job.said
    assert not (job.run / "stages" / "sweep.json").exists()
    again = start(tmp_path, job.printed_command(), after=noting(tmp_path))
    assert again.end() == 0, again.said
    check_once(again, tmp_path, again_at_most=2 * 2)
    outcome("Ctrl+C, sweep", "status 130; the same command continues", "0 kept episodes")


BROKEN = {
    "jobs.rollout.tune_executor": "MAX_START_S, MAX_STEP_S, MAX_FAILURES = 40.0, 0.0, 1",
    "jobs.rollout.executors": """
import math, time
whole = roll_out
def roll_out(agent, config, seeds, *given, **named):
    if config.faults.sparsity == 0.25:
        raise ZeroDivisionError("no")
    if config.faults.sparsity == 0.5:
        time.sleep(10**6)
    episodes = whole(agent, config, seeds, *given, **named)
    if config.faults.sparsity == 0.75:
        episodes["distance_m"][1] = math.nan
    return episodes
""",
}


def test_a_task_that_raises_hangs_returns_nan_or_has_no_opengl_stops_no_other(tmp_path):
    renderers = "+sweep.axes.renderer={renderer:[raycast,pyrender]}"
    words = (*SWEEP, "~sweep.axes", SPARSITIES, renderers, "sweep.policies=[straight]")
    job = launch(tmp_path, *words, after=BROKEN, EGL_DEVICE_ID="999")
    assert job.end() == 0, job.said
    table = (job.run / "sweep" / "table.md").read_text()
    reasons = {
        "sparsity | 0.25 | straight |  | ZeroDivisionError: no |": "a trial that raises",
        "sparsity | 0.5 | straight |  | its process ended (it may take 40 s) 2 times": "a trial that hangs",
        "sparsity | 0.75 | straight |  | ValueError: episodes must be finite": "a trial that returns NaN",
        "renderer | pyrender | straight |  | RuntimeError: ": "no OpenGL context in a worker",
    }
    for line, fault in reasons.items():
        assert line in table, table
        outcome(fault, "named in the table, tried again by the next run; others go on", "that task")
    assert "its process ended (it may take 40 s) 1 times, tried again: sparsity 0.5 straight" in job.said
    assert len(job.kept()) == 2


def test_two_sweeps_started_at_once_share_a_store_but_not_a_run_folder(tmp_path):
    words = (*SWEEP, "~sweep.axes", SPARSITIES, "sweep.policies=[straight]")
    first, other = (launch(tmp_path, *words, f"seed={seed}") for seed in (0, 1))
    first.wait(lambda: "Sweep: " in first.said)
    same = launch(tmp_path, *words, "seed=0")
    assert same.end() == 1
    assert "works there; wait until it has ended" in same.said
    assert first.end() == 0, first.said
    assert other.end() == 0, other.said
    assert len(list(first.runs.glob("*/sweep/episodes/*.json"))) == 2 * 4
    client, experiment = open_store(f"sqlite:///{tmp_path}/mlflow.db", "evade")
    runs = client.search_runs([experiment])
    assert {run.info.status for run in runs} == {"FINISHED"}
    assert Counter(run.data.tags["kind"] for run in runs) == {
        "sweep": 2,
        "condition": 2 * 5,
        "group": 2,
    }
    outcome("two sweeps at once, one store", "both complete; a second of the same run is refused", "nothing")
