import pytest

from jobs.run import progress
from jobs.run.progress import clock


@pytest.fixture
def told(monkeypatch):
    """The lines of a job of 1,000 steps, at (time [s], steps since the last)."""

    def of(*reports):
        now, lines = [0.0], []
        monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
        monkeypatch.setattr(progress.console, "print", lines.append)
        with progress.progress("Train", 1000, "steps") as advance:
            for seconds, count in reports:
                now[0] = seconds
                advance(count)
        return lines

    return of


def test_the_speed_leaves_out_what_comes_before_the_first_units(told):
    """A cluster that takes 100 s to start does not make a training of 10 s look like one of hours."""
    lines = told((100.0, 10), (111.0, 110), (122.0, 110))
    assert lines[1] == "Train: 10/1,000 steps"
    assert lines[2] == "Train: 120/1,000 steps · 10/s, 1 min 28 s left"
    assert lines[3] == "Train: 230/1,000 steps · 10/s, 1 min 17 s left"


def test_a_duration_has_two_units_at_most():
    assert [clock(seconds) for seconds in (45.4, 200, 7500)] == ["45 s", "3 min 20 s", "2 h 05 min"]
