import pytest

from jobs.tracking import retry_queue
from jobs.tracking.retry_queue import RetryQueue, StoreUnavailable


class Store:
    """Takes rows unless it is away."""

    def __init__(self):
        self.rows, self.away, self.asked = [], False, 0

    def send(self, row):
        self.asked += 1
        if self.away:
            raise StoreUnavailable("refused")
        self.rows.append(row["step"])


@pytest.fixture
def clock(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(retry_queue.time, "monotonic", lambda: now[0])
    return now


def test_what_a_store_misses_is_delivered_once_and_in_order_when_it_is_back(tmp_path, clock):
    store, box = Store(), RetryQueue(tmp_path / "waiting.jsonl")

    def log(step):
        return box.deliver({"step": step}, store.send)

    assert log(1) is None
    store.away = True
    assert [log(2), log(3)] == ["refused", None]  # said once
    assert store.asked == 2  # 3 was not tried: the store rests
    clock[0] += retry_queue.RETRY_AFTER_S
    assert log(4) is None
    store.away = False
    assert log(5) is None
    assert store.rows == [1]
    clock[0] += retry_queue.RETRY_AFTER_S
    assert log(6) is None
    assert store.rows == [1, 2, 3, 4, 5, 6]
    assert not box.file.exists()


def test_what_waits_outlives_the_process_and_half_a_line(tmp_path, clock):
    store, file = Store(), tmp_path / "waiting.jsonl"
    store.away = True
    box = RetryQueue(file)
    box.deliver({"step": 1}, store.send)
    box.deliver({"step": 2}, store.send)
    with file.open("a") as lines:
        lines.write('{"st')
    store.away = False
    RetryQueue(file).deliver({"step": 3}, store.send)
    assert store.rows == [1, 2, 3]


def test_another_error_than_absence_is_raised(tmp_path):
    def refuse(row):
        raise ValueError("no such metric")

    with pytest.raises(ValueError, match="no such metric"):
        RetryQueue(tmp_path / "waiting.jsonl").deliver({"step": 1}, refuse)
