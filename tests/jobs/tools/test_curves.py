import numpy as np
import pytest

from jobs.analysis.plots import Curve
from jobs.tools.curves import mean_success


def a_curve(env_steps, success_rate):
    steps, success = np.array(env_steps, float), np.array(success_rate, float)
    return Curve("a", 0, steps, success, np.zeros(len(steps)))


def test_the_mean_success_of_a_line_from_0_is_half_of_its_end_and_earlier_learning_has_more():
    assert mean_success(a_curve([50, 100], [0.4, 0.8]), 100) == pytest.approx(0.4)
    assert mean_success(a_curve([200], [0.8]), 100) == pytest.approx(0.2)  # as far as was asked
    early, late = a_curve([10, 100], [0.8, 0.8]), a_curve([90, 100], [0.0, 0.8])
    assert mean_success(early, 100) > 0.7 > 0.1 > mean_success(late, 100)


def test_more_points_on_the_same_line_change_nothing():
    few, many = a_curve([40, 120], [0.2, 0.6]), a_curve([10, 40, 60, 100, 120], [0.05, 0.2, 0.3, 0.5, 0.6])
    assert mean_success(few, 100) == pytest.approx(mean_success(many, 100))


def test_a_curve_that_ends_before_is_refused():
    with pytest.raises(ValueError, match=r"must reach 101 environment steps, got 100 for a with seed 0"):
        mean_success(a_curve([50, 100], [0.4, 0.8]), 101)


def test_the_steps_of_an_encoder_come_before_those_of_its_policy():
    curve = a_curve([50, 100, 200], [0.4, 0.8, 0.8])
    assert mean_success(curve, 100, 0) == mean_success(curve, 100)
    assert mean_success(curve, 150, 50) == pytest.approx(mean_success(curve, 100) * 100 / 150)
    assert mean_success(curve, 100, 100) == 0.0
    with pytest.raises(ValueError, match="must reach"):
        mean_success(curve, 301, 100)
