import multiprocessing
import os
import time

import pytest

from jobs.run.files import RunError
from jobs.run.locks import held_alone, locked, private_folder
from tests.support.patience import HANG_S


def work(folder, results, name):
    with locked(folder / "a.lock"):
        results.put((name, "in"))
        time.sleep(0.3)
        results.put((name, "out"))


def test_processes_hold_a_lock_one_after_the_other(tmp_path):
    context = multiprocessing.get_context("fork")
    results = context.Queue()
    processes = [context.Process(target=work, args=(tmp_path, results, name)) for name in "ab"]
    for process in processes:
        process.start()
    order = [results.get(timeout=HANG_S) for _ in range(4)]
    for process in processes:
        process.join()
    assert [place for _, place in order] == ["in", "out", "in", "out"]
    assert order[0][0] == order[1][0] != order[2][0] == order[3][0]


def test_a_process_that_is_killed_lets_go(tmp_path):
    context = multiprocessing.get_context("fork")
    results = context.Queue()
    process = context.Process(target=work, args=(tmp_path, results, "a"))
    process.start()
    assert results.get(timeout=HANG_S) == ("a", "in")
    process.kill()
    process.join()
    with locked(tmp_path / "a.lock"):
        pass


def test_a_folder_has_one_holder_who_is_named(tmp_path):
    who = rf"process {os.getpid()} of .* works there"
    with held_alone(tmp_path), pytest.raises(RunError, match=who), held_alone(tmp_path):
        pass
    with held_alone(tmp_path):
        pass


def test_a_lock_never_writes_through_a_link(tmp_path):
    (tmp_path / "precious").write_text("content")
    (tmp_path / ".lock").symlink_to(tmp_path / "precious")
    with pytest.raises(OSError, match="symbolic link"), held_alone(tmp_path):
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


def test_a_link_in_place_of_a_lock_of_the_machine_is_not_followed(tmp_path):
    (tmp_path / "precious").write_text("content")
    (tmp_path / "start-ray.lock").symlink_to(tmp_path / "precious")
    with pytest.raises(OSError, match="symbolic link"), locked(tmp_path / "start-ray.lock"):
        pass
    assert (tmp_path / "precious").read_text() == "content"
