import dataclasses
import math

import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_env_sb3

from envs.config import CameraConfig, EnvConfig, FaultsConfig, FidelityConfig, seen_settings
from envs.corridor import CorridorEnv
from envs.events import unpack_window
from envs.kinematics import Lane, advance, clock_us
from envs.scene import OBSTACLE, POLE, Scene

SMALL = CameraConfig(width=16, height=16)
EMPTY = {"layout": {"num_obstacles": 0}, "camera": SMALL}
FAULTY = FaultsConfig(sparsity=0.3, background_activity=0.2, background_activity_hz=50.0)


def move(poles, start, planned, radius_m):
    """One control step of a vehicle at a height of 2 m among poles (x, y, radius)."""
    obstacles = np.array([(POLE, x, y, 3.0, r, r, 3.0, 0.5) for x, y, r in poles], OBSTACLE)
    scene = Scene("test", obstacles)
    bodies, lane = (scene.sections(2.0), np.zeros((0, 9))), Lane(radius_m, 15.0, scene.length_m)
    return advance(lane, bodies, (0.0, 1.0), start, planned)


def straight(env, seed=0):
    """Fly forward to the end; all results of step."""
    env.reset(seed=seed)
    results = [env.step(0)]
    while not (results[-1][2] or results[-1][3]):
        results.append(env.step(0))
    return results


def flight_bytes(env, seed, actions):
    """All that a vehicle gives, as bytes."""
    observation, info = env.reset(seed=seed)
    seen = [observation.tobytes(), repr(info)]
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        seen += [observation.tobytes(), repr((reward, terminated, truncated, info)), env.events.tobytes()]
    return seen


@pytest.mark.parametrize("observation", ["window", "event_image", "luminance", "events", "none"])
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_the_environment_passes_the_checkers(observation):
    env = CorridorEnv(**EMPTY, observation=observation, window_capacity=64, render_mode="rgb_array")
    check_env(env)
    check_env_sb3(env)


@pytest.mark.parametrize("control_hz", [37.3, 200.0, 400.0])
def test_a_straight_success_returns_200_at_any_rate(control_hz):
    results = straight(CorridorEnv(**EMPTY, control_hz=control_hz, fidelity=FidelityConfig(max_step_m=10.0)))
    assert abs(sum(r[1] for r in results) - 200.0) < 1e-9
    assert [r[2] for r in results[-2:]] == [False, True]
    info = results[-1][4]
    assert info["success"]
    assert not info["collision"]
    assert info["distance_m"] == info["y_m"] == 100.0
    assert len(results) == math.ceil(5.0 * control_hz)


def test_a_collision_returns_the_metres_to_the_contact_less_100():
    env = CorridorEnv(**EMPTY | {"layout": {"num_obstacles": 60}})
    for seed in range(20):
        results = straight(env, seed)
        info = results[-1][4]
        expected = info["y_m"] + (100.0 if info["success"] else -100.0)
        assert abs(sum(r[1] for r in results) - expected) < 1e-9
        assert info["success"] is not info["collision"]
        if info["collision"]:
            here = info["x_m"], info["y_m"]
            gaps = [math.dist((pole["x"], pole["y"]), here) - pole["rx"] for pole in env.scene.obstacles]
            assert min(gaps) == pytest.approx(0.3, abs=1e-6)
            return
    pytest.fail("no vehicle met a pole")


@pytest.mark.parametrize("action", [1, 2])
def test_a_flight_to_the_side_ends_at_the_wall(action):
    env = CorridorEnv(**EMPTY, time_limit_s=100.0)
    _, info = env.reset(seed=0)
    steps, spawn_x = 0, info["x_m"]
    while not info["collision"]:
        info = env.step(action)[4]
        steps += 1
    assert abs(info["x_m"]) == pytest.approx(15.0 - 0.3, abs=1e-9)
    assert info["y_m"] == pytest.approx(abs(info["x_m"] - spawn_x), abs=1e-9)
    assert steps == math.ceil(info["y_m"] * math.sqrt(2) / 0.1 - 1e-9)


