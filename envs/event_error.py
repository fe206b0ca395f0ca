"""Event error: the share of a simulation's events that differ from those of the converged simulation."""

import dataclasses
from typing import Literal, NamedTuple

import numba
import numpy as np

from envs.config import WITHOUT_EVENTS, EnvConfig, FaultsConfig, FidelityConfig
from envs.events import EVENT
from envs.fidelity import plan_renders
from envs.kinematics import DIAGONAL, NUM_ACTIONS, Point
from envs.scene import Scene, make_scene
from envs.sensor import Sensor
from envs.vehicles import Vehicles
from envs.vehicles.dynamics import make_dynamics

# The converged simulation: this multiple of the renders needed at tolerance 0.05, at least this many renders
# a control step, the outline motion allowed at this tolerance, and this anti-aliasing.
REFERENCE_RENDERS, REFERENCE_PARTS, REFERENCE_TOLERANCE = 6, 12, 0.003
REFERENCE_SAMPLES = {"raycast": 24, "pyrender": 8}
NO_CULLING_M = 1e6  # farther than any scene reaches
TIME_SHARE = 0.05  # of a control step: largest time difference between an event and its partner
MAX_KEPT = 64  # converged flights in the cache: several settings are measured against the same flight
_CONVERGED: dict[str, np.ndarray] = {}
ENTROPY = 20_210_608  # so that the measured corridors belong to no split


class Flight(NamedTuple):
    """A straight flight of the kinematic vehicle that passes through everything.

    Attributes:
        start: Where the flight begins, x and y [m].
        action: The action taken in every step.
        steps: Number of control steps.
    """

    start: Point
    action: int
    steps: int


class Accuracy(NamedTuple):
    """Event error, events and renders of a simulation.

    Attributes:
        error: Event error against the converged simulation.
        events: Events per control step, of the simulation and of the converged simulation.
        renders: Renders per control step.
    """

    error: float
    events: tuple[float, float]
    renders: float


def measure_event_error(config: EnvConfig, flights: int = 6, steps: int = 12, seed: int = 0) -> Accuracy:
    """Measure the event error of a simulation against the converged simulation of the same short flights.

    The converged simulation renders by the ray caster (pyrender if the scene has a mesh), with converged
    anti-aliasing and number of renders and without culling. Its camera has memory "reference" and gets
    linear luminance. Thresholds and other properties of the camera are the same as in `config`. Both
    simulations leave out the faults. Each flight has its own corridor and goes straight or at 45 degrees
    where nothing is in its way, by the compiled step that episodes take. It uses the kinematic vehicle at
    `config.speed_mps`, whatever `config.vehicle` is.

    Args:
        config: The simulation.
        flights: Number of flights.
        steps: Control steps of each flight.
        seed: Seed of the corridors and flights.

    Raises:
        ValueError: The simulation has observation "luminance" or "none", which simulates no event camera.
    """
    if config.observation in WITHOUT_EVENTS:
        rule = "observation must be one that has a camera for its error to be measured"
        raise ValueError(f"{rule}; got {config.observation!r}")
    pairs = [
        _measure_flight(config, steps, np.random.default_rng([ENTROPY, seed, i])) for i in range(flights)
    ]
    tolerance_us = TIME_SHARE * 1e6 / config.control_hz
    weights = [events.size + converged.size for events, converged, _ in pairs]
    errors = [event_error(events, converged, tolerance_us) for events, converged, _ in pairs]
    total = flights * steps
    return Accuracy(
        error=float(np.average(errors, weights=weights)) if sum(weights) else 0.0,
        events=(sum(pair[0].size for pair in pairs) / total, sum(pair[1].size for pair in pairs) / total),
        renders=sum(pair[2] for pair in pairs) / total,
    )


def error_between(config: EnvConfig, other: EnvConfig, flights: int = 6, steps: int = 12) -> float:
    """Measure the event error between two sensors on the same short flights, such as with and without faults.

    The flights are the same as in `measure_event_error`. Events pair up as in `event_error`, at most a
    twentieth of a control step apart.

    Args:
        config: One simulation, with its faults.
        other: Another simulation with the same scene, rate and speed.
        flights: Number of flights.
        steps: Control steps of each flight.

    Raises:
        ValueError: Scene, rate or speed differ.
    """
    way = ("scene", "layout", "control_hz", "speed_mps")
    if any(getattr(config, name) != getattr(other, name) for name in way):
        raise ValueError(f"both must have the same {', '.join(way)}; got {config!r} and {other!r}")
    streams = []
    for i in range(flights):
        scene, flight = _flight(config, steps, np.random.default_rng([ENTROPY, 0, i]))
        streams.append([_events_of(one, scene, flight)[0] for one in (config, other)])
    tolerance_us = TIME_SHARE * 1e6 / config.control_hz
    weights = [ours.size + theirs.size for ours, theirs in streams]
    errors = [event_error(ours, theirs, tolerance_us) for ours, theirs in streams]
    return float(np.average(errors, weights=weights)) if sum(weights) else 0.0


