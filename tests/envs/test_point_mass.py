"""Laws of the point mass: exact free motion, energy, limits, hover, and the same flight by a solver."""

import dataclasses
import math

import numpy as np
import pytest
from gymnasium import spaces
from scipy.integrate import solve_ivp

from envs.config import EnvConfig
from envs.corridor import CorridorEnv, CorridorVectorEnv
from envs.vehicles.dynamics import make_dynamics, parts_of_step, planned_config
from envs.vehicles.point_mass import PointMass, move


def vehicle(speed_mps=10.0, **body):
    return make_dynamics(EnvConfig(vehicle="point_mass", speed_mps=speed_mps, body=body))


def moved(dynamics, commands, dt_s, state=None):
    """States after each command, (N + 1, 6)."""
    state = (dynamics.state if state is None else np.array(state, float)).copy()
    states = [state.copy()]
    for command in commands:
        move(state, np.array(command, float), dynamics.wind, dynamics.parameters, dt_s)
        states.append(state.copy())
    return np.array(states)


def solved(body: PointMass, state, command, seconds):
    """State after a constant command by Runge and Kutta: nothing shared but the equations."""
    wind, velocity = np.array(body.wind), body.command == "velocity"
    scale = body.max_speed_mps if velocity else body.max_acceleration_mps2
    u = scale * np.array(command, float) / max(1.0, math.hypot(*command))

    def rates(_, s):
        v, a = s[2:4], s[4:6]
        rise = np.zeros(2)
        if velocity:
            a = (u - v) / body.tau_s
            a *= min(1.0, body.max_acceleration_mps2 / max(1e-300, math.hypot(*a)))
            a = a / body.mass_ratio
        else:
            rise = (u / body.mass_ratio - a) / body.tau_s
        return np.concatenate([v, a + body.drag_per_s / body.mass_ratio * (wind - v), rise])

    solution = solve_ivp(rates, (0, seconds), np.array(state), rtol=1e-10, atol=1e-12, max_step=1e-2)
    return solution.y[:, -1]


@pytest.mark.parametrize("command", ["velocity", "acceleration"])
@pytest.mark.parametrize("body", [{}, {"drag_per_s": 2.0, "mass_ratio": 1.3, "wind_y_mps": -8.0}])
def test_it_flies_as_a_solver_of_the_equations_says(command, body):
    settings = PointMass(command=command, **body)
    dynamics, rng = vehicle(command=command, **body), np.random.default_rng(0)
    ours = theirs = dynamics.state
    for _ in range(10):
        asked = rng.uniform(-1, 1, 2)
        ours = moved(dynamics, [asked], 0.5, ours)[-1]
        theirs = solved(settings, theirs, asked, 0.5)
    exact = not body
    np.testing.assert_allclose(ours[:4], theirs[:4], atol=1e-6 if exact else 1e-4)


def test_free_motion_is_uniform_and_drag_takes_energy_exponentially():
    free = moved(vehicle(command="acceleration"), [(0, 0)] * 100, 0.05)
    assert free[-1][:4] == pytest.approx([0.0, 50.0, 0.0, 10.0], abs=1e-12)
    slowed = moved(vehicle(command="acceleration", drag_per_s=0.5), [(0, 0)] * 100, 0.02)
    energy = 0.5 * (slowed[:, 2:4] ** 2).sum(axis=1)
    np.testing.assert_allclose(energy, 50.0 * np.exp(-2 * 0.5 * 0.02 * np.arange(101)), rtol=1e-12)


def test_accelerations_and_speeds_stay_within_their_limits():
    rng = np.random.default_rng(3)
    for command in ("velocity", "acceleration"):
        dynamics = vehicle(command=command, max_acceleration_mps2=12.0, max_speed_mps=15.0, mass_ratio=1.2)
        states = moved(dynamics, np.repeat(rng.uniform(-1, 1, (30, 2)), 25, axis=0), 0.01)
        rates = np.hypot(*np.diff(states[:, 2:4], axis=0).T) / 0.01
        assert rates.max() <= 10.0 * (1 + 1e-9)
        assert rates.max() > 9.0 if command == "velocity" else rates.max() > 5.0
        if command == "velocity":
            assert np.hypot(states[:, 2], states[:, 3]).max() <= 15.0 * (1 + 1e-9)


def test_primitives_are_sideways_commands_and_their_middle_flies_straight():
    dynamics = vehicle(primitives=11.0)
    assert dynamics.action_space == spaces.Discrete(11)
    assert dynamics.commands[:, 0] * 30.0 == pytest.approx(np.linspace(-5, 5, 11))
    assert dynamics.commands[:, 1] * 30.0 == pytest.approx(10.0)
    three = vehicle(primitives=3.0)
    assert three.commands[:, 0] * 30.0 == pytest.approx([0.0, -5.0, 5.0])  # as the kinematic vehicle's
    assert (three.straight, dynamics.straight) == (0, 5)


