"""What a soak computes from its samples and its rounds."""

import dataclasses

import pytest

from tests.soak.injections import COMMAND, EITHER, GOES_ON, Fault
from tests.soak.soak import judged
from tests.soak.watch import slope_mb_per_hour
from tests.soak.workload import End, Tables

STOPPED = End(status=1, last_line="evade: failed: no room", traceback=False, by_fault=False)
KILLED = End(status=-9, last_line="Sweep: 3/7", traceback=False, by_fault=True)


def test_the_trend_is_that_within_processes_and_not_between_them():
    def life(begin_s, mb):
        return [(begin_s + t, mb + 30 * t / 3600) for t in range(0, 1200, 5)]

    assert slope_mb_per_hour([life(0, 100), life(1200, 900)]) == pytest.approx(30)
    loaded = [(t, mb + 100 * (t > 1100)) for t, mb in life(0, 100)]
    assert slope_mb_per_hour([loaded]) == pytest.approx(30)
    assert slope_mb_per_hour([life(0, 100)[:20]]) is None
    assert slope_mb_per_hour([life(0, 100)[::239]]) is None  # two samples tell nothing


@pytest.mark.parametrize(
    ("follows", "ends", "seconds", "well"),
    [
        (GOES_ON, [], 3.0, True),
        (GOES_ON, [STOPPED], 3.0, False),
        (EITHER, [STOPPED], 3.0, True),
        (EITHER, [dataclasses.replace(STOPPED, last_line="Killed")], 3.0, False),
        (EITHER, [dataclasses.replace(STOPPED, traceback=True)], 3.0, False),
        (COMMAND, [KILLED], 3.0, True),
        (COMMAND, [KILLED, STOPPED], 3.0, False),
        (COMMAND, [KILLED], None, False),
    ],
)
def test_what_follows_a_fault_is_judged(follows, ends, seconds, well):
    assert judged(Fault("", lambda soak: None, follows), ends, seconds)[1] is well


def test_one_digit_makes_a_table_differ_and_one_byte_a_policy():
    whole = Tables({"table.md": "0.1 "}, {"networks": "a"})
    assert whole.differing(whole) == []
    assert whole.differing(Tables({"table.md": "0.2 "}, {"networks": "a"})) == ["table.md"]
    assert whole.differing(Tables({"table.md": "0.1 "}, {"networks": "b"})) == ["policy"]
