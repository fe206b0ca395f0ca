import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.scene import BOX, CONE, ELLIPSOID, OBSTACLE, POLE, Scene, make_scene
from envs.scene.collision import CELL_M, first_contact, ways_to_goal
from envs.scene.obstacles import edge_sections

metres = st.floats(-20.0, 20.0)


def scene_of(*bodies: tuple, **fields) -> Scene:
    """Bodies (kind, x, y, rx, ry), 8 m high, on the ground."""
    rows = [(kind, x, y, 4.0, rx, ry, 4.0, 0.25) for kind, x, y, rx, ry in bodies]
    return Scene("hand", np.array(rows, OBSTACLE), **fields)


def pole(x=0.0, y=10.0, radius=0.5):
    return (POLE, x, y, radius, radius)


def distances(sections: np.ndarray, points: np.ndarray) -> np.ndarray:
    """From each point (N, 2) to the nearest section, 0 inside; by closest points, not by frames."""
    nearest = np.full(len(points), np.inf)
    for x, y, ux, uy, hx, hy, r in sections:
        along, across = np.array([ux, uy]), np.array([-uy, ux])
        offset = points - (x, y)
        closest = np.clip(offset @ along, -hx, hx)[:, None] * along
        closest = closest + np.clip(offset @ across, -hy, hy)[:, None] * across
        nearest = np.minimum(nearest, np.maximum(np.linalg.norm(offset - closest, axis=1) - r, 0.0))
    return nearest


def section(x, y, angle, hx, hy, r):
    return (x, y, math.cos(angle), math.sin(angle), hx, hy, r)


sections = st.builds(
    section,
    metres,
    metres,
    st.floats(-math.pi, math.pi),
    st.one_of(st.just(0.0), st.floats(0.01, 5.0)),
    st.one_of(st.just(0.0), st.floats(0.01, 5.0)),
    st.one_of(st.just(0.0), st.floats(0.01, 3.0)),
)


@settings(max_examples=100)
@given(
    rows=st.lists(sections, max_size=4),
    a=st.tuples(metres, metres),
    b=st.tuples(metres, metres),
    radius=st.floats(0.0, 2.0),
    share=st.sampled_from([1.0, 0.1, 0.01]),
)
def test_first_contact_agrees_with_dense_samples_of_the_segment(rows, a, b, radius, share):
    rows = np.array(rows).reshape(-1, 7)
    b = tuple(np.add(a, np.multiply(share, np.subtract(b, a))))
    contact = first_contact((*a, *b), radius, 15.0, rows)
    fractions = np.linspace(0.0, 1.0, 2001)
    points = np.asarray(a) + fractions[:, None] * (np.asarray(b) - np.asarray(a))
    room = np.minimum(distances(rows, points), 15.0 - np.abs(points[:, 0])) - radius
    assert contact == math.inf or 0.0 <= contact <= 1.0
    assert (room[fractions < contact] > -1e-9).all()
    if contact <= 1.0:
        at = np.asarray([a]) + contact * (np.asarray([b]) - np.asarray(a))
        assert min(distances(rows, at)[0], 15.0 - abs(at[0, 0])) <= radius + 1e-9


@settings(max_examples=100)
@given(
    angle=st.floats(-math.pi, math.pi),
    length=st.floats(-9.0, 6.0).map(lambda exponent: 10.0**exponent),
    before=st.floats(0.0, 1.0),
    kind=st.sampled_from([POLE, BOX]),
)
def test_contact_is_exact_from_a_nanometre_to_a_thousand_kilometres(angle, length, before, kind):
    # Head-on, from outside: contact is the gap that is left, as a fraction of the way.
    scene = scene_of((kind, 0.0, 0.0, 0.5, 0.5), width_m=1e9)
    gap = length * before
    ahead = np.array([math.cos(angle), math.sin(angle)])
    if kind == BOX:  # straight onto a side
        ahead = np.array([math.copysign(1.0, ahead[0]), 0.0])
    a = -(0.8 + gap) * ahead
    contact = scene.first_contact(a, a + length * ahead, 0.3)
    # Coordinates near 1 m, or near the length, carry rounding of that size themselves.
    assert contact == pytest.approx(before, abs=1e-15 * max(1.0, length) * 8 / length, rel=1e-9) or (
        contact == math.inf and before > 1.0 - 1e-14 * max(1.0, length) / length
    )


