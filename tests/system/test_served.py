import pandas as pd
import pytest

from jobs.tracking.served_policy import control_steps


def test_a_flight_is_cut_at_the_ends_of_its_control_steps():
    events = pd.DataFrame({"t": [1, 5000, 5001, 20000], "x": [1, 2, 3, 4], "y": 0, "p": 1})
    cut = [(list(fields["x"]), start, window) for fields, start, window in control_steps(events, 5000)]
    assert cut == [
        ([], -5000, 5000), ([1, 2], 0, 5000), ([3], 5000, 5000), ([], 10000, 5000), ([4], 15000, 5000)
    ]  # fmt: skip
    assert len(list(control_steps(events[:0], 5000))) == 1


@pytest.mark.parametrize("t", [[0, 1], [2, 1], [-1, 2]])
def test_events_before_the_flight_or_out_of_order_are_refused(t):
    events = pd.DataFrame({"t": t, "x": 0, "y": 0, "p": 1})
    with pytest.raises(ValueError, match="t must begin above 0"):
        list(control_steps(events, 5000))
