"""A PostgreSQL of its own under eight sweeps that report at once."""

import dataclasses
import json
import multiprocessing
import os
import pwd
import shutil
import socket
import subprocess
from collections import Counter
from pathlib import Path

import pytest

from jobs.tracking.tracker import open_store
from tests.support.configs import sweep_config

pytestmark = pytest.mark.cluster
WRITERS = 8
PROGRAMS = sorted(Path("/usr/lib/postgresql").glob("*/bin"))


@pytest.fixture
def postgres(tmp_path_factory):
    """Address of a server that runs as its own user, with a database for the results."""
    pytest.importorskip("psycopg", reason="needs PostgreSQL's driver: pip install 'evade[postgres]'")
    if not PROGRAMS or os.getuid() != 0:
        pytest.skip("needs PostgreSQL (apt-get install postgresql), and root to start it as its own user")
    user = pwd.getpwnam("postgres")
    # Not below pytest's folder, which its own user alone may enter.
    place = Path(subprocess.check_output(["mktemp", "-d", "/tmp/evade-pg-XXXXXX"], text=True).strip())
    os.chown(place, user.pw_uid, user.pw_gid)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]

    def pg(*words):
        command = [str(PROGRAMS[-1] / words[0]), *words[1:]]
        subprocess.run(command, user="postgres", group="postgres", cwd=place, check=True, capture_output=True)

    data = str(place / "data")
    pg("initdb", "--pgdata", data, "--auth", "trust", "--no-sync")
    options = f"-p {port} -c listen_addresses=127.0.0.1 -k {place} -c fsync=off"
    log = str(place / "log")
    pg("pg_ctl", "--pgdata", data, "--wait", "--timeout", "300", "-l", log, "-o", options, "start")
    try:
        pg("createdb", "--host", "127.0.0.1", "--port", str(port), "evade")
        yield f"postgresql://postgres@127.0.0.1:{port}/evade"
    finally:
        pg("pg_ctl", "--pgdata", data, "--mode", "immediate", "stop")
        shutil.rmtree(place)


def in_store(folder, uri, seed):
    config = sweep_config(folder, policies=["straight", "oracle"])
    tracking = dataclasses.replace(config.tracking, uri=uri)
    cluster = dataclasses.replace(config.cluster, storage=str(folder / "storage"))
    return dataclasses.replace(config, seed=seed, tracking=tracking, cluster=cluster)


def report(folder, uri, seed):
    """A sweep whose episodes are made up, and everything else is not."""
    # Here, in a process of its own: Ray reads its token once, when it is imported, and another
    # test of this run names one later.
    from jobs.study import study
    from tests.support.fake_executor import FakeExecutor

    study.run(in_store(folder, uri, seed), FakeExecutor())


def test_eight_sweeps_report_at_once_and_all_is_read_back(tmp_path, postgres):
    context = multiprocessing.get_context("fork")
    writers = [context.Process(target=report, args=(tmp_path, postgres, seed)) for seed in range(WRITERS)]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert [writer.exitcode for writer in writers] == [0] * WRITERS
    client, experiment = open_store(postgres, "evade")
    runs = client.search_runs([experiment], max_results=1000)
    assert Counter(run.data.tags["kind"] for run in runs) == {
        "sweep": WRITERS,
        "condition": WRITERS * 5 * 2,
        "group": WRITERS * 2,
    }
    assert {run.info.status for run in runs} == {"FINISHED"}
    parents = Counter(run.data.tags.get("mlflow.parentRunId") for run in runs)
    assert sorted(parents.values()) == [WRITERS] + [12] * WRITERS
    for run in runs:
        if run.data.tags["kind"] == "condition":
            assert run.data.metrics["eval/distance_m"] == 50.0
    (parent,) = [run for run in runs if run.data.tags["kind"] == "sweep" and run.data.params["seed"] == "3"]
    table = client.download_artifacts(parent.info.run_id, "sweep/results.json", str(tmp_path))
    assert len(json.loads(Path(table).read_text())["data"]) == 10
