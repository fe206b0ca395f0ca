import dataclasses
import itertools
import math

import numpy as np
import pytest
from gymnasium.error import ResetNeeded

from envs.config import CameraConfig, EnvConfig, FaultsConfig, FidelityConfig
from envs.corridor import CorridorEnv
from envs.event_error import event_error
from envs.events import EVENT, EventCamera
from envs.events.faults import NO_FAULTS
from envs.kinematics import Outcome, clock_us
from envs.raycast import RaycastRenderer
from envs.raycast.columns import aim, paint_columns
from envs.scene import BOX, CONE, ELLIPSOID, OBSTACLE, POLE, Scene, Texture, make_scene
from envs.sensor import Sensor
from envs.sensor import sensor as sensing
from tests.support.sensing import step_sensor

STEP_M, STEP_US = 0.1, 5000
SMALL = CameraConfig(width=16, height=12, contrast_threshold=0.002)
BY_FRAMES = dataclasses.replace(SMALL, refractory_us=1)


def look(seed=0, **fields):
    """A config, a scene with a moving texture, and its sensor, which has seen its first frame."""
    config = EnvConfig(**{"scene": "dynamic", "camera": SMALL} | fields)
    scene = make_scene(config.scene, np.random.default_rng(seed))
    sensor = Sensor(config)
    sensor.reset(scene, (1.0, 5.0), np.random.default_rng(seed))
    return config, scene, sensor


def one_by_one(config, scene, sensor, start, outcome, end_us):
    """Renders, events and last picture of one control step, rendered and seen one at a time."""
    plan = sensor.plan
    renderer = RaycastRenderer(scene, 16, 12, samples=plan.samples, cull_m=plan.cull_m)
    height = config.camera_height_m
    camera = EventCamera(config.camera)
    camera.reset(renderer.render(*start, height), 0)
    way = outcome.share * config.speed_mps / config.control_hz
    count = max(1, math.ceil(way / plan.max_step_m - 1e-9))
    moving_us, events = round(outcome.share * end_us), []
    for k in range(1, count + 1):
        x, y = (a + (b - a) * k / count for a, b in zip(start, outcome.end, strict=True))
        t_us = moving_us * k // count
        picture = renderer.render(x, y, height, 0.0, t_us * 1e-6)
        events.append(camera.step(picture, t_us))
    return count, np.concatenate(events), picture


@pytest.mark.parametrize(("together", "share"), [(1, 1.0), (3 * 16 * 12, 0.37), (2**22, 0.37)])
def test_a_control_step_is_its_renders_one_by_one(monkeypatch, together, share):
    monkeypatch.setattr(sensing, "MAX_PIXELS_TOGETHER", together)
    config, scene, sensor = look(camera=BY_FRAMES)
    outcome = Outcome((1.0 + 0.05 * share, 5.0 + 0.08 * share), share, 0.0, False, share < 1.0)
    count, events, picture = one_by_one(config, scene, sensor, (1.0, 5.0), outcome, 5000)
    sensor.step((1.0, 5.0), outcome.end, outcome.share, 5000, None)
    assert sensor.renders == count > 1
    assert sensor.events.tobytes() == events.tobytes()
    assert events.size > 40
    assert sensor.t_us == 5000
    assert np.array_equal(sensor.luminance, picture)


def test_events_lost_to_the_cap_are_counted_over_all_renders_of_a_step():
    config, _, free = look()
    _, _, capped = look(camera=dataclasses.replace(SMALL, max_events_per_pixel=1))
    for one in (free, capped):
        step_sensor(config, one, (1.0, 5.0), Outcome((1.0, 5.1), 1.0, 0.1, False, False), 5000)
    assert free.dropped == 0
    assert capped.dropped + capped.events.size == free.events.size
    assert capped.dropped > 0


def test_a_vehicle_that_cannot_move_sees_nothing_and_renders_nothing():
    config, _, sensor = look()
    before = sensor.luminance
    step_sensor(config, sensor, (1.0, 5.0), Outcome((1.0, 5.0), 0.0, -100.0, False, True), 5000)
    assert sensor.events.size == sensor.renders == 0
    assert sensor.luminance is before
    assert sensor.events.dtype == EVENT


def test_the_renderer_stays_while_scenes_ask_for_the_same_and_culls_as_each_asks():
    config, _, sensor = look()
    renderer = sensor._renderer
    sensor.reset(make_scene(config.scene, np.random.default_rng(9)), (0.0, 0.0), np.random.default_rng(0))
    assert sensor._renderer is renderer
    sensor.reset(make_scene("poles", np.random.default_rng(9)), (0.0, 0.0), np.random.default_rng(0))
    assert sensor._renderer is not renderer
    renderer = sensor._renderer
    for last_y_m in (400.0, 90.0):
        scene = make_scene("poles", np.random.default_rng(9), last_y_m=last_y_m)
        sensor.reset(scene, (0.0, 0.0), np.random.default_rng(0))
        assert sensor._renderer is renderer
        assert renderer.cull_m == sensor.plan.cull_m
        assert (renderer.cull_m == math.inf) == (last_y_m == 90.0)
    sensor.close()
    assert sensor._renderer is None


