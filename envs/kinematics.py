"""Kinematics, clock, reward and random streams of a corridor episode (appendix D.1)."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numba
import numpy as np

from envs.scene.collision import first_contact, first_moving_contact

SPLITS = ("train", "validation", "eval")
NUM_ACTIONS = 3  # forward, left 45 degrees, right 45 degrees
MIRRORED_ACTIONS = [0, 2, 1]  # each action with left and right exchanged
DIAGONAL = math.sqrt(0.5)
GOAL_REWARD, COLLISION_REWARD = 100.0, -100.0
SEED_STRIDE = 2**32

Point = tuple[float, float]


class Lane(NamedTuple):
    """A vehicle and the lane in which it flies.

    Attributes:
        radius_m: Radius of the vehicle, a level disc [m].
        half_width_m: The walls are at x = +-half_width_m [m].
        length_m: The goal line is at y = length_m [m].
    """

    radius_m: float
    half_width_m: float
    length_m: float


class Outcome(NamedTuple):
    """Result of one control step.

    Attributes:
        end: Position of the vehicle after the step, x and y [m].
        share: Share of the step in which the vehicle moved.
        reward: Metres of progress along y, with the bonus or the penalty.
        success, collision: Whether the goal line or a contact ended the episode; at most one is True.
    """

    end: Point
    share: float
    reward: float
    success: bool
    collision: bool


def random_streams(split: str, seed: int, episode: int) -> tuple[np.random.Generator, ...]:
    """Return the random generators of an episode's scene, spawn, faults and condition.

    The split comes first in the entropy, so no seed gives a corridor of another split. The seed
    comes last, because it may be longer than one word and would make later entries ambiguous.
    """
    streams = np.random.SeedSequence([SPLITS.index(split), episode, seed]).spawn(4)
    return tuple(np.random.default_rng(stream) for stream in streams)


def choose_episode(following: int, options: Mapping[str, object]) -> int:
    """Return the episode number in the reset `options`, or else `following`.

    Raises:
        ValueError: An option is unknown, or the episode number is not an integer >= 0.
    """
    episode = options.get("episode_number", following)
    if options.keys() - {"episode_number"} or not isinstance(episode, int | np.integer) or episode < 0:
        raise ValueError(f'options may hold {{"episode_number": integer >= 0}} alone; got {options}.')
    return int(episode)


def spread_seeds(seed: int | Sequence[int | None] | None, count: int) -> list[int | None]:
    """Return one seed for each of `count` environments.

    One number gives seed + i * 2**32 for environment i. With seed + i, workers with neighbouring seeds
    would get the same corridors.

    Raises:
        ValueError: The number of seeds is not `count`.
    """
    if seed is None:
        return [None] * count
    if isinstance(seed, int | np.integer):
        return [int(seed) + i * SEED_STRIDE for i in range(count)]
    if len(seed) != count:
        raise ValueError(f"seed must be one number or {count} of them; got {len(seed)}.")
    return list(seed)


@numba.njit(cache=True, error_model="numpy")
def clock_us(step: int, control_hz: float) -> int:
    """Return the simulated time at the end of a control step [us], without drift, from the step count."""
    return round(step * 1e6 / control_hz)


@numba.njit(cache=True, error_model="numpy")
def planned_position(spawn_x_m: float, moves: tuple[int, int, int], step_m: tuple[float, float]) -> Point:
    """Return the place after all moves so far, x and y [m].

    It is one product of integer counts, so errors do not add up: 1000 steps of 0.1 m are 100 m.

    Args:
        spawn_x_m: x at the start of the episode; y is 0 [m].
        moves: Number of times each action was taken.
        step_m: Speed [m/s] and control rate [Hz]; their quotient is the length of a step.
    """
    forward, left, right = moves
    speed_mps, control_hz = step_m
    x = (right - left) * DIAGONAL * speed_mps / control_hz
    return spawn_x_m + x, (forward + (left + right) * DIAGONAL) * speed_mps / control_hz


@numba.njit(cache=True, error_model="numpy")
def advance(
    lane: Lane, still_and_moving: tuple, shares: tuple[float, float], start: Point, planned: Point
) -> Outcome:
    """Move from `start` towards `planned` until the first contact or the goal line (appendix D.1.1).

    Contact and goal at the same place is a collision; so is a start in contact.

    Args:
        lane: `Lane`.
        still_and_moving: Sections of the standing bodies, (M, 7), from `envs.scene.Scene.sections`, and
            moving sections as for `first_moving_contact`.
        shares: Fractions of the control step that have passed at `start` and at `planned`.
        start: x and y [m].
        planned: x and y [m].
    """
    sections, moving = still_and_moving
    segment = start[0], start[1], planned[0], planned[1]
    contact = first_contact(segment, lane.radius_m, lane.half_width_m, sections)
    contact = min(contact, first_moving_contact(segment, lane.radius_m, moving, shares))
    goal = math.inf
    if planned[1] > start[1]:  # a vehicle that stands or flies back does not reach the goal line
        goal = (lane.length_m - start[1]) / (planned[1] - start[1])
    share = min(contact, goal, 1.0)
    collision = contact <= share
    success = not collision and goal <= 1.0
    end = planned
    if share < 1.0:
        end = (start[0] + share * (planned[0] - start[0]), start[1] + share * (planned[1] - start[1]))
    if success:
        end = (end[0], lane.length_m)
    reward = end[1] - start[1] + GOAL_REWARD * success + COLLISION_REWARD * collision
    return Outcome(end, share, reward, success, collision)


@numba.njit(cache=True, error_model="numpy")
def follow(lane: Lane, still_and_moving: tuple, way: np.ndarray) -> Outcome:
    """Move along straight parts of equal time until the first contact or the goal line, as `advance` does.

    Args:
        lane: `Lane`.
        still_and_moving: As for `advance`.
        way: (N + 1, 2), places at the ends of the N parts [m].
    """
    last, parts = len(way) - 1, 0
    places = (way[0, 0], way[0, 1]), (way[1, 0], way[1, 1])
    outcome = advance(lane, still_and_moving, (0.0, 1.0 / last), *places)
    while parts < last - 1 and not (outcome.success or outcome.collision):
        parts += 1
        start = way[parts, 0], way[parts, 1]
        end, shares = (way[parts + 1, 0], way[parts + 1, 1]), (parts / last, (parts + 1) / last)
        outcome = advance(lane, still_and_moving, shares, start, end)
    end, success, collision = outcome.end, outcome.success, outcome.collision
    reward = end[1] - way[0, 1] + GOAL_REWARD * success + COLLISION_REWARD * collision
    return Outcome(end, (parts + outcome.share) / last, reward, success, collision)
