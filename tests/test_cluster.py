import multiprocessing
import tempfile
import time

from jobs.cluster import one_at_a_time


def start(results, name):
    with one_at_a_time():
        results.put((name, "in"))
        time.sleep(0.3)
        results.put((name, "out"))


def test_two_processes_start_ray_one_after_the_other(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    context = multiprocessing.get_context("fork")
    results = context.Queue()
    processes = [context.Process(target=start, args=(results, name)) for name in "ab"]
    for process in processes:
        process.start()
    order = [results.get(timeout=20) for _ in range(4)]
    for process in processes:
        process.join()
    assert [place for _, place in order] == ["in", "out", "in", "out"]
    assert order[0][0] == order[1][0] != order[2][0] == order[3][0]


def test_a_process_that_dies_lets_go(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    context = multiprocessing.get_context("fork")
    process = context.Process(target=start, args=(context.Queue(), "a"))
    process.start()
    time.sleep(0.1)
    process.kill()
    process.join()
    with one_at_a_time():
        pass
