"""Laws of bodies that move: their events and contacts, balls that are thrown, a planner that knows."""

import numpy as np
import pytest

from envs.config import CameraConfig, EnvConfig
from envs.corridor import CorridorEnv
from envs.event_error import event_error
from envs.fidelity import choose_renderer
from envs.raycast import RaycastRenderer
from envs.raycast.silhouettes import Way
from envs.scene import BOX, CONE, ELLIPSOID, OBSTACLE, POLE, Scene, at_velocity
from envs.scene.collision import first_moving_contact
from envs.scene.paths import moving_sections
from envs.sensor import Sensor, sense_way
from envs.vehicles.planning import Planner

STEP_US, SPEED_MPS = 10_000, 10.0
CAMERA = CameraConfig(luminance_floor=1e-3)
NOTHING = np.empty(0, OBSTACLE)
WALLS = {"walls_y_m": (-1e6, 1e6)}  # whose ends are out of sight
BODIES = np.array(
    [
        (POLE, 1.0, 8.0, 4.0, 0.5, 0.5, 4.0, 0.2),
        (CONE, -3.0, 12.0, 3.0, 0.8, 0.8, 3.0, 0.3),
        (ELLIPSOID, 4.0, 9.0, 2.5, 0.6, 0.6, 0.6, 0.1),
        (BOX, -1.5, 6.0, 1.0, 0.4, 0.7, 1.0, 0.4),
    ],
    OBSTACLE,
)
BALLS = {
    "vehicle": "point_mass", "body": {"primitives": 15}, "control_hz": 100.0, "observation": "none",
    "layout": {"num_obstacles": 0, "throw_every_s": 1.0, "throw_min_mps": 8.0},
    "speed_mps": 10.0, "split": "eval", "time_limit_s": 20.0,
}  # fmt: skip


def seen(scene, velocity_mps, steps=8):
    """Events of a camera that flies at a velocity (x, y) for some steps, by the compiled look."""
    config = EnvConfig(speed_mps=SPEED_MPS, control_hz=1e6 / STEP_US, camera=CAMERA)
    sensor = Sensor(config)
    sensor.reset(scene, (0.0, 0.0), np.random.default_rng(0))
    view, found = sensor.view(), []
    for step in range(steps):
        begin_s, end_s = 1e-6 * STEP_US * step, 1e-6 * STEP_US * (step + 1)
        sensor.move_bodies(scene.movers, begin_s, end_s)
        start = [velocity * begin_s for velocity in velocity_mps]
        end = [velocity * end_s for velocity in velocity_mps]
        bad, _, _, events = sense_way(view, Way(*start, *end, 2.0, STEP_US * step, STEP_US), 2)
        assert bad == -1
        found.append(events)
    return np.concatenate(found)


def test_bodies_that_come_nearer_give_the_events_of_a_camera_that_flies_towards_them():
    flown = seen(Scene("one", BODIES, **WALLS), (0.0, SPEED_MPS))
    moving = tuple(at_velocity(body, (0.0, -SPEED_MPS, 0.0)) for body in BODIES)
    rested = seen(Scene("one", NOTHING, moving=moving, **WALLS), (0.0, 0.0))
    assert flown.size > 200
    assert event_error(flown, rested, 2.0) < 0.01  # the same but for rounding


def test_bodies_that_rest_give_the_bytes_of_obstacles():
    resting = tuple(at_velocity(body, (0.0, 0.0, 0.0)) for body in BODIES)
    still, rest = Scene("one", BODIES, **WALLS), Scene("one", NOTHING, moving=resting, **WALLS)
    assert np.array_equal(seen(still, (0.5, SPEED_MPS)), seen(rest, (0.5, SPEED_MPS)))


def test_a_picture_shows_bodies_where_they_are_then():
    moving = tuple(at_velocity(body, (0.5, -2.0, 0.4), end_s=10.0) for body in BODIES)
    renderer = RaycastRenderer(Scene("one", NOTHING, moving=moving), 64, 48)
    later = BODIES.copy()
    later["x"] += 0.75
    later["y"] -= 3.0
    later["z"] += 0.6
    expected = RaycastRenderer(Scene("one", later), 64, 48).render(0.0, 0.0, 2.0)
    assert np.abs(renderer.render(0.0, 0.0, 2.0, t_s=1.5) - expected).max() < 1e-6
    with pytest.raises(ValueError, match="cannot draw bodies that move"):
        choose_renderer("pyrender", Scene("one", NOTHING, moving=moving))


