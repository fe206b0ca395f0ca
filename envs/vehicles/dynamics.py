"""Dynamics: what turns a command into motion.

`env.vehicle` names a row of `envs.config.VEHICLES`: the location, "module:function", of a function that
creates a `Dynamics` from the settings of an episode. The default is "kinematic", the paper's vehicle with
three headings. The compiled step moves it by counting its moves, so that errors do not add up. Every other
vehicle integrates a state by a compiled function:

    @numba.njit
    def move(state, command, wind, parameters, dt_s): ...

It advances `state`, float64 (S,) that starts with x, y [m], vx, vy [m/s], by `dt_s` seconds. A plug-in adds a
row, `VEHICLES["glider"] = "my_module:make_glider"`. The camera points along +y whatever the state.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import numba
import numpy as np
from gymnasium import spaces

from core.places import resolve
from envs.config import VEHICLES, EnvConfig
from envs.kinematics import MIRRORED_ACTIONS, NUM_ACTIONS

WAY_S = 0.01  # longest of the straight parts, of equal time, into which the way of a control step is cut


class Dynamics(NamedTuple):
    """A vehicle, with the settings of one episode.

    Attributes:
        action_space: Discrete(K), or a Box of shape (C,).
        straight: The action that flies straight ahead; it is taken until the first delayed action is due.
        top_speed_mps: Upper bound of the speed [m/s], used to plan the renders of a step.
        move: Compiled function, as above. None: the vehicle is kinematic.
        state: float64 (S,), state at the start; x and y are replaced by the start position.
        parameters: float64 (P,), passed to `move`.
        wind: float64 (2,) [m/s], passed to `move`.
        commands: float64 (K, C), the command of each action of a Discrete; None: an action is a command.
        sideways: Largest sideways speed [m/s] and acceleration [m/s^2] that a planner may count on; None:
            planning for this vehicle is not possible (`envs.vehicles.planning`).
    """

    action_space: spaces.Space
    straight: Any
    top_speed_mps: float
    move: Callable[..., None] | None = None
    state: np.ndarray = np.zeros(4)
    parameters: np.ndarray = np.zeros(0)
    wind: np.ndarray = np.zeros(2)
    commands: np.ndarray | None = None
    sideways: tuple[float, float] | None = None


def make_dynamics(config: EnvConfig) -> Dynamics:
    """Return the vehicle of an episode.

    Raises:
        ValueError: `config.body` has a key or a value that the vehicle does not accept.
    """
    made: Dynamics = resolve(VEHICLES[config.vehicle])(config)
    return made


def make_kinematic(config: EnvConfig) -> Dynamics:
    """Return the paper's vehicle: constant speed, ahead or 45 degrees to a side (appendix D.1)."""
    if config.body:
        raise ValueError(f"body must be empty for vehicle 'kinematic'; got {config.body!r}")
    return Dynamics(spaces.Discrete(NUM_ACTIONS), np.int64(0), config.speed_mps)


def mirrored_actions(dynamics: Dynamics) -> list[int]:
    """Return the mirror image, left and right exchanged, of each action of a Discrete.

    Raises:
        ValueError: A command has no mirror image among the commands.
    """
    if dynamics.commands is None:
        return MIRRORED_ACTIONS
    images = dynamics.commands * np.where(np.arange(dynamics.commands.shape[1]) == 0, -1.0, 1.0)
    apart = np.abs(images[:, None] - dynamics.commands).max(axis=2)
    if (apart.min(axis=1) > 1e-9).any():
        raise ValueError("commands must come in pairs, left and right, to be mirrored")
    return [int(action) for action in apart.argmin(axis=1)]


def planned_config(config: EnvConfig, dynamics: Dynamics) -> EnvConfig:
    """Return settings for planning renders, whose speed and rate bound the length of each part of a step."""
    if dynamics.move is None:
        return config
    rate_hz = config.control_hz * parts_of_step(config)
    return replace(config, speed_mps=dynamics.top_speed_mps, control_hz=rate_hz)


def number_type(space: spaces.Space) -> type:
    """Return the type in which actions of a space are stored."""
    return np.int64 if isinstance(space, spaces.Discrete) else np.float64


def wrong_actions(space: spaces.Space, actions: np.ndarray) -> np.ndarray:
    """Return whether each action is outside a Discrete(K) or a Box, bool (B,)."""
    if isinstance(space, spaces.Discrete):
        if actions.dtype.kind not in "iu":  # text and objects cannot be compared with numbers
            return np.ones(len(actions), bool)
        return (actions < 0) | (actions >= space.n)
    if actions.dtype.kind not in "iuf":
        return np.ones(len(actions), bool)
    inside = (actions >= space.low) & (actions <= space.high)
    return ~inside.all(axis=tuple(range(1, actions.ndim)))


def parts_of_step(config: EnvConfig) -> int:
    """Return the number of straight parts of a control step's way, each at most `WAY_S` long."""
    return max(1, math.ceil((1.0 - 1e-9) / (config.control_hz * WAY_S)))


@lru_cache(maxsize=16)
def loop_over(move: Callable[..., None]) -> Callable[..., None]:
    """Return the compiled loop that moves all active vehicles of one kind by `move`.

    The loop takes states (B, S), commands (B, C), winds (B, 2), parameters (B, P), the seconds of a part
    (B,), the number of parts (B,), the places at the ends of the parts (B, parts + 1, 2), which it fills,
    and whether each vehicle is active, bool (B,).
    """

    @numba.njit(error_model="numpy")
    def move_all(
        states: Any, commands: Any, winds: Any, parameters: Any, dt_s: Any, parts: Any, ways: Any, active: Any
    ) -> None:
        for row in range(len(states)):
            if active[row]:
                ways[row, 0] = states[row, :2]
                for part in range(parts[row]):
                    move(states[row], commands[row], winds[row], parameters[row], dt_s[row])
                    ways[row, part + 1] = states[row, :2]

    return move_all