@pytest.mark.parametrize(
    ("pole_y", "success", "reward", "end_y"),
    [
        (50.0, False, 50.0 - 2.0 - 100.0, 48.0),  # pole before the goal line
        (102.0, False, 0.0, 100.0),  # touched exactly on the line: a collision
        (102.5, True, 200.0, 100.0),  # behind the line: never reached
    ],
)
def test_what_comes_first_along_a_step_ends_it(pole_y, success, reward, end_y):
    outcome = move([(0.0, pole_y, 1.5)], (0.0, 0.0), (0.0, 5000.0), 0.5)
    assert (outcome.success, outcome.collision) == (success, not success)
    assert outcome.reward == pytest.approx(reward, abs=1e-9)
    assert outcome.end == (0.0, pytest.approx(end_y, abs=1e-9))


@pytest.mark.parametrize("hz", [0.1, 45.0, 999_999.5])
def test_the_clock_counts_steps_and_never_stands(hz):
    times = [clock_us(k, hz) for k in range(2000)]
    assert all(abs(t - k * 1e6 / hz) <= 0.5 for k, t in enumerate(times))
    assert (np.diff(times) > 0).all()


def test_past_the_time_limit_the_flight_is_truncated_and_not_terminated():
    results = straight(CorridorEnv(**EMPTY, time_limit_s=0.1))
    assert len(results) == 20
    assert [r[2:4] for r in results[-2:]] == [(False, False), (False, True)]
    assert not results[-1][4]["success"]
    assert results[-1][4]["y_m"] == 2.0  # exactly: no error adds up
    at_the_goal = straight(CorridorEnv(**EMPTY, time_limit_s=5.0, fidelity=FidelityConfig(max_step_m=9.0)))
    assert at_the_goal[-1][2:4] == (True, False)


def test_the_window_holds_the_events_of_its_step():
    env = CorridorEnv()
    env.reset(seed=1)
    for k in range(6):
        window, _, _, _, info = env.step(k % 3)
        events, window_us = unpack_window(window)
        assert window_us == 5000
        assert len(events) == info["num_events"] > 0
        assert info["t_us"] == 5000 * (k + 1)
        events["t"] += info["t_us"] - 5000
        assert np.array_equal(events, env.events)


def test_splits_never_share_a_corridor_and_options_pick_an_episode():
    def poles(split, seed, episode):
        env = CorridorEnv(camera=SMALL, split=split)
        env.reset(seed=seed, options={"episode_number": episode})
        return env.scene.obstacles.tobytes(), env.camera_pose()

    cases = [(s, seed, e) for s in ("train", "validation", "eval") for seed in (0, 1) for e in (0, 1)]
    assert len({poles(*case) for case in cases}) == len(cases)
    env = CorridorEnv(camera=SMALL)
    env.reset(seed=1)
    env.reset()
    assert (env.scene.obstacles.tobytes(), env.camera_pose()) == poles("train", 1, 1)


def test_faults_leave_the_corridor_and_the_spawn_alone():
    clean, faulty = CorridorEnv(camera=SMALL), CorridorEnv(camera=SMALL, faults=FAULTY)
    for env in (clean, faulty):
        env.reset(seed=4)
        env.step(0)
    assert clean.camera_pose() == faulty.camera_pose()
    assert clean.scene.obstacles.tobytes() == faulty.scene.obstacles.tobytes()
    assert clean.events.tobytes() == faulty.true_events.tobytes() != faulty.events.tobytes()


@pytest.mark.parametrize("action", [3, -1, 0.0, None, [0]])
def test_an_action_outside_the_space_is_refused_and_the_flight_goes_on(action):
    env = CorridorEnv(**EMPTY)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="action"):
        env.step(action)
    assert env.step(np.int64(0))[4]["t_us"] == 5000