def test_contact_is_where_a_fine_search_finds_it():
    rng, shares = np.random.default_rng(2), np.linspace(0.0, 1.0, 20_001)
    hits = 0
    for _ in range(80):
        ax, ay, bx, by, x, y = rng.uniform(-3.0, 3.0, 6)
        section = np.array([[x, y, 1.0, 0.0, 0.0, 0.0, 0.4, *rng.uniform(-4.0, 4.0, 2)]])
        found = first_moving_contact((ax, ay, bx, by), 0.3, section, (0.25, 1.0))
        own = np.stack([ax + (bx - ax) * shares, ay + (by - ay) * shares])
        passed = 0.25 + 0.75 * shares
        other = np.stack([x + section[0, 7] * passed, y + section[0, 8] * passed])
        touching = np.hypot(*(own - other)) <= 0.7
        if touching.any():
            hits += 1
            assert found == pytest.approx(shares[touching.argmax()], abs=1e-4)
        else:
            assert found > 1.0 or np.hypot(*(own - other)).min() < 0.7 + 1e-4
    assert 12 < hits < 68


def test_sections_are_those_at_the_height_of_the_vehicle():
    found, moving = np.zeros((2, 9)), tuple(at_velocity(body, (1.0, 2.0, 0.0)) for body in BODIES[[2, 3]])
    moving_sections(moving, 1.0, 1.5, 2.2, found)
    assert found[0, [0, 1, 7, 8]] == pytest.approx([5.0, 11.0, 0.5, 1.0])
    assert found[0, 6] == pytest.approx(np.sqrt(0.6**2 - 0.3**2))
    assert found[1, 0] == 1e9  # the box ends at 2 m


def flown(seed, choose, **settings):
    env = CorridorEnv(**{**BALLS, **settings})
    env.reset(seed=seed)
    while True:
        _, _, terminated, truncated, info = env.step(choose(env))
        if terminated or truncated:
            return info


@pytest.mark.parametrize("vehicle", [{}, {"vehicle": "kinematic", "body": {}, "observation": "window"}])
def test_a_thrown_ball_hits_who_flies_straight_on(vehicle):
    for seed in range(3):
        env = CorridorEnv(**BALLS | vehicle)
        env.reset(seed=seed)
        first = env.scene.throws.throws[0]
        info = flown(seed, lambda env: env.dynamics.straight, **vehicle)
        assert info["collision"]
        due_s = first.t_s + (env.scene.throws.distance_m - 0.4) / first.speed_mps
        assert 1e-6 * info["t_us"] == pytest.approx(due_s, abs=0.021)


@pytest.mark.system
@pytest.mark.parametrize(
    "layout",
    [
        {"throw_every_s": 1.0, "throw_min_mps": 4.0},
        pytest.param({"num_moving": 60, "width_m": 50.0}, marks=pytest.mark.slow),
    ],
)
def test_a_planner_that_knows_dodges(layout):
    def choose(env):
        return int(planner.costs(env).argmin())

    dodged = 0
    for seed in range(6):
        planner = Planner()
        dodged += flown(seed, choose, layout={"num_obstacles": 0, **layout})["success"]
    straight = [
        flown(seed, lambda env: env.dynamics.straight, layout={"num_obstacles": 0, **layout})
        for seed in range(6)
    ]
    assert sum(info["success"] for info in straight) <= 3 < dodged


def test_settings_that_do_not_fit_are_refused():
    for layout, rule in (
        ({"throw_every_s": 0.05}, "throw_every_s must be 0 or"),
        ({"throw_radius_m": 6.0}, "throw_radius_m must be > 0 and < throw_distance_m"),
        ({"num_moving": 0.5}, "num_moving must be a whole number"),
    ):
        env = CorridorEnv(layout=layout)
        with pytest.raises(ValueError, match=rule):
            env.reset(seed=0)
