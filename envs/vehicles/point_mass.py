"""Point mass: a planar body with inertia that follows a desired velocity or acceleration.

With velocity v, wind w, drag k and an acceleration a from the rotors:

    dx/dt = v,    dv/dt = a + k (w - v)

- command "velocity" u: a = (u - v) / tau, limited to the norm max_acceleration;
- command "acceleration" u: da/dt = (u - a) / tau, with u limited to the norm max_acceleration.

A mass of `mass_ratio` times the nominal mass divides every acceleration, drag included. x points right, y
ahead. Without drag every step is exact, whatever its length, even if the acceleration limit stops to apply
within the step. With drag the same solution is applied in pieces of at most `PIECE_S`, in which a limited
acceleration has a constant direction: positions after 5 s err by less than 0.1 mm
(tests/envs/test_point_mass.py).
"""

import math
from dataclasses import dataclass, fields
from typing import Any

import numba
import numpy as np
from gymnasium import spaces

from envs.config import EnvConfig
from envs.scene.layouts import refuse_unless
from envs.vehicles.dynamics import Dynamics

PIECE_S = 1e-3
SHORT_S = 1e-9  # shortest piece, so that rounding cannot stall the integration
COMMANDS = ("velocity", "acceleration")


@dataclass(frozen=True)
class PointMass:
    """Settings of a point mass, as `env.body` gives them.

    Attributes:
        command: Quantity that an action commands: "velocity" or "acceleration". An action is a Box of two
            numbers in [-1, 1], right and ahead, times max_speed_mps or max_acceleration_mps2.
        primitives: If at least 2, the action space is Discrete with this many actions: sideways velocities
            from left to right at `speed_mps` ahead, or sideways accelerations. Three actions have the order
            of the kinematic vehicle: ahead, left, right. 0: a Box.
        tau_s: Time constant of the lag [s].
        max_acceleration_mps2: Largest acceleration of the nominal mass by the rotors [m/s^2].
        max_speed_mps: Largest commanded speed [m/s].
        side_speed_mps: Largest sideways velocity of the primitives [m/s].
        drag_per_s: Linear drag [1/s].
        mass_ratio: Actual mass over the nominal mass.
        wind_x_mps, wind_y_mps: Constant wind [m/s], which acts through the drag.
    """

    command: str = "velocity"
    primitives: float = 0.0
    tau_s: float = 0.2
    max_acceleration_mps2: float = 15.0
    max_speed_mps: float = 30.0
    side_speed_mps: float = 5.0
    drag_per_s: float = 0.0
    mass_ratio: float = 1.0
    wind_x_mps: float = 0.0
    wind_y_mps: float = 0.0

    def __post_init__(self) -> None:
        """Check the values; ValueError names the rule and the value."""
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name != "command" and (isinstance(value, bool) or not isinstance(value, int | float)):
                raise ValueError(f"body {field.name} must be a number, got {value!r}")
        rules = {
            f"command must be one of {COMMANDS}": self.command in COMMANDS,
            "primitives must be 0, or a whole number from 2 to 1000": self.primitives == 0
            or (2 <= self.primitives <= 1000 and float(self.primitives).is_integer()),
            "tau_s must be in [0.001, 100]": 1e-3 <= self.tau_s <= 100.0,
            "max_acceleration_mps2 must be in (0, 10000]": 0.0 < self.max_acceleration_mps2 <= 1e4,
            "max_speed_mps must be in (0, 1000]": 0.0 < self.max_speed_mps <= 1e3,
            "side_speed_mps must be in (0, 1000]": 0.0 < self.side_speed_mps <= 1e3,
            "drag_per_s must be in [0, 100]": 0.0 <= self.drag_per_s <= 100.0,
            "mass_ratio must be in [0.1, 10]": 0.1 <= self.mass_ratio <= 10.0,
            "wind_x_mps and wind_y_mps must be at most 100": max(map(abs, self.wind)) <= 100.0,
        }
        refuse_unless(rules, "body", self)

    @property
    def wind(self) -> tuple[float, float]:
        """Return the wind, x and y [m/s]."""
        return self.wind_x_mps, self.wind_y_mps


