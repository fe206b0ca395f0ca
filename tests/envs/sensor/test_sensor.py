import math

import numpy as np
import pytest

from envs.config import CameraConfig, EnvConfig, FaultsConfig, FidelityConfig
from envs.corridor import CorridorEnv
from envs.events import EVENT, EventCamera
from envs.kinematics import Outcome
from envs.raycast import RaycastRenderer
from envs.scene import make_scene
from envs.sensor import Sensor
from envs.sensor import sensor as sensing
from tests.support.sensing import step_sensor

SMALL = CameraConfig(width=16, height=12, contrast_threshold=0.002)
BY_FRAMES = CameraConfig(width=16, height=12, contrast_threshold=0.002, refractory_us=1)


def look(seed=0, **fields):
    """A config, a scene with a moving texture, and its sensor, which has seen its first frame."""
    config = EnvConfig(**{"scene": "dynamic", "camera": SMALL} | fields)
    scene = make_scene(config.scene, np.random.default_rng(seed))
    sensor = Sensor(config)
    sensor.reset(scene, (1.0, 5.0), np.random.default_rng(seed))
    return config, scene, sensor


def one_by_one(config, scene, sensor, start, outcome, end_us):
    """Events of one control step from a single render and a single camera step at a time."""
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
        events.append(camera.step(renderer.render(x, y, height, 0.0, t_us * 1e-6), t_us))
    return count, np.concatenate(events)


@pytest.mark.parametrize("together", [1, 3 * 16 * 12, 2**22])
@pytest.mark.parametrize("share", [1.0, 0.37])
def test_a_control_step_is_its_renders_one_by_one(monkeypatch, together, share):
    monkeypatch.setattr(sensing, "MAX_PIXELS_TOGETHER", together)
    config, scene, sensor = look(camera=BY_FRAMES)
    outcome = Outcome((1.0 + 0.05 * share, 5.0 + 0.08 * share), share, 0.0, False, share < 1.0)
    count, events = one_by_one(config, scene, sensor, (1.0, 5.0), outcome, 5000)
    sensor.step((1.0, 5.0), outcome, 5000)
    assert sensor.renders == count > 1
    assert sensor.events.tobytes() == events.tobytes()
    assert events.size > 40
    assert sensor.t_us == 5000
    expected = RaycastRenderer(scene, 16, 12, samples=sensor.plan.samples, cull_m=sensor.plan.cull_m).render(
        *outcome.end, config.camera_height_m, 0.0, round(5000 * share) * 1e-6
    )
    assert np.array_equal(sensor.luminance, expected)


def test_events_lost_to_the_cap_are_counted_over_all_renders_of_a_step():
    capped = CameraConfig(width=16, height=12, contrast_threshold=0.002, max_events_per_pixel=1)
    config, _, free = look(camera=CameraConfig(width=16, height=12, contrast_threshold=0.002))
    _, _, sensor = look(camera=capped)
    outcome = Outcome((1.0, 5.1), 1.0, 0.1, False, False)
    for one in (free, sensor):
        step_sensor(config, one, (1.0, 5.0), outcome, 5000)
    assert free.dropped == 0
    assert sensor.dropped + sensor.events.size == free.events.size
    assert sensor.dropped > 0


def test_a_camera_that_forgets_gets_one_frame_per_control_step():
    for memory in ("frame", "legacy"):
        _, _, sensor = look(camera=CameraConfig(width=16, height=12, memory=memory))
        sensor.step((1.0, 5.0), Outcome((1.0, 5.1), 1.0, 0.1, False, False), 5000)
        assert sensor.renders == 1


def test_a_vehicle_that_cannot_move_sees_nothing_and_renders_nothing():
    config, _, sensor = look()
    before = sensor.luminance
    step_sensor(config, sensor, (1.0, 5.0), Outcome((1.0, 5.0), 0.0, -100.0, False, True), 5000)
    assert sensor.events.size == sensor.renders == 0
    assert sensor.luminance is before
    assert sensor.events.dtype == EVENT


def test_a_renderer_that_gives_no_luminance_is_named_and_stops_the_step(monkeypatch):
    _, _, sensor = look(camera=BY_FRAMES)
    monkeypatch.setattr(
        sensor._renderer, "render_way", lambda poses: np.full((len(poses), 12, 16), np.nan, "f4")
    )
    with pytest.raises(ValueError, match="luminance must be finite"):
        sensor.step((1.0, 5.0), Outcome((1.0, 5.1), 1.0, 0.1, False, False), 5000)


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
    for seed in range(3):
        env = CorridorEnv(camera=SMALL, speed_mps=1e-9)
        window, info = env.reset(seed=seed)
        assert info["num_events"] == info["t_us"] == 0
        assert window[0].tolist() == [0, 0, 5000, 0]
        assert env.step(0)[4]["num_events"] == 0


def test_rendering_in_parts_keeps_the_events_alike_when_the_control_rate_falls():
    def count(hz):
        env = CorridorEnv(layout={"num_obstacles": 40}, control_hz=hz)
        env.reset(seed=3)
        return sum(env.step(0)[4]["num_events"] for _ in range(round(hz / 5)))

    counts = [count(hz) for hz in (10.0, 50.0, 200.0, 400.0)]
    assert min(counts) > 1000
    assert max(counts) / min(counts) < 1.05


def test_faults_work_on_the_events_of_the_whole_step():
    config, _, clean = look()
    _, _, noisy = look(faults=FaultsConfig(event_dropout=1.0))
    for one in (clean, noisy):
        step_sensor(config, one, (1.0, 5.0), Outcome((1.0, 5.1), 1.0, 0.1, False, False), 5000)
    assert clean.events.size > 40
    assert noisy.events.size == 0


def test_the_fidelity_that_is_set_is_the_fidelity_that_is_flown():
    config, _, sensor = look(fidelity=FidelityConfig(max_step_m=0.02, samples=3, cull_m=30.0))
    step_sensor(config, sensor, (1.0, 5.0), Outcome((1.0, 5.1), 1.0, 0.1, False, False), 5000)
    assert sensor.renders == 5
    assert (sensor.plan.samples, sensor.plan.cull_m) == (3, 30.0)