def test_the_first_frame_makes_no_events_and_a_flight_that_hardly_moves_neither():
    env = CorridorEnv(camera=SMALL, speed_mps=1e-9)
    window, info = env.reset(seed=0)
    assert info["num_events"] == info["t_us"] == 0
    assert window[0].tolist() == [0, 0, 5000, 0]
    assert env.step(0)[4]["num_events"] == 0


def test_the_fidelity_that_is_set_is_the_fidelity_that_is_flown():
    config, _, sensor = look(fidelity=FidelityConfig(max_step_m=0.02, samples=3, cull_m=30.0))
    step_sensor(config, sensor, (1.0, 5.0), Outcome((1.0, 5.1), 1.0, 0.1, False, False), 5000)
    assert sensor.renders == 5
    assert (sensor.plan.samples, sensor.plan.cull_m) == (3, 30.0)


def steps_along(config, scene, places, times_us, shares=None):
    """Events and renders of each step from place to place; the events are sorted and within their step."""
    sensor, found, begin_us = Sensor(config), [], 0
    sensor.reset(scene, places[0], np.random.default_rng(0))
    steps = zip(itertools.pairwise(places), times_us, shares or [1.0] * len(times_us), strict=True)
    for (start, end), end_us, share in steps:
        step_sensor(config, sensor, start, Outcome(end, share, 0.0, False, False), end_us)
        events = sensor.events
        assert np.array_equal(np.sort(events, order=("t", "y", "x"), kind="stable"), events)
        assert ((events["t"] > begin_us) & (events["t"] <= end_us)).all()
        found.append((events, sensor.renders))
        begin_us = end_us
    return found


def dense(config, scene, places, times_us, renders, samples=1):
    """Events of the same steps from so many whole images of each."""
    renderer, camera = RaycastRenderer(scene, 64, 64, samples=samples), EventCamera(config.camera)
    known, parts = np.arange(len(places)), np.arange((len(places) - 1) * renders + 1) / renders
    t_us = np.rint(np.interp(parts, known, [0, *times_us])).astype(int)
    poses = np.zeros((parts.size, 5))
    for axis, way in enumerate(np.transpose(places)):
        poses[:, axis] = np.interp(parts, known, way)
    poses[:, 2], poses[:, 4] = config.camera_height_m, 1e-6 * t_us
    frames = renderer.render_way(poses)
    camera.reset(frames[0], 0)
    return camera.steps(frames[1:], t_us[1:].tolist())


@pytest.mark.parametrize("name", ["gates", "dynamic", "spheres"])
@pytest.mark.parametrize("samples", [1, 3])
def test_a_column_painted_alone_is_that_of_the_whole_image(name, samples):
    rng = np.random.default_rng(samples)
    renderer = RaycastRenderer(make_scene(name, rng), 40, 30, samples=samples, discs=name == "spheres")
    for _ in range(8):
        pose = *rng.uniform((-3.0, 0.0, 0.5), (3.0, 80.0, 6.0)), rng.uniform(-0.3, 0.3), rng.uniform(0, 2)
        whole = renderer.render(*pose)
        part = np.full((40, 30), -1.0, np.float32).T  # column after column, as the camera keeps it
        first, last = np.sort(rng.choice(41, 2, replace=False))
        renderer.room.frames[0] = renderer.frame[0]
        aim(renderer.room.frames[0], *pose)
        paint_columns(renderer.bodies, renderer.noise, part, first, last, renderer.cull_m, renderer.room)
        assert part[:, first:last].tobytes() == whole[:, first:last].tobytes()
        assert (np.delete(part, np.s_[first:last], axis=1) == -1.0).all()
        assert not renderer.room.accumulators.any()


@pytest.mark.parametrize("threshold", [0.05, 0.5])
def test_few_renders_with_looks_come_as_close_to_the_truth_as_many_without(threshold):
    scene, camera = make_scene("poles", np.random.default_rng(5)), CameraConfig(contrast_threshold=threshold)
    config = EnvConfig(camera=camera, fidelity=FidelityConfig(max_step_m=STEP_M))
    way = [(0.2, 10.0 + k * STEP_M) for k in range(11)], [k * STEP_US for k in range(1, 11)]
    truth = dense(config, scene, *way, 40)
    events, renders = zip(*steps_along(config, scene, *way), strict=True)
    error = event_error(np.concatenate(events), truth, 0.05 * STEP_US)
    without = event_error(dense(config, scene, *way, 1), truth, 0.05 * STEP_US)
    assert np.mean(renders) < 2.2
    assert error < 0.06  # of one flight; the mean over flights is what is promised
    assert without > 4 * error