def make_point_mass(config: EnvConfig, nominal: PointMass = PointMass()) -> Dynamics:
    """Return the point mass of an episode: `nominal` with fields replaced by `config.body`.

    Raises:
        ValueError: `config.body` has an unknown key or an invalid value, or `config.speed_mps` is too high.
    """
    known = [field.name for field in fields(nominal)]
    for key in config.body:
        if key not in known:
            raise ValueError(f"body has no {key!r}; it has {', '.join(known)}")
    body = PointMass(**{**vars(nominal), **config.body})
    if config.speed_mps > body.max_speed_mps:
        rule = "speed_mps must be at most the vehicle's max_speed_mps"
        raise ValueError(f"{rule}, {body.max_speed_mps}; got {config.speed_mps}")
    follows, mass = body.command == "velocity", body.mass_ratio
    scale = body.max_speed_mps if follows else body.max_acceleration_mps2 / mass
    parameters = [
        *(float(follows), scale, 1.0 / (body.tau_s * (mass if follows else 1.0))),
        *(body.max_acceleration_mps2 / mass, body.drag_per_s / mass),
    ]
    commands, straight = _commands(body, config.speed_mps)
    space: spaces.Space = spaces.Box(-1.0, 1.0, (2,), np.float32)
    return Dynamics(
        action_space=space if commands is None else spaces.Discrete(len(commands)),
        straight=straight,
        top_speed_mps=max(body.max_speed_mps, config.speed_mps, math.hypot(*body.wind)),
        move=move,
        state=np.array([0.0, 0.0, 0.0, config.speed_mps, 0.0, 0.0]),
        parameters=np.array(parameters),
        wind=np.array(body.wind),
        commands=commands,
        sideways=_sideways(body),
    )


def make_crazyflie(config: EnvConfig) -> Dynamics:
    """Return a Crazyflie 2.0 under its own velocity controller.

    Its firmware tilts by 25 degrees per m/s of velocity error, at most 20 degrees (crazyflie-firmware,
    platform_defaults_cf2.h: PID_VEL_X_KP, PID_VEL_ROLL_MAX): tau = 1 / (g tan 25 deg), acceleration up to
    g tan 20 deg. Drag is the drag of its rotors in hover, 4 k_d sqrt(m g / (4 k_eta)) / m with m = 0.03 kg,
    k_eta = 2.3e-8 N s^2 (Foerster, System Identification of the Crazyflie 2.0, ETH 2015) and
    k_d = 1.025e-6 kg (RotorPy, crazyflie_params.py).
    """
    return make_point_mass(
        config, PointMass(tau_s=0.219, max_acceleration_mps2=3.57, max_speed_mps=14.6, drag_per_s=0.244)
    )


def _sideways(body: PointMass) -> tuple[float, float]:
    """Return the largest sideways speed and acceleration of the primitives, `Dynamics.sideways`."""
    limit_mps2 = body.max_acceleration_mps2 / body.mass_ratio
    if body.command == "acceleration":
        return body.side_speed_mps, limit_mps2
    return body.side_speed_mps, min(limit_mps2, body.side_speed_mps / (body.tau_s * body.mass_ratio))


def _commands(body: PointMass, speed_mps: float) -> tuple[np.ndarray | None, Any]:
    """Return the commands of the primitives (None for a Box), and the action that flies straight ahead."""
    ahead = speed_mps / body.max_speed_mps if body.command == "velocity" else 0.0
    if not body.primitives:
        return None, np.array([0.0, ahead])
    side = min(1.0, body.side_speed_mps / body.max_speed_mps) if body.command == "velocity" else 1.0
    sideways, straight = side * np.linspace(-1.0, 1.0, int(body.primitives)), int(body.primitives) // 2
    if body.primitives == 3:
        sideways, straight = sideways[[1, 0, 2]], 0
    return np.stack([sideways, np.full_like(sideways, ahead)], axis=1), np.int64(straight)