def test_touching_counts_and_a_miss_by_little_does_not():
    scene = scene_of(pole())
    assert scene.first_contact((1.0, 0.0), (1.0, 20.0), 0.5) == pytest.approx(0.5)
    assert scene.first_contact((1.0 + 1e-12, 0.0), (1.0 + 1e-12, 20.0), 0.5) == math.inf
    assert scene.first_contact((0.0, 9.0), (0.0, 8.0), 0.5) == 0.0
    assert scene.first_contact((0.0, 10.0), (0.0, 10.0), 0.0) == 0.0
    assert scene.first_contact((0.0, 0.0), (14.5, 0.0), 0.5) == 1.0
    assert scene.first_contact((0.0, 0.0), (14.5 - 1e-12, 0.0), 0.5) == math.inf
    assert scene.first_contact((0.0, 0.0), (-29.0, 0.0), 0.5) == pytest.approx(0.5)
    assert scene.first_contact((5.0, 0.0), (5.0, 0.0), 0.5) == math.inf
    assert scene.first_contact((14.5, 0.0), (0.0, 0.0), 0.5) == 0.0
    box = scene_of((BOX, 0.0, 10.0, 2.0, 1.0))
    assert box.first_contact((2.5, 0.0), (2.5, 20.0), 0.5) == pytest.approx(0.45)
    assert box.first_contact((2.5 + 1e-12, 0.0), (2.5 + 1e-12, 20.0), 0.5) == math.inf


def test_a_diagonal_way_grazes_the_corners_of_a_box():
    scene = scene_of((BOX, 0.0, 0.0, 2.0, 1.0))
    corner = math.sqrt(0.5) * 0.5
    x, y = 2.0 + corner, 1.0 + corner  # on the disc around the corner, whose tangent is a diagonal
    signs, cases = (1.0, -1.0), ((1e-9, False), (-1e-9, True))
    for right, ahead, (past, hit) in itertools.product(signs, signs, cases):
        start, end = (right * (x + 3 + past), ahead * (y - 3)), (right * (x - 3 + past), ahead * (y + 3))
        assert scene.collides(start, end, 0.5) is hit


def test_a_vehicle_of_no_size_is_stopped_by_an_edge_of_no_width():
    fence = edge_sections(np.array([[-1.0, 5.0]]), np.array([[1.0, 7.0]]))
    assert first_contact((0.0, 0.0, 0.0, 12.0), 0.0, 15.0, fence) == pytest.approx(0.5)
    assert first_contact((2.0, 0.0, 2.0, 12.0), 0.0, 15.0, fence) == math.inf
    along = edge_sections(np.array([[0.0, 5.0]]), np.array([[0.0, 7.0]]))
    assert first_contact((0.0, 0.0, 0.0, 10.0), 0.0, 15.0, along) == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("kind", "radius_at"),
    [
        (POLE, lambda up: 0.5),
        (CONE, lambda up: 0.5 * (1 - up / 8)),
        (ELLIPSOID, lambda up: 0.5 * math.sqrt(1 - ((up - 4) / 4) ** 2)),
    ],
)
def test_contact_is_with_what_stands_at_the_height_of_the_flight_and_above_all_with_walls_alone(
    kind, radius_at
):
    scene = scene_of((kind, 0.0, 10.0, 0.5, 0.5))
    for height in (0.0, 2.0, 7.9, 8.0):
        expected = (10.0 - radius_at(height) - 0.3) / 20.0
        assert scene.first_contact((0.0, 0.0), (0.0, 20.0), 0.3, height) == pytest.approx(expected)
    for height in (math.nextafter(8.0, 9.0), -1.0):
        assert scene.first_contact((0.0, 0.0), (0.0, 20.0), 0.3, height) == math.inf
        assert scene.first_contact((0.0, 0.0), (20.0, 0.0), 0.3, height) == pytest.approx(14.7 / 20.0)


@pytest.mark.parametrize("name", ["poles", "gates"])
def test_a_step_without_contact_never_ends_where_the_next_begins_in_contact(name):
    scene = make_scene(name, np.random.default_rng(1))
    rng = np.random.default_rng(2)
    for _ in range(2000):
        x, y, _, _, hx, hy, r = scene.sections(2.0)[rng.integers(len(scene.sections(2.0)))]
        angle = rng.uniform(0, 2 * np.pi)
        reach = r + 0.3
        corner = np.array([hx * np.sign(np.cos(angle)), hy * np.sign(np.sin(angle))])
        end = (x, y) + corner + reach * np.array([np.cos(angle), np.sin(angle)])
        if rng.random() < 0.5:  # beside a side instead of around a corner
            end = (x, y) + rng.choice([-1, 1]) * np.array([hx + reach, hy * rng.uniform(-1, 1)])
        start = end + 10.0 ** rng.uniform(-3, 1) * rng.uniform(-1, 1, 2)
        if scene.first_contact(end, end, 0.3) == 0.0:
            assert scene.collides(start, end, 0.3)


def test_a_step_never_ends_unnoticed_in_contact_with_a_side_of_a_box():
    # Ends beside the side to within rounding: what a step misses there, the next starts in.
    rng, count = np.random.default_rng(0), 60_000
    hx, hy, radius = rng.uniform(0.1, 2, count), rng.uniform(0.1, 2, count), rng.uniform(0, 1, count)
    end_x = (hx + radius) * (1 + rng.integers(-2, 3, count) * 2.0**-53)
    end_y = hy * rng.uniform(-1, 1, count)
    way = 10.0 ** rng.uniform(-3, 1, count)
    start_x, start_y = end_x + way * rng.uniform(0, 1, count), end_y + way * rng.uniform(-1, 1, count)
    box, contacts = np.array([[0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0]]), 0
    for i in range(count):
        box[0, 4:6] = hx[i], hy[i]
        if first_contact((end_x[i], end_y[i], end_x[i], end_y[i]), radius[i], 50.0, box) == 0.0:
            contacts += 1
            assert first_contact((start_x[i], start_y[i], end_x[i], end_y[i]), radius[i], 50.0, box) <= 1.0
    assert contacts > 0.3 * count


