"""Bodies that move: their paths, and what is refused."""

import numpy as np
import pytest

from envs.scene import ELLIPSOID, OBSTACLE, MovingBody, Scene, at_velocity
from envs.scene.paths import bodies_at

BALL = np.array((ELLIPSOID, 1.0, 2.0, 3.0, 0.1, 0.1, 0.1, 0.5), OBSTACLE)[()]


def test_a_body_moves_at_its_velocity_in_its_interval_and_rests_outside():
    moving = at_velocity(BALL, (1.0, -2.0, 0.5), begin_s=1.0, end_s=3.0)
    for t_s, moved_s in ((0.0, 0.0), (1.0, 0.0), (1.75, 0.75), (3.0, 2.0), (9.0, 2.0)):
        expected = np.array([1.0, 2.0, 3.0]) + moved_s * np.array([1.0, -2.0, 0.5])
        assert np.allclose(moving.places(np.array([t_s])), expected, atol=1e-12)


def test_a_path_goes_through_its_places_and_repeats():
    t_s, places_m = np.array([1.0, 2.0, 4.0]), np.array([[0, 0, 1], [2, 0, 1], [2, 4, 3.0]])
    once, again = MovingBody(BALL, t_s, places_m), MovingBody(BALL, t_s, places_m, repeats=True)
    assert np.array_equal(once.places(np.array([3.0, 5.0])), [[2.0, 2.0, 2.0], [2.0, 4.0, 3.0]])
    late = np.array([0.5, 5.0])  # the second is 2 s of a period of 3 s
    assert np.array_equal(again.places(late), [[0.0, 0.0, 1.0], [2.0, 0.0, 1.0]])
    (body,) = bodies_at([again], 5.0)
    assert (body["x"], body["y"], body["z"], body["rx"]) == (2.0, 0.0, 1.0, 0.1)


def test_many_bodies_together_are_where_each_is_alone():
    rng = np.random.default_rng(0)
    moving = tuple(
        MovingBody(BALL, np.cumsum(rng.uniform(0.01, 1.0, size)), rng.normal(size=(size, 3)), repeats)
        for size in (1, 2, 3, 40)
        for repeats in (False, True)
    )
    ends = [one.t_s[-1] for one in moving]
    for t_s in (0.0, *ends, *rng.uniform(0.0, 60.0, 50)):
        places = np.stack([bodies_at(moving, t_s)[axis] for axis in "xyz"], axis=1)
        assert places.tobytes() == np.concatenate([one.places(np.array([t_s])) for one in moving]).tobytes()


@pytest.mark.parametrize(
    ("t_s", "places_m", "rule"),
    [
        ([0.0, 0.0], np.zeros((2, 3)), "ascend"),
        ([-1.0, 0.0], np.zeros((2, 3)), ">= 0"),
        ([0.0, 1.0], np.zeros((1, 3)), r"\(K, 3\)"),
        ([0.0], [[np.nan, 0.0, 0.0]], "finite"),
        ([], np.zeros((0, 3)), r"\(K,\)"),
    ],
)
def test_a_wrong_path_is_refused(t_s, places_m, rule):
    with pytest.raises(ValueError, match=rule):
        MovingBody(BALL, np.array(t_s), np.array(places_m))


def test_a_scene_checks_its_moving_bodies_and_names_their_kinds():
    scene = Scene("one", np.empty(0, OBSTACLE), moving=(at_velocity(BALL, (1.0, 0.0, 0.0)),))
    assert scene.kinds == {ELLIPSOID}
    wide = BALL.copy()
    wide["ry"] = 0.2
    with pytest.raises(ValueError, match="rx must equal ry"):
        Scene("one", np.empty(0, OBSTACLE), moving=(at_velocity(wide, (1.0, 0.0, 0.0)),))
    triangle = np.eye(3), np.array([[0, 1, 2]]), np.zeros(3)
    with pytest.raises(ValueError, match="mesh cannot"):
        Scene("one", np.empty(0, OBSTACLE), mesh=triangle, moving=scene.moving)
