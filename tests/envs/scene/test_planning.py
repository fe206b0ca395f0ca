import dataclasses
import math

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.config import EnvConfig
from envs.kinematics import Lane, advance, planned_position
from envs.scene import ELLIPSOID, OBSTACLE, Scene, at_velocity, make_scene
from envs.scene.planning import BLOCKED, LATTICE_M, SIDE_PRICE, CostToGo, _costs, cost_to_go, passable_among

RADIUS_M, HEIGHT_M = 0.3, 2.0
SCENES = ("poles_eval", "gates", "shape_change", "dynamic")


def drawn(name, seed=0):
    return make_scene(name, np.random.default_rng([seed, 77]), RADIUS_M, HEIGHT_M)


@pytest.mark.parametrize("name", ["poles_eval", "gates"])
def test_costs_obey_bellmans_equation_at_every_place(name):
    plan = cost_to_go(drawn(name), RADIUS_M, HEIGHT_M)
    rows, columns = plan.costs.shape
    rng = np.random.default_rng(0)
    for row, column in zip(rng.integers(0, rows - 1, 1500), rng.integers(0, columns - 1, 1500), strict=True):
        at = plan.first_x_m + column * LATTICE_M, row * LATTICE_M
        best = plan.prices[row, column] + plan.of_actions(*at).min()
        assert math.isclose(plan.costs[row, column], best, rel_tol=1e-12)
    np.testing.assert_array_equal(plan.costs[-1], plan.prices[-1])


@pytest.mark.parametrize("name", SCENES)
def test_a_place_is_blocked_exactly_where_the_vehicle_is_in_contact_or_nearly(name):
    scene = drawn(name)
    plan = cost_to_go(scene, RADIUS_M, HEIGHT_M)
    rng = np.random.default_rng(0)
    for row, column in zip(rng.integers(0, 401, 200), rng.integers(0, plan.costs.shape[1], 200), strict=True):
        x, y = plan.first_x_m + column * LATTICE_M, row * LATTICE_M
        sizes = (RADIUS_M + 0.5 * LATTICE_M + nudge for nudge in (-1e-9, 1e-9))
        reaches = [scene.collides((x, y), (x, y), size, HEIGHT_M) for size in sizes]
        if reaches[0] == reaches[1]:
            assert (plan.prices[row, column] == BLOCKED) == reaches[0]
            assert plan.prices[row, column] <= 1.0 or reaches[0]


def test_costs_between_places_are_bilinear_and_outside_those_of_the_edge():
    plan = CostToGo(np.random.default_rng(0).uniform(size=(5, 7)), np.zeros((5, 7)), -1.0)

    def cost(x, y):
        return plan.of_actions(x, y - LATTICE_M)[0]

    corners = [cost(x, y) for y in (0.5, 0.75) for x in (-0.5, -0.25)]
    assert corners == [plan.costs[2, 2], plan.costs[2, 3], plan.costs[3, 2], plan.costs[3, 3]]
    inside = cost(-0.5 + 0.3 * LATTICE_M, 0.5 + 0.8 * LATTICE_M)
    assert inside == pytest.approx(np.dot([0.7 * 0.2, 0.3 * 0.2, 0.7 * 0.8, 0.3 * 0.8], corners))
    assert cost(-9.0, 9.0) == plan.costs[4, 0]
    ahead, left, right = plan.of_actions(-0.4, 0.3)
    assert left == pytest.approx(plan.of_actions(-0.65, 0.3)[0] + SIDE_PRICE)
    assert right == pytest.approx(plan.of_actions(-0.15, 0.3)[0] + SIDE_PRICE)
    assert ahead == plan.of_actions(-0.4, 0.3)[0]


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.integers(2, 12), st.integers(2, 12), st.integers(1, 9))
def test_with_limited_sight_costs_are_those_of_a_world_that_ends_there(seed, rows, columns, ahead):
    rng = np.random.default_rng(seed)
    prices = rng.uniform(size=(rows, columns))
    plan = CostToGo(_costs(prices), prices, -1.0)
    for x, y in rng.uniform(-3.0, [0.25 * columns + 3.0, 0.25 * rows + 3.0], (8, 2)):
        next_row = min(int(np.clip(y / LATTICE_M + 1.0, 0, rows - 1)), rows - 2)
        ends = prices[: next_row + ahead + 1]
        expected = CostToGo(_costs(ends), ends, -1.0).of_actions(x, y)
        np.testing.assert_allclose(plan.of_actions(x, y, ahead * LATTICE_M), expected, rtol=1e-12)
        np.testing.assert_array_equal(plan.of_actions(x, y, 1e9), plan.of_actions(x, y))


