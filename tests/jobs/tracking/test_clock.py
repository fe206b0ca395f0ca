import importlib

from jobs.tracking import clock


def test_the_time_runs_on_steadily_when_the_clock_is_set(monkeypatch):
    passed = [100.0]
    with monkeypatch.context() as patch:
        patch.setattr("time.time", lambda: 1_700_000_000.0)
        patch.setattr("time.monotonic", lambda: passed[0])
        importlib.reload(clock)
        assert clock.now_ms() == 1_700_000_000_000
        patch.setattr("time.time", lambda: 0.0)
        passed[0] += 2.5
        assert clock.now_ms() == 1_700_000_002_500
    importlib.reload(clock)