@numba.njit(cache=True, error_model="numpy")
def move(state, command, wind, parameters, dt_s):
    """Advance x, y, vx, vy, ax, ay in place; parameters as `make_point_mass` packs them."""
    follows, scale, rate, limit, drag = parameters
    ux, uy = scale * command[0], scale * command[1]
    norm = math.hypot(ux, uy)
    if norm > scale:
        ux, uy = ux * scale / norm, uy * scale / norm
    left = dt_s
    while left > 0.0:
        piece = left if drag == 0.0 else min(left, PIECE_S)
        if follows != 0.0:
            piece = _follow_velocity(state, (ux, uy), wind, (rate, limit, drag), piece)
        else:
            _follow_acceleration(state, (ux, uy), wind, (rate, drag), piece)
        left -= piece


@numba.njit(cache=True, error_model="numpy")
def _follow_velocity(state, command, wind, constants, piece):
    """Advance under a velocity command by at most `piece` seconds; return the seconds advanced."""
    rate, limit, drag = constants
    ax, ay = rate * (command[0] - state[2]), rate * (command[1] - state[3])
    wish = math.hypot(ax, ay)
    if wish > limit * (1.0 + 1e-12):
        ax, ay = ax * limit / wish, ay * limit / wish
        if drag == 0.0:
            piece = min(piece, max(SHORT_S, (wish - limit) / (rate * limit)))  # until the limit has no effect
        else:  # the direction at the middle of the piece
            bx = command[0] - state[2] - 0.5 * piece * (ax + drag * (wind[0] - state[2]))
            by = command[1] - state[3] - 0.5 * piece * (ay + drag * (wind[1] - state[3]))
            wish = max(limit, rate * math.hypot(bx, by))
            ax, ay = rate * bx * limit / wish, rate * by * limit / wish
        _relax(state, ax + drag * wind[0], ay + drag * wind[1], drag, piece)
    else:
        ax, ay = rate * command[0] + drag * wind[0], rate * command[1] + drag * wind[1]
        _relax(state, ax, ay, rate + drag, piece)
        ax, ay = rate * (command[0] - state[2]), rate * (command[1] - state[3])
    state[4], state[5] = ax, ay
    return piece


@numba.njit(cache=True, error_model="numpy")
def _follow_acceleration(state, command, wind, constants, piece):
    """Advance under an acceleration command by `piece` seconds."""
    rate, drag = constants
    first, second = _integrals(rate, piece)
    for axis in range(2):
        beyond = state[4 + axis] - command[axis]
        mean = command[axis] + beyond * first / piece
        _relax_axis(state, axis, mean + drag * wind[axis], drag, piece)
        state[axis] += beyond * (second - 0.5 * first * piece)  # because a decays, more of it acts early
        state[4 + axis] = command[axis] + beyond * math.exp(-rate * piece)


@numba.njit(cache=True, error_model="numpy")
def _relax(state, ax, ay, rate, seconds):
    """Solve dx/dt = v, dv/dt = a - rate v exactly over `seconds`, in both axes."""
    _relax_axis(state, 0, ax, rate, seconds)
    _relax_axis(state, 1, ay, rate, seconds)


@numba.njit(cache=True, error_model="numpy")
def _relax_axis(state, axis, a, rate, seconds):
    """Solve dx/dt = v, dv/dt = a - rate v exactly over `seconds`, in one axis."""
    first, second = _integrals(rate, seconds)
    v = state[2 + axis]
    state[axis] += v * seconds + (a - rate * v) * second
    state[2 + axis] = v + (a - rate * v) * first


@numba.njit(cache=True, error_model="numpy")
def _integrals(rate, seconds):
    """Return the first and the second integral of exp(-rate t) over `seconds`."""
    x = rate * seconds
    if x < 1e-3:  # here the difference below would cancel
        first = seconds * (1.0 - x * (0.5 - x * (1.0 / 6.0 - x / 24.0)))
        return first, seconds * seconds * (0.5 - x * (1.0 / 6.0 - x * (1.0 / 24.0 - x / 120.0)))
    first = -math.expm1(-x) / rate
    return first, (seconds - first) / rate