def flown(scene, seed, random_share, plan=None, sight_m=math.inf, control_hz=50.0):
    """Whether the teacher's cheapest actions lead from a random start to the goal line."""
    plan = plan or cost_to_go(scene, RADIUS_M, HEIGHT_M)
    rng, config = np.random.default_rng(seed), EnvConfig()
    spawn_x, moves = rng.uniform(*scene.spawn_range_m), [0, 0, 0]
    place, lane = (spawn_x, 0.0), Lane(RADIUS_M, 0.5 * scene.width_m, scene.length_m)
    while True:
        action = rng.integers(3) if rng.random() < random_share else plan.of_actions(*place, sight_m).argmin()
        moves[action] += 1
        planned = planned_position(spawn_x, tuple(moves), (config.speed_mps, control_hz))
        told = advance(lane, (scene.sections(HEIGHT_M), np.zeros((0, 9))), (0.0, 1.0), place, planned)
        if told.success or told.collision:
            return told.success
        place = told.end


@pytest.mark.parametrize(
    ("name", "random_share"), [("poles_eval", 0.3), ("gates", 0.3), ("poles_dense", 0.0)]
)
def test_the_cheapest_actions_come_through(name, random_share):
    assert all(flown(drawn(name, seed), seed, random_share) for seed in range(20))


@pytest.mark.parametrize(("control_hz", "flights"), [(25.0, 20), (200.0, 5)])
def test_five_metres_of_sight_suffice_among_dense_poles(control_hz, flights):
    for k in range(flights):
        assert flown(drawn("poles_dense", k), k, 0.0, sight_m=5.0, control_hz=control_hz)


def test_a_row_is_priced_as_it_is_when_the_vehicle_comes_there():
    ball = np.array((ELLIPSOID, -4.0, 20.0, HEIGHT_M, 0.5, 0.5, 0.5, 0.5), OBSTACLE)[()]
    crossing, standing = at_velocity(ball, (4.0, 0.0, 0.0)), at_velocity(ball, (0.0, 0.0, 0.0))
    plan = cost_to_go(Scene("empty", np.empty(0, OBSTACLE)), RADIUS_M, HEIGHT_M)
    now, vehicle = (0.0, 0.0), (RADIUS_M, HEIGHT_M, 10.0)  # there after 2 s, when the ball is at x = 4 m
    row, columns = round(20.0 / LATTICE_M), {x: round((x - plan.first_x_m) / LATTICE_M) for x in (-4, 0, 4)}
    for moving, blocked in ((crossing, 4), (standing, -4)):
        prices = plan.among([moving], now, vehicle).prices[row]
        assert {x for x, column in columns.items() if prices[column] == BLOCKED} == {blocked}
    again = plan.among([crossing], (1.0, 10.0), vehicle)
    np.testing.assert_array_equal(again.costs, plan.among([crossing], now, vehicle).costs)
    assert plan.among([], now, vehicle) is plan
    higher = plan.among([crossing], now, (RADIUS_M, HEIGHT_M + 0.6, 10.0))
    np.testing.assert_array_equal(higher.costs, plan.costs)


def test_a_mesh_blocks_where_its_surfaces_are(tmp_path):
    box = trimesh.creation.box((8.0, 2.0, 6.0))
    box.apply_translation((0.0, 30.0, 3.0))
    box.export(tmp_path / "box.stl")
    scene = make_scene(str(tmp_path / "box.stl"), np.random.default_rng(0))
    plan = cost_to_go(scene, RADIUS_M, HEIGHT_M)
    assert plan.of_actions(0.0, 28.6).min() > BLOCKED
    assert all(flown(scene, seed, 0.3, plan) for seed in range(5))
    left_of, right_of = plan.of_actions(-2.0, 25.75), plan.of_actions(2.0, 25.75)
    assert left_of.argmin() == 1
    assert right_of.argmin() == 2


def test_a_lane_narrower_than_the_vehicle_is_refused():
    with pytest.raises(ValueError, match=r"wider than the vehicle, got 30\.0 m and 15\.0 m"):
        cost_to_go(drawn("poles"), 15.0)


def test_no_place_is_planned_that_the_vehicle_cannot_come_to():
    scene = make_scene("poles", np.random.default_rng(0), RADIUS_M, HEIGHT_M, width_m=10_000.0)
    plan = cost_to_go(scene, RADIUS_M, HEIGHT_M)
    assert plan.costs.shape[1] * LATTICE_M == pytest.approx(2 * (10.0 + scene.length_m), abs=1.0)
    assert math.isfinite(plan.costs.max())


@pytest.mark.parametrize(("leaves_at_mps", "expected"), [(0.0, False), (30.0, True)])
def test_what_has_gone_when_the_vehicle_comes_blocks_no_way(leaves_at_mps, expected):
    """A ball as wide as the lane, 50 m ahead of a vehicle at 10 m/s, stays or flies away upwards."""
    ball = np.array([(ELLIPSOID, 0.0, 50.0, HEIGHT_M, 6.0, 6.0, 6.0, 0.5)], OBSTACLE)[0]
    lane = Scene("lane", np.zeros(0, OBSTACLE), width_m=8.0, spawn_range_m=(-2.0, 2.0))
    moving = dataclasses.replace(lane, moving=(at_velocity(ball, (0.0, 0.0, leaves_at_mps)),))
    assert passable_among(lane, RADIUS_M, HEIGHT_M, 10.0)
    assert passable_among(moving, RADIUS_M, HEIGHT_M, 10.0) is expected