def test_the_clock_counts_steps_and_the_renders_are_planned_for_the_highest_speed():
    config = EnvConfig(vehicle="point_mass", speed_mps=10.0, control_hz=20.0)
    assert parts_of_step(config) == 5
    planned = planned_config(config, make_dynamics(config))
    assert (planned.speed_mps, planned.control_hz) == (30.0, 100.0)
    kinematic = dataclasses.replace(config, vehicle="kinematic")
    assert planned_config(kinematic, make_dynamics(kinematic)) is kinematic
    env = CorridorEnv(config)
    env.reset(seed=0)
    assert [env.step(np.zeros(2))[4]["t_us"] for _ in range(3)] == [50_000, 100_000, 150_000]


def test_a_body_a_little_faster_than_its_nominal_speed_needs_no_second_image():
    renders = []
    for share in (1.0, 1.01):
        env = CorridorEnv(EnvConfig(vehicle="point_mass", speed_mps=10.0, control_hz=100.0))
        env.reset(seed=0)
        action = np.array([0.0, share * 10.0 / 30.0])
        for _ in range(20):
            env.step(action)
        renders.append(env._vehicles.rows["renders"][0])
    assert renders[1] < 1.2 * renders[0]


def test_a_replay_of_continuous_actions_has_the_same_bytes():
    config = EnvConfig(vehicle="point_mass", speed_mps=10.0, control_hz=50.0)
    actions = np.random.default_rng(2).uniform(-1, 1, (10, 2)).astype(np.float32)
    env = CorridorVectorEnv(1, config)
    env.reset(seed=[5])
    for action in actions:
        observation = env.step(action[None])[0]
    again = CorridorVectorEnv(1, config).replay([(5, 0, actions)])[0]
    assert np.array_equal(observation, again)


@pytest.mark.parametrize(
    ("body", "rule"),
    [
        ({"tau": 1.0}, r"body has no 'tau'; it has command, primitives, tau_s"),
        ({"tau_s": 0.0}, r"body: tau_s must be in \[0.001, 100\], got tau_s=0.0"),
        ({"command": "position"}, "body: command must be one of .*got command='position'"),
        ({"primitives": 1.0}, "primitives must be 0, or a whole number from 2"),
        ({"mass_ratio": 0.0}, "mass_ratio must be in"),
        ({"drag_per_s": "much"}, "body drag_per_s must be a number, got 'much'"),
        ({"max_speed_mps": 5.0}, "speed_mps must be at most the vehicle's max_speed_mps, 5.0; got 20.0"),
    ],
)
def test_a_body_that_cannot_be_is_refused(body, rule):
    with pytest.raises(ValueError, match=rule):
        CorridorEnv(EnvConfig(vehicle="point_mass", body=body))


def test_the_preset_is_a_crazyflie_of_its_sources():
    gravity, mass = 9.81, 0.03
    dynamics = make_dynamics(EnvConfig(vehicle="crazyflie", speed_mps=3.0))
    _, _, rate, limit, drag = dynamics.parameters
    assert 1.0 / rate == pytest.approx(1.0 / (gravity * math.tan(math.radians(25))), rel=5e-3)
    assert limit == pytest.approx(gravity * math.tan(math.radians(20)), rel=5e-3)
    rotors = 4 * math.sqrt(mass * gravity / (4 * 2.3e-8))
    assert drag == pytest.approx(1.02506e-6 * rotors / mass, rel=5e-3)


def test_a_quadrotor_of_rotorpy_settles_where_the_point_mass_does_in_wind():
    """RotorPy 3.0's Crazyflie has an attitude and motors; its velocity controller gets our time constant."""
    vehicles = pytest.importorskip("rotorpy.vehicles.multirotor", reason="needs: pip install rotorpy")
    from rotorpy.vehicles.crazyflie_params import quad_params

    ours = make_dynamics(EnvConfig(vehicle="crazyflie", speed_mps=3.0, body={"wind_x_mps": 1.0}))
    tau_s = 0.219  # of `make_crazyflie`
    hover = math.sqrt(quad_params["mass"] * 9.81 / 4 / quad_params["k_eta"])
    start = {name: np.zeros(3) for name in ("x", "v", "w")} | {
        "q": np.array([0.0, 0.0, 0.0, 1.0]),
        "wind": np.array([1.0, 0.0, 0.0]),
        "rotor_speeds": np.full(4, hover),
    }
    quadrotor = vehicles.Multirotor(
        quad_params | {"k_v": 1.0 / tau_s}, start, control_abstraction="cmd_vel", enable_ground=False
    )
    theirs, state = start, np.zeros(6)
    for asked in np.array([(0.5, 0.0), (0.5, 0.3), (-0.2, 0.3), (0.0, 0.0)]):
        for _ in range(200):
            theirs = quadrotor.step(theirs, {"cmd_v": np.append(asked, 0.0)}, 0.01)
            theirs["wind"] = start["wind"]
            move(state, asked / ours.top_speed_mps, ours.wind, ours.parameters, 0.01)
            assert np.hypot(*(theirs["x"][:2] - state[:2])) < 0.08  # the attitude comes late
        np.testing.assert_allclose(theirs["v"][:2], state[2:4], atol=0.005)
        np.testing.assert_allclose(theirs["x"][:2], state[:2], atol=0.02)