def test_a_step_before_reset_or_after_the_end_is_refused():
    env = CorridorEnv(**EMPTY, time_limit_s=0.005)
    with pytest.raises(ResetNeeded):
        env.step(0)
    env.reset(seed=0)
    assert env.step(0)[3]
    with pytest.raises(ResetNeeded):
        env.step(0)


@pytest.mark.parametrize("options", [{"episode_number": -1}, {"episode_number": 1.5}, {"seed": 1}])
def test_unknown_options_are_refused(options):
    with pytest.raises(ValueError, match="options"):
        CorridorEnv(camera=SMALL).reset(seed=0, options=options)


def test_the_picture_shows_luminance_beside_events():
    camera = CameraConfig(width=16, height=8, contrast_threshold=0.02)
    env = CorridorEnv(camera=camera, render_mode="rgb_array")
    env.reset(seed=0)
    assert not env.render()[:, 64:].any()
    env.step(0)
    picture = env.render()
    grey = np.rint(255 * np.minimum(env.luminance, 1) ** (1 / 2.2))
    assert picture[::4, :64:4, 0].tolist() == grey.tolist()
    assert picture.shape == (32, 128, 3)
    assert picture[:, 64:].any()
    assert CorridorEnv(camera=SMALL).render() is None


@pytest.mark.parametrize("scene", ["poles_dense", "dynamic"])
def test_a_picture_is_that_of_the_event_camera_without_simulating_one(scene):
    usual, alone = (CorridorEnv(scene=scene, camera=SMALL, observation=o) for o in ("window", "luminance"))
    (_, before), (picture, info) = usual.reset(seed=1), alone.reset(seed=1)
    assert (picture[..., 0] == usual.luminance).all()
    for action in np.random.default_rng(1).integers(0, 3, 40):
        _, *outcome, before = usual.step(action)
        picture, *others, info = alone.step(action)
        assert outcome == others
        assert (picture[..., 0] == usual.luminance).all()
        assert alone.events.size == info["num_events"] == 0
    assert {**before, "num_events": 0} == info


@pytest.mark.parametrize(
    ("observation", "camera"),
    [("window", SMALL), ("window", CameraConfig(16, 16, refractory_us=1)), ("luminance", SMALL)],
)
def test_a_bad_number_stops_the_flight_naming_its_step_and_the_next_one_flies(observation, camera):
    env = CorridorEnv(**EMPTY | {"camera": camera, "observation": observation})
    env.reset(seed=11)
    env.step(0)
    env._sensor._renderer.frame["sky"] = np.nan
    with pytest.raises(ValueError, match=r"episode 0, step 2, seed 11: luminance must be finite"):
        env.step(0)
    with pytest.raises(ResetNeeded):
        env.step(0)
    env.reset()
    assert env.step(0)[4]["t_us"] == 5000


@pytest.mark.parametrize(
    ("observation", "same", "other"),
    [
        (
            "luminance",
            {"camera": CameraConfig(16, 16, contrast_threshold=0.4, memory="frame"), "faults": FAULTY},
            {"fidelity": FidelityConfig(samples=8)},
        ),
        ("none", {"camera": CameraConfig(20, 20), "fidelity": FidelityConfig(0.5)}, {"control_hz": 100.0}),
        ("window", {"camera": SMALL}, {"camera": CameraConfig(16, 16, contrast_threshold=0.4)}),
    ],
)
def test_flights_with_equal_seen_settings_are_equal(observation, same, other):
    plain = EnvConfig(camera=SMALL, scene="shape_change", observation=observation)
    like, unlike = dataclasses.replace(plain, **same), dataclasses.replace(plain, **other)
    seen = [seen_settings(config, observation) for config in (plain, like, unlike)]
    assert seen[0] == seen[1] != seen[2]
    episodes = [flight_bytes(CorridorEnv(config), 1, [0, 1, 2] * 10) for config in (plain, like, unlike)]
    assert episodes[0] == episodes[1] != episodes[2]