def lattice_way(leads: np.ndarray, start: int, rng: np.random.Generator) -> np.ndarray:
    """A random way of the lattice from row 0 to the goal, x and y in metres."""
    middle, column = (leads.shape[1] - 1) // 2, start
    columns = [column]
    for row in range(1, len(leads)):
        column = rng.choice([c for c in (column - 1, column, column + 1) if leads[row, c]])
        columns.append(column)
    return np.stack([(np.array(columns) - middle) * CELL_M, np.arange(len(leads)) * CELL_M], axis=1)


@pytest.mark.parametrize("name", ["poles_dense", "gates"])
def test_a_way_that_is_promised_touches_nothing_also_half_a_cell_beside_it(name):
    rng = np.random.default_rng(0)
    scene = make_scene(name, rng)
    leads = scene.ways_to_goal(0.3)
    for start in rng.choice(np.flatnonzero(leads[0]), 5):
        way = lattice_way(leads, start, rng)
        way[:, 0] += rng.choice([-0.5, 0.0, 0.5]) * CELL_M
        assert not any(scene.collides(a, b, 0.3) for a, b in itertools.pairwise(way))
        assert way[-1, 1] >= scene.length_m


def search(scene: Scene, radius: float, step: float, starts: np.ndarray) -> np.ndarray:
    """Forward search over exact moves of a finer lattice: which starts reach the goal."""
    rows = math.ceil(scene.length_m / step)
    found = []
    for start in starts:
        front = set() if scene.collides((start, 0.0), (start, 0.0), radius) else {0}
        for row in range(rows):
            front = {
                k + move
                for k in front
                for move in (-1, 0, 1)
                if not scene.collides(
                    (start + k * step, row * step), (start + (k + move) * step, (row + 1) * step), radius
                )
            }
        found.append(bool(front))
    return np.array(found)


def test_the_lattice_agrees_with_an_exact_search():
    starts, promises = np.array([-1.03, 0.0, 0.77]), []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        kinds, radii = rng.choice([POLE, BOX, CONE, ELLIPSOID], 20), rng.uniform(0.2, 0.7, 20)
        places = rng.uniform((-3, 1), (3, 9), (20, 2))
        bodies = [(k, *place, r, r) for k, place, r in zip(kinds, places, radii, strict=True)]
        scene = scene_of(*bodies, width_m=6.0, length_m=10.0)
        leads = scene.ways_to_goal(0.2)
        cells = np.rint(starts / CELL_M)
        promised = leads[0, cells.astype(int) + (leads.shape[1] - 1) // 2]
        # Each promised way exists, and each way with 1.5 cells to spare is promised.
        assert (search(scene, 0.2, 0.05, starts) >= promised).all()
        assert (promised >= search(scene, 0.2 + 1.5 * CELL_M, CELL_M, cells * CELL_M)).all()
        promises.append(promised.mean())
    assert 0.2 < np.mean(promises) < 0.8


@pytest.mark.parametrize(("x", "passable"), [(11.2, True), (11.05, False), (-11.05, False)])
def test_every_start_counts_to_the_very_ends_of_the_range(x, passable):
    scene = scene_of((BOX, x, 0.0, 0.7, 0.5))  # starts end at 10 m; 0.3 m and a cell must be free
    assert scene.passable(0.3) is passable
    assert scene_of(width_m=20.9).passable(0.3)
    assert not scene_of(width_m=20.5).passable(0.3), "a lane narrower than its starts"


@settings(max_examples=60)
@given(row=sections, radius=st.floats(0.0, 1.0))
def test_places_are_closed_by_their_distance_to_a_section(row, radius):
    row = np.array([row]) + np.array([0, 5.0, 0, 0, 0, 0, 0])
    closed = ~ways_to_goal(row, radius, 100.0, 0.0, 80)[0]
    points = np.stack([(np.arange(len(closed)) - 81) * CELL_M, np.zeros(len(closed))], axis=1)
    gaps = distances(row, points) - (radius + CELL_M)
    inner = slice(1, -1)
    assert closed[inner][gaps[inner] < -1e-9].all()
    assert not closed[inner][gaps[inner] > 1e-9].any()


def test_far_away_bodies_are_no_obstacle_to_the_lattice():
    scene = scene_of(pole(1e300, 0.0), pole(0.0, -1e300), pole(3.0, 1e18, 5.0))
    assert scene.passable(0.3)