SIDEWAYS = (0.5**0.5, 0.5**0.5)
RINGS = {"obstacle_texture": Texture("rings", period_m=1.0, contrast=0.5)}
# What the flights of `envs.event_error`, down the middle of built-in layouts, seldom show.
SELDOM = {
    "beside a wall": ((), {}, (12.0, 10.0), SIDEWAYS, 1.0),
    "a low box": ([(BOX, 0.0, 14.0, 0.75, 2.0, 2.0, 0.75, 0.25)], {}, (0.1, 10.0), (0.0, 1.0), 1.8),
    "past a wide box": ([(BOX, 3.0, 14.0, 1.25, 2.0, 2.0, 1.25, 0.25)], {}, (0.1, 10.0), (0.0, 1.0), 4.0),
    "a low pole": ([(POLE, 0.0, 14.0, 0.5, 1.0, 1.0, 0.5, 0.25)], {}, (0.1, 10.0), (0.0, 1.0), 3.0),
    "a wide cone": ([(CONE, 0.0, 16.0, 1.5, 3.0, 3.0, 1.5, 0.25)], {}, (0.1, 10.0), (0.0, 1.0), 2.0),
    "an ellipsoid": ([(ELLIPSOID, 0.0, 15.0, 0.8, 3.0, 3.0, 0.8, 0.25)], {}, (0.1, 10.0), (0.0, 1.0), 1.8),
    "a pole that leaves": ([(POLE, 1.0, 14.3, 4.0, 0.5, 0.5, 4.0, 0.25)], {}, (0.0, 10.0), (0.0, 1.0), 6.0),
    "rings on a box": ([(BOX, 0.0, 17.0, 4.0, 1.0, 1.0, 4.0, 0.25)], RINGS, (0.1, 10.0), (0.0, 1.0), 4.0),
}


@pytest.mark.parametrize(
    ("name", "hz"), [("a pole that leaves", 10.0), *itertools.product(SELDOM, (25.0, 200.0))]
)
def test_the_tolerance_is_kept_where_flights_seldom_lead(name, hz):
    rows, textures, start, heading, way_m = SELDOM[name]
    scene, config = Scene(name, np.array(list(rows), OBSTACLE), **textures), EnvConfig(control_hz=hz)
    steps = np.arange(max(1, round(way_m * hz / 20.0)) + 1)
    places = np.array(start) + steps[:, None] * (20.0 / hz) * np.array(heading)
    way = list(map(tuple, places.tolist())), [clock_us(k, hz) for k in steps[1:]]
    truth = dense(config, scene, *way, 48, samples=4)
    seen = np.concatenate([events for events, _ in steps_along(config, scene, *way)])
    assert truth.size > 300
    assert event_error(seen, truth, 0.05e6 / hz) <= config.fidelity.tolerance


def test_a_vehicle_that_stopped_within_a_step_sees_later_events_within_later_steps():
    scene, shares = make_scene("poles", np.random.default_rng(5)), (1.0, 0.3, 1.0, 0.0, 1.0)
    places = [(0.2, y) for y in 10.0 + STEP_M * np.cumsum([0.0, *shares])]
    found = steps_along(EnvConfig(), scene, places, range(STEP_US, 6 * STEP_US, STEP_US), shares)
    assert [events.size > 0 for events, _ in found] == [share > 0.0 for share in shares]


@pytest.mark.parametrize("step_us", [1, 7])
def test_steps_of_a_few_microseconds(step_us):
    scene = make_scene("poles_dense", np.random.default_rng(10))
    camera = CameraConfig(contrast_threshold=0.05)
    config = EnvConfig(control_hz=1e6 / step_us, speed_mps=1e5, camera=camera)
    places, times_us = [(0.2, 10.0 + k) for k in range(6)], range(step_us, 6 * step_us, step_us)
    assert all(events.size > 0 for events, _ in steps_along(config, scene, places, times_us))


FAULTS = FaultsConfig(
    **{"shot_noise_hz": 5.0, "leak_hz": 0.1, "hot_pixel_share": 0.01, "hot_pixel_hz": 100.0},
    **{"sparsity": 0.3, "event_dropout": 0.2, "background_activity": 0.1, "background_activity_hz": 3.0},
)


@pytest.mark.parametrize(
    "camera", [{}, {"cutoff_hz": 30.0, "threshold_mismatch": 0.25}, {"refractory_us": 1}]
)
def test_faults_are_the_same_applied_in_the_compiled_step_or_after_it(monkeypatch, camera):
    def events():
        env = CorridorEnv(camera=camera, faults=FAULTS)
        env.reset(seed=1)
        return [(env.step(k % 3), env.events.tobytes(), env.true_events.tobytes())[1:] for k in range(6)]

    together = events()
    assert sum(len(seen) for seen, _ in together) > 0
    assert all(seen != true for seen, true in together)
    monkeypatch.setattr(Sensor, "faults", lambda _: NO_FAULTS)
    monkeypatch.setattr(Sensor, "needs_python", True)
    assert events() == together


def test_more_false_events_than_a_step_may_have_end_an_episode_of_the_compiled_step():
    env = CorridorEnv(EnvConfig(control_hz=0.1, faults=FaultsConfig(background_activity_hz=1e6)))
    env.reset(seed=1)
    with pytest.raises(ValueError, match=r"step 1, seed 1: faults may add 16777216 .*Lower the rates"):
        env.step(0)
    with pytest.raises(ResetNeeded):
        env.step(0)
