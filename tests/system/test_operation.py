"""Jobs where people run them: folders of any name and content, and signals that end them."""

import os
import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import pytest

from jobs.tracking.tracker import open_store
from tests.support.started import ROOT

TRAINING = ("+exp=event_columns", "budget=smoke", "job=train", "algo=ppo")
EVADE = """
import signal, sys
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # the tests may run under nohup
sys.path[:] = [place for place in sys.path if place]
import jobs
sys.exit(jobs.main())
"""

pytestmark = pytest.mark.system


def evade(folder: Path, *words: str, **variables: str) -> subprocess.Popen:
    """Start `evade` in a folder, as the console script does: without the folder on Python's path."""
    settings = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", **variables}
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen([sys.executable, "-c", EVADE, *words], cwd=folder, env=settings, **streams)


def processes_of(folder: Path) -> list[str]:
    """Return the processes that work in a folder: those of Ray inherit it."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            if (entry / "cwd").resolve() == folder.resolve():
                found.append((entry / "cmdline").read_text().replace("\0", " "))
        except OSError:
            continue
    return found


@pytest.mark.slow
def test_a_training_runs_in_a_folder_of_any_name_with_packages_of_its_own_and_survives_a_deletion(tmp_path):
    folder = tmp_path / "job%2Fmain a?b#c"
    for name in ("envs", "models", "jobs", "core"):
        (folder / name).mkdir(parents=True)
        (folder / name / "__init__.py").write_text("raise ImportError('the package of the user')")
    words = (*TRAINING, "train.env_steps=256")
    out, err = (training := evade(folder, *words, PYTHONIOENCODING="ascii")).communicate()
    assert training.returncode == 0, (out, err)
    assert (folder / "mlflow.db").stat().st_size
    made = {"core", "envs", "jobs", "models", "mlartifacts", "mlflow.db", "mlflow.lock", "runs"}
    assert {path.name for path in folder.iterdir()} == made
    assert [path.name for path in tmp_path.iterdir()] == [folder.name]
    uri = f"sqlite:///{str(folder / 'mlflow.db').replace('%', '%25').replace('?', '%3F')}"
    client, experiment_id = open_store(uri, "evade")
    (run,) = client.search_runs([experiment_id])
    client.delete_run(run.info.run_id)
    again = evade(folder, *words)
    assert (again.communicate(), again.returncode)[1] == 0
    (new,) = client.search_runs([experiment_id])
    assert new.data.metrics.keys() >= run.data.metrics.keys()
    assert len(run.data.metrics) > 3


@pytest.mark.parametrize("number", [signal.SIGTERM, pytest.param(signal.SIGHUP, marks=pytest.mark.slow)])
def test_a_signal_ends_a_training_as_ctrl_c_does(tmp_path, number):
    training = evade(tmp_path, *TRAINING, "train.env_steps=60000")
    while training.poll() is None:
        if any(file.stat().st_size for file in tmp_path.glob("runs/*/train/results.jsonl")):
            break
        time.sleep(0.5)
    training.send_signal(number)
    _, err = training.communicate()
    assert training.returncode == 128 + number, err
    assert f"evade: ended by {number.name}; the same command".encode() in err.splitlines()[-1]
    assert b"received at time" not in err  # Ray's own dump
    status = sqlite3.connect(tmp_path / "mlflow.db").execute("select status from runs").fetchall()
    assert status == [("KILLED",)]
    for _ in range(180):
        if not (left := processes_of(tmp_path)):
            break
        time.sleep(0.5)
    assert left == []


def test_too_many_env_runners_are_refused_and_leave_nothing(launch, tmp_path):
    status, _, err = launch(*TRAINING, "algo.num_env_runners=999")
    assert status == 2
    assert "algo.num_env_runners: needs as many CPUs" in err
    assert list(tmp_path.iterdir()) == []
