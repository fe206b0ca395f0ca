import contextlib
import multiprocessing
import os
import time

import pytest

from jobs.run.files import RunError
from jobs.run.locks import held_alone, locked, private_folder
from tests.support.patience import HANG_S

FORK = multiprocessing.get_context("fork")


def work(holding, place, results, seconds):
    with holding(place):
        results.put((os.getpid(), "in"))
        time.sleep(seconds)
        results.put((os.getpid(), "out"))


@contextlib.contextmanager
def working(count, *asked):
    """Processes that work in a place, and what they say of it."""
    results = FORK.Queue()
    args = (*asked[:2], results, asked[2])
    processes = [FORK.Process(target=work, args=args, daemon=True) for _ in range(count)]
    for process in processes:
        process.start()
    yield processes, results
    for process in processes:
        process.join()


def test_processes_hold_a_lock_one_after_the_other(tmp_path):
    with working(2, locked, tmp_path / "a.lock", 0.1) as (_, results):
        order = [results.get(timeout=HANG_S) for _ in range(4)]
    assert [place for _, place in order] == ["in", "out", "in", "out"]
    assert order[0][0] == order[1][0] != order[2][0] == order[3][0]


def test_a_folder_has_one_holder_who_is_named_and_lets_go_when_it_is_killed(tmp_path):
    with working(1, held_alone, tmp_path, HANG_S) as ((process,), results):
        results.get(timeout=HANG_S)
        who = rf"process {process.pid} of .* works there; wait until"
        with pytest.raises(RunError, match=who), held_alone(tmp_path):
            pass
        process.kill()
    for _ in range(2):
        with held_alone(tmp_path):
            pass


@pytest.mark.parametrize(
    ("name", "holding"),
    [(".lock", lambda folder: held_alone(folder)), ("a.lock", lambda folder: locked(folder / "a.lock"))],
)
def test_a_lock_never_writes_through_a_link(tmp_path, name, holding):
    (tmp_path / "precious").write_text("content")
    (tmp_path / name).symlink_to(tmp_path / "precious")
    with pytest.raises(OSError, match="symbolic link"), holding(tmp_path):
        pass
    assert (tmp_path / "precious").read_text() == "content"


def test_locks_of_a_machine_lie_in_a_folder_that_nobody_else_can_enter(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    folder = private_folder()
    assert folder.parent == tmp_path
    assert folder.stat().st_mode & 0o777 == 0o700
    folder.chmod(0o755)
    with pytest.raises(RunError, match=r"its owner alone.* got mode 0755"):
        private_folder()


@pytest.mark.parametrize("target", ["of-another", "file", "missing"])
def test_a_link_in_place_of_the_private_folder_is_not_followed(tmp_path, monkeypatch, target):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    (tmp_path / "of-another").mkdir(mode=0o700)
    (tmp_path / "file").write_text("content")
    (tmp_path / f"evade-{os.getuid()}").symlink_to(tmp_path / target)
    with pytest.raises(RunError, match="its owner alone"):
        private_folder()
    assert list((tmp_path / "of-another").iterdir()) == []
    assert (tmp_path / "file").read_text() == "content"
    assert not (tmp_path / "missing").exists()
