import os
import socket
import tempfile
from pathlib import Path

import pytest

from jobs.config.schema import ClusterConfig
from jobs.run import ray_cluster
from jobs.run.ray_sessions import KEPT, forget_sessions, serves


@pytest.fixture
def folder():
    """A private folder whose name leaves room for sockets."""
    with tempfile.TemporaryDirectory(dir="/tmp") as place:
        yield Path(place)


def session(folder, number):
    """A session's folder, with its store's socket listening."""
    path = folder / "ray" / f"session_2026-01-31_00-00-{number:02d}_000000_1"
    (path / "sockets").mkdir(parents=True)
    (path / "logs").mkdir()
    store = socket.socket(socket.AF_UNIX)
    store.bind(str(path / "sockets" / "plasma_store"))
    store.listen()
    return path, store


def test_of_the_sessions_that_have_ended_the_newest_are_kept_and_no_sockets(folder):
    forget_sessions(folder)  # without any
    running, store = session(folder, 0)
    ended = []
    for number in range(1, KEPT + 3):
        path, closed = session(folder, number)
        closed.close()
        ended.append(path)
    (folder / "ray" / "session_latest").symlink_to(ended[-1])
    forget_sessions(folder)
    assert serves(running)
    assert [path.exists() for path in ended] == [False, False, *[True] * KEPT]
    assert [path for path in folder.rglob("*") if path.is_socket()] == [running / "sockets" / "plasma_store"]
    assert all((path / "logs").is_dir() for path in ended[2:])
    store.close()


def test_a_local_ray_that_starts_forgets_those_that_have_ended(folder, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    monkeypatch.setattr(os, "environ", os.environ.copy())
    monkeypatch.setattr(ray_cluster, "compile_kernels", lambda: None)
    monkeypatch.setattr(ray_cluster, "_start_local", lambda settings: None)
    folder = ray_cluster.ray_folder()
    path, closed = session(folder, 1)
    closed.close()
    ray_cluster.start_ray(ClusterConfig(name="local", address=None, num_cpus=1, storage=None), folder)
    assert (path / "logs").is_dir()
    assert not (path / "sockets").exists()
