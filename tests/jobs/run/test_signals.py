import signal

import pytest

from jobs.run import head_watch
from jobs.run.signals import ENDING, Ended, end_on_signals, keeping_handlers, signal_of


@pytest.fixture(autouse=True)
def handlers():
    before = {number: signal.getsignal(number) for number in ENDING}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", ENDING)
def test_a_signal_ends_a_job_as_ctrl_c_does_and_says_which(number):
    end_on_signals()
    with pytest.raises(KeyboardInterrupt) as error:
        signal.raise_signal(number)
    assert error.value.number == number
    assert str(error.value) == number.name


def test_a_job_under_nohup_goes_on_when_the_terminal_closes():
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    end_on_signals()
    signal.raise_signal(signal.SIGHUP)
    assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN


def test_what_starts_meanwhile_keeps_no_handler():
    end_on_signals()
    with keeping_handlers():
        signal.signal(signal.SIGTERM, lambda number, frame: pytest.fail("Ray's handler"))
    with pytest.raises(Ended):
        signal.raise_signal(signal.SIGTERM)


@pytest.mark.parametrize("number", ENDING)
def test_the_signal_is_known_where_ray_raises_a_plain_interrupt_in_its_place(number, monkeypatch):
    monkeypatch.setattr(head_watch, "head_answers", lambda seconds: True)
    monkeypatch.setattr(head_watch, "ended_process", lambda: "")
    end_on_signals()
    assert signal_of(KeyboardInterrupt()) == signal.SIGINT

    def waiting_in_c():
        try:
            signal.raise_signal(number)
        except Ended:  # not taken for a lost head: Slurm ends Ray's processes together with the job
            raise KeyboardInterrupt from None

    with pytest.raises(KeyboardInterrupt) as error, head_watch.watching_head():
        waiting_in_c()
    assert signal_of(error.value) == number
    end_on_signals()
    assert signal_of(KeyboardInterrupt()) == signal.SIGINT