def converged(config: EnvConfig, scene: Scene) -> EnvConfig:
    """Return the settings of the same simulation without rendering error, see `measure_event_error`."""
    renderer: Literal["raycast", "pyrender"] = "raycast" if scene.mesh is None else "pyrender"
    asked = dataclasses.replace(config, faults=FaultsConfig(), renderer=renderer)
    camera = dataclasses.replace(config.camera, memory="reference", encoding="linear32")
    usual = dataclasses.replace(asked, camera=camera, fidelity=FidelityConfig())
    renders_apart_m = plan_renders(usual, scene).max_step_m / REFERENCE_RENDERS
    fidelity = FidelityConfig(
        tolerance=REFERENCE_TOLERANCE,
        max_step_m=min(renders_apart_m, config.speed_mps / config.control_hz / REFERENCE_PARTS),
        samples=REFERENCE_SAMPLES[renderer],
        cull_m=NO_CULLING_M,
    )
    return dataclasses.replace(usual, fidelity=fidelity)


def _measure_flight(
    config: EnvConfig, steps: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return a flight's events, its converged events and its number of renders, without faults."""
    scene, flight = _flight(config, steps, rng)
    config = dataclasses.replace(config, faults=FaultsConfig())
    events, renders = _events_of(config, scene, flight)
    exact = converged(config, scene)
    key = f"{exact!r} {flight}"
    if key not in _CONVERGED:
        if len(_CONVERGED) == MAX_KEPT:
            _CONVERGED.clear()
        _CONVERGED[key] = _events_of(exact, scene, flight)[0]
    return events, _CONVERGED[key], renders


def _flight(config: EnvConfig, steps: int, rng: np.random.Generator) -> tuple[Scene, Flight]:
    """Draw a corridor and a straight flight in it that touches nothing, if 100 draws find such a flight."""
    scene = make_scene(config.scene, rng, config.vehicle_radius_m, config.camera_height_m, **config.layout)
    way_m = steps * config.speed_mps / config.control_hz
    for _ in range(100):
        action = int(rng.integers(NUM_ACTIONS))
        dx, dy = ((0.0, 1.0), (-DIAGONAL, DIAGONAL), (DIAGONAL, DIAGONAL))[action]
        x, y = rng.uniform(*scene.spawn_range_m), rng.uniform(0.0, scene.length_m)
        end = x + dx * way_m, y + dy * way_m
        if not scene.collides((x, y), end, config.vehicle_radius_m, config.camera_height_m):
            break
    return scene, Flight((x, y), action, steps)


def _events_of(config: EnvConfig, scene: Scene, flight: Flight) -> tuple[np.ndarray, float]:
    """Return all events of a flight and its number of renders."""
    config = dataclasses.replace(config, vehicle="kinematic", body={}, action_delay_ms=0.0, task="corridor")
    sensor, vehicles = Sensor(config), Vehicles(1)
    sensor.reset(scene, flight.start, np.random.default_rng(0))
    vehicles.start(0, config, scene, sensor, flight.start, make_dynamics(config))
    vehicles.pass_through(0)
    batches, renders, active = [np.empty(0, EVENT)], 0.0, np.ones(1, bool)
    for _ in range(flight.steps):
        vehicles.step(np.array([flight.action]), active)
        batches.append(vehicles.events)
        renders += float(vehicles.rows["renders"][0])
    sensor.close()
    return np.concatenate(batches), renders


def event_error(events: np.ndarray, reference: np.ndarray, tolerance_us: float) -> float:
    """Return the share of events without a partner: same pixel and polarity, at most `tolerance_us` apart.

    Events pair up one to one, in as many pairs as possible. The share counts both streams together,
    1 - 2 pairs / (events + reference): 0 if all events pair up (or both streams are empty), 1 if none
    does. It is symmetric in the two streams.

    Args:
        events: EVENT array, in any order.
        reference: EVENT array, in any order.
        tolerance_us: Largest difference in time [us], >= 0.

    Raises:
        ValueError: `tolerance_us` is negative or not finite.
    """
    if not 0.0 <= tolerance_us < np.inf:
        raise ValueError(f"tolerance_us must be finite and >= 0; got {tolerance_us}.")
    total = events.size + reference.size
    if total == 0:
        return 0.0
    return 1.0 - 2.0 * _pairs(*_by_pixel(events), *_by_pixel(reference), tolerance_us) / total


def _by_pixel(events: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the keys (pixel and polarity) and times of events, sorted by key and then by time."""
    keys = (events["y"].astype(np.int64) << 17) | (events["x"].astype(np.int64) << 1) | (events["p"] > 0)
    order = np.lexsort((events["t"], keys))
    return keys[order], events["t"][order]


@numba.njit(cache=True, error_model="numpy")
def _pairs(keys, times, other_keys, other_times, tolerance):
    """Count pairs in one pass over both streams; on a time line, taking the earliest partner is optimal."""
    i, j, pairs = 0, 0, 0
    while i < keys.size and j < other_keys.size:
        if keys[i] != other_keys[j]:
            i, j = (i + 1, j) if keys[i] < other_keys[j] else (i, j + 1)
        elif abs(times[i] - other_times[j]) <= tolerance:
            i, j, pairs = i + 1, j + 1, pairs + 1
        elif times[i] < other_times[j]:
            i += 1
        else:
            j += 1
    return pairs
