import numpy as np
import pytest

from research import stopping
from research.stopping import look_p_values, plans, stopped


def test_a_plan_stops_at_the_first_look_that_is_certain_and_not_before():
    p_values = np.array([[0.5, 0.01, 0.9], [0.5, 0.5, 0.5], [0.01, 0.5, 0.5], [0.5, 0.5, 0.01]])
    found = stopped(p_values, (5, 10, 20), 0.05)
    assert found.decided == 3 / 4
    assert found.episodes == pytest.approx((10 + 20 + 5 + 20) / (4 * 20))
    assert stopped(p_values, (5, 10, 20), 0.001) == (0.0, 1.0)


def test_looks_that_share_their_error_decide_less_and_take_more_than_those_that_do_not(monkeypatch):
    monkeypatch.setattr(stopping, "STUDIES", 60)
    once, naive, shared = plans(4, (5, 10, 14), 0.5, 2.0)
    assert naive.decided >= max(once.decided, shared.decided) > 0.3
    assert naive.episodes <= shared.episodes <= once.episodes == 1.0


def test_groups_that_are_the_same_are_seldom_said_to_differ(monkeypatch):
    monkeypatch.setattr(stopping, "STUDIES", 200)
    p_values = look_p_values(np.random.default_rng(1), 10, (14,), 1.0, 0.0)
    assert p_values.shape == (200, 1)
    assert (p_values < 0.05).mean() < 0.05 + 3 * (0.05 * 0.95 / 200) ** 0.5
