"""Every setting of the world and its sensor: names, units, ranges, defaults.

One `EnvConfig` describes one simulation completely. Values are checked at construction: an unknown key, or
a value of the wrong type, out of range, NaN or infinite, raises `pydantic.ValidationError` (a ValueError)
that names the key, the value and the rule.
"""

import dataclasses
import hashlib
import json
import math
from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal, cast

import numpy as np
from pydantic import (
    AfterValidator,
    ConfigDict,
    Field,
    PlainValidator,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic.dataclasses import dataclass
from pydantic_core import ArgsKwargs

STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)

Positive = Annotated[float, Field(gt=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]


def plain_numbers(cls: type, given: Any) -> Any:
    """Convert NumPy integers and booleans among the arguments of a class to Python's own."""

    def plain(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {name: plain(part) for name, part in value.items()}
        return value.item() if isinstance(value, np.integer | np.bool_) else value

    if isinstance(given, ArgsKwargs):
        return ArgsKwargs(tuple(map(plain, given.args)), plain(given.kwargs or {}))
    return plain(given)


PLAIN = cast(Any, classmethod(plain_numbers))  # runs first in every settings class, before its other checks


def _layout_value(value: Any) -> Any:
    """Return a layout value in plain form; a single rule gives a clearer message than a union of types."""
    if isinstance(value, bool | str):
        return value
    if isinstance(value, Mapping):
        return {str(name): _layout_value(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [_layout_value(part) for part in value]
    if not isinstance(value, int | float) or not abs(value) <= 1e300:
        raise ValueError(f"must be a finite number, a truth value, a word or a texture, got {value!r}")
    return float(value)


Value = Annotated[Any, PlainValidator(_layout_value)]

# Faults that plug-ins add: name -> function that creates one per episode, see `envs.events.faults`.
ADDED_FAULTS: dict[str, Callable[..., Any]] = {}

# Vehicles and tasks: name -> "module:attribute", see `envs.vehicles.dynamics` and `envs.vehicles.task`.
VEHICLES: dict[str, str] = {
    "kinematic": "envs.vehicles.dynamics:make_kinematic",
    "point_mass": "envs.vehicles.point_mass:make_point_mass",
    "crazyflie": "envs.vehicles.point_mass:make_crazyflie",
}
TASKS: dict[str, str] = {"corridor": ""}  # "": the compiled step judges it itself


def _of_a_fault(name: str) -> str:
    if name not in ADDED_FAULTS:
        known = f"one of {', '.join(ADDED_FAULTS)}" if ADDED_FAULTS else "of a plug-in, and none is loaded"
        raise ValueError(f"must be {known}, got {name!r}")
    return name


def _row_of(table: Mapping[str, object]) -> AfterValidator:
    """Return a check that a name is a row of this table; plug-ins may have added rows."""

    def check(name: str) -> str:
        if name not in table:
            raise ValueError(f"must be one of {', '.join(table)}, got {name!r}")
        return name

    return AfterValidator(check)


AddedFault = Annotated[str, AfterValidator(_of_a_fault)]
Setting = float | int | str | None  # value of a sensor setting
Observation = Literal["window", "event_image", "luminance", "events", "none"]
Split = Literal["train", "validation", "eval"]
LUMINANCE_FLOOR = 1e-3  # for luminance without quantization steps, such as rendered luminance
WITHOUT_EVENTS = ("luminance", "none")  # observations for which no event camera is simulated


@dataclass(frozen=True, config=STRICT)
class CameraConfig:
    """The event camera: geometry, response and thresholds.

    Attributes:
        width, height: Pixels of the sensor.
        fov_deg: Horizontal field of view [degrees]; pixels are square.
        contrast_threshold: Log-intensity step that fires an ON event (and an OFF event
            unless `contrast_threshold_off` is given).
        contrast_threshold_off: Log-intensity step of OFF events; None: as for ON.
        memory: "reference": each pixel remembers the level of its last event, as a real
            sensor does. "frame": the paper's difference of two frames (equations 5-8),
            which forgets changes below the threshold. "legacy": the paper's published
            code, see `envs.events.camera`.
        luminance_floor: Added to luminance before the logarithm, so that the response to black is
            finite; with response "lin_log", the luminance below which a pixel responds linearly. None:
            chosen for the input: `LUMINANCE_FLOOR`, or more for frames of few grey levels
            (`envs.recordings.light.usual_floor`).
        max_events_per_pixel: Largest number of events of one pixel between two renders; the
            earliest ones fire.
        response: "log": log(luminance + floor). "lin_log": log(luminance) above the floor and
            its tangent below, as photoreceptors respond in the dark.
        excess: Treatment of events beyond `max_events_per_pixel`. "drop": the reference moves on
            past them and their number is reported. "carry": they fire in later frames.
        threshold_mismatch: Standard deviation of the pixels' thresholds as a share of the
            threshold. Each pixel's thresholds are fixed, independent for ON and OFF, and at least
            a tenth of the nominal. Real sensors: about 0.03.
        threshold_seed: Seed of the pixels' thresholds, which identifies one sensor of its kind.
        refractory_us: Refractory period of a pixel after an event [us]; at its end the pixel takes
            the level of that moment as its reference.
        encoding: Conversion of the luminance, white = 1, before the response. "linear32": none.
            "linear8": clipped to [0, 1] and rounded to 8 bits. "gamma8": rounded to 8 bits on
            a scale of gamma 2.2, then decoded.
        cutoff_hz: Bandwidth of the photoreceptors, a first-order low-pass filter on the response
            [Hz]; pixels see the filtered response. 0: no filter.
        cutoff_grows_with_light: Whether `cutoff_hz` is the bandwidth in white, and the bandwidth falls
            linearly with the light to 7 % of `cutoff_hz` in black (v2e).
        latency_us: Time from the crossing of a level to the time of its event [us].
        latency_jitter_us: Standard deviation of the latency from event to event [us].
        readout_hz: Most events per second that leave the sensor; 0: all. Rows take turns, the events
            of a row leave together, and a pixel that waits for its turn fires no other event.
    """

    _plain = model_validator(mode="before")(PLAIN)

    width: Annotated[int, Field(ge=1, le=4096)] = 64
    height: Annotated[int, Field(ge=1, le=4096)] = 64
    fov_deg: Annotated[float, Field(ge=1, le=170)] = 90.0
    contrast_threshold: Annotated[float, Field(ge=1e-6, le=10)] = 0.2
    contrast_threshold_off: Annotated[float, Field(ge=1e-6, le=10)] | None = None
    memory: Literal["reference", "frame", "legacy"] = "reference"
    luminance_floor: Annotated[float, Field(ge=1e-9, le=1)] | None = None
    max_events_per_pixel: Annotated[int, Field(ge=1, le=100_000)] = 100
    response: Literal["log", "lin_log"] = "log"
    threshold_mismatch: Fraction = 0.0
    threshold_seed: Annotated[int, Field(ge=0, lt=2**31)] = 0
    refractory_us: Annotated[int, Field(ge=0, le=10**9)] = 0
    excess: Literal["drop", "carry"] = "drop"
    encoding: Literal["linear32", "linear8", "gamma8"] = "linear32"
    cutoff_hz: Annotated[float, Field(ge=0, le=1e6)] = 0.0
    cutoff_grows_with_light: bool = True
    latency_us: Annotated[int, Field(ge=0, le=10**6)] = 0
    latency_jitter_us: Annotated[float, Field(ge=0, le=1e5)] = 0.0
    readout_hz: Annotated[float, Field(ge=0, le=1e12)] = 0.0

    @field_validator("refractory_us")
    @classmethod
    def _refractory_period_needs_memory(cls, value: int, info: ValidationInfo) -> int:
        if value > 0 and info.data.get("memory", "reference") != "reference":
            raise ValueError(f"needs memory 'reference' or must be 0, got {value}")
        return value

    @field_validator("excess")
    @classmethod
    def _carrying_needs_memory(cls, value: str, info: ValidationInfo) -> str:
        forgets = info.data.get("memory", "reference") != "reference" or info.data.get("refractory_us", 0) > 0
        if value == "carry" and forgets:
            raise ValueError("'carry' needs memory 'reference' and refractory_us 0; use 'drop'")
        return value


def with_floor(camera: CameraConfig, floor: float = LUMINANCE_FLOOR) -> CameraConfig:
    """Return the camera with this luminance floor, unless it has one already."""
    if camera.luminance_floor is not None:
        return camera
    return dataclasses.replace(camera, luminance_floor=floor)


@dataclass(frozen=True, config=STRICT)
class FaultsConfig:
    """Faults of a real sensor. Which pixels are dead or hot is drawn once per episode.

    Attributes:
        sparsity: Fraction of pixels that are dead for the whole episode.
        background_activity: False events as a fraction of the true events (appendix D.3); 0.1 adds
            one false event to ten true ones on average.
        background_activity_hz: False events per pixel and second, as a real sensor produces them
            even in a still scene. Both kinds are added to the other events.
        event_dropout: Probability that a true event is lost, independently for each event.
        displaced: Probability that a true event is reported by a neighbouring pixel.
        flipped: Probability that a true event is reported with the other polarity.
        shot_noise_hz: False events per pixel and second in black, because photons arrive
            unevenly; a quarter of that at white, linear in between (v2e). They are crossings of
            the pixel's own levels, so ON and OFF alternate (`envs.events.pixel_noise`).
        leak_hz: ON events per second of a still pixel, because its level leaks.
        leak_jitter: Standard deviation of the time between two leak events, as a share of its mean.
        noise_spread: Standard deviation over the pixels of the logarithm to base 10 of their rates
            of shot noise and leakage [decades].
        hot_pixel_share: Fraction of pixels that are hot for the whole episode.
        hot_pixel_hz: Events per second of a hot pixel.
        dead_block: Fraction of the image covered by a rectangle of dead pixels. The rectangle has the
            image's proportions and a random place, fixed for the whole episode.
        flicker_depth: Amplitude of the flicker of the scene's light, as a share of the light
            (`envs.events.flicker`); pictures, with their longer exposure, do not show it.
        flicker_hz: Frequency of the flicker: 100 with mains of 50 Hz, 120 with 60 Hz.
        burst_hz: Mean number of bursts of false events that start per second, a Poisson process.
        burst_ms: Length of a burst [ms].
        burst_activity_hz: False events per pixel and second in a burst.
        added: Amount of each fault that a plug-in adds, such as {"flicker": 0.2}; 0: none.
    """

    _plain = model_validator(mode="before")(PLAIN)

    sparsity: Fraction = 0.0
    background_activity: Annotated[float, Field(ge=0, le=100)] = 0.0
    background_activity_hz: Annotated[float, Field(ge=0, le=1e6)] = 0.0
    event_dropout: Fraction = 0.0
    displaced: Fraction = 0.0
    flipped: Fraction = 0.0
    shot_noise_hz: Annotated[float, Field(ge=0, le=1e4)] = 0.0
    leak_hz: Annotated[float, Field(ge=0, le=1e4)] = 0.0
    leak_jitter: Fraction = 0.0
    noise_spread: Annotated[float, Field(ge=0, le=2)] = 0.0
    hot_pixel_share: Fraction = 0.0
    hot_pixel_hz: Annotated[float, Field(ge=0, le=1e6)] = 0.0
    dead_block: Fraction = 0.0
    flicker_depth: Fraction = 0.0
    flicker_hz: Annotated[float, Field(ge=0, le=1e3)] = 0.0
    burst_hz: Annotated[float, Field(ge=0, le=1e3)] = 0.0
    burst_ms: Annotated[float, Field(ge=0, le=1e3)] = 0.0
    burst_activity_hz: Annotated[float, Field(ge=0, le=1e6)] = 0.0
    added: dict[AddedFault, Annotated[float, Field(ge=0, le=1e6)]] = dataclasses.field(default_factory=dict)


@dataclass(frozen=True, config=STRICT)
class FidelityConfig:
    """Required accuracy of the events, for which `envs.fidelity.plan_renders` chooses the cheapest rendering.

    Attributes:
        tolerance: Accepted share of events that differ from the converged simulation in pixel,
            polarity or by more than 5 % of a control step in time, see `envs.event_error`.
        max_step_m: Longest way between two renders [m]; None: chosen.
        samples: Anti-aliasing of the renderer; None: chosen.
        cull_m: Obstacles farther than this are not drawn [m]; None: chosen.
    """

    _plain = model_validator(mode="before")(PLAIN)

    tolerance: Annotated[float, Field(ge=1e-3, le=1)] = 0.05
    max_step_m: Positive | None = None
    samples: Annotated[int, Field(ge=1, le=64)] | None = None
    cull_m: Positive | None = None


# Camera settings that are newer than the first published policies.
LATER_SETTINGS = (
    *("cutoff_hz", "cutoff_grows_with_light"),
    *("latency_us", "latency_jitter_us", "readout_hz"),
)
LATER_FAULTS = (
    *("dead_block", "flicker_depth", "flicker_hz"),
    *("burst_hz", "burst_ms", "burst_activity_hz"),
)
# Newer settings of the environment, with the values that reproduce the older behaviour.
LATER_ENV_SETTINGS: dict[str, object] = {
    **{"vehicle": "kinematic", "body": {}, "task": "corridor"},
    "velocity_noise_mps": 0.0,
}
SECTIONS: dict[str, Any] = {"camera": CameraConfig, "faults": FaultsConfig, "fidelity": FidelityConfig}


@dataclass(frozen=True, config=STRICT)
class EnvConfig:
    """A corridor: the world, the vehicle, the sensor and the observation.

    Attributes:
        scene: Name of a layout in `envs.scene.layouts`, or the path of a mesh file.
        layout: Values that replace fields of the layout, such as {"num_obstacles": 60, "shape": "box",
            "ground_texture": {"pattern": "rings"}}.
        control_hz: Actions (and event windows) per second [Hz].
        speed_mps: Speed [m/s]. A kinematic vehicle keeps it, so one step covers
            speed_mps / control_hz; any other vehicle starts with it.
        vehicle: A row of `VEHICLES`, which turns actions into motion (`envs.vehicles.dynamics`).
        body: Values that replace settings of the vehicle, such as {"tau_s": 0.3}.
        task: A row of `TASKS`: reward and end of an episode (`envs.vehicles.task`).
        action_delay_ms: Time from the choice of an action to the first control step that may take it [ms].
            Until then the vehicle follows earlier choices; at the start it flies straight ahead.
        velocity_noise_mps: Standard deviation of each component of the velocity that the vehicle
            measures (`CorridorEnv.measured_velocity_mps`) [m/s].
        vehicle_radius_m: Radius of the vehicle, a disc [m].
        camera_height_m: Height of the camera above the ground [m].
        time_limit_s: Flight time after which the episode is truncated [s].
        observation: "window", "event_image", "events"; "luminance": one picture a step, without an
            event camera; or "none": nothing is rendered, for an agent that needs no observation.
        window_capacity: Largest number of events in one window; the oldest events beyond it are
            dropped and counted. None: a window holds all events of its step.
        filter_support: Smallest number of a pixel's 8 neighbours that must have fired shortly before its
            event, or the event is not observed (`core.neighbour_filter`); 0: no filter.
        filter_tau_us: Longest time since a neighbour fired that counts as shortly before [us].
        split: Set of corridors; corridors of one split never occur in another, whatever the seed.
        renderer: "raycast", "pyrender", "spheres" (hundreds of spheres, approximated:
            `envs.raycast.discs`), or "auto": "raycast" unless the scene has a mesh.
    """

    _plain = model_validator(mode="before")(PLAIN)

    scene: str = "poles"
    layout: dict[str, Value] = dataclasses.field(default_factory=dict)
    control_hz: Annotated[float, Field(ge=0.1, le=1e6)] = 200.0
    speed_mps: Annotated[float, Field(gt=0, le=1e6)] = 20.0
    vehicle: Annotated[str, _row_of(VEHICLES)] = "kinematic"
    body: dict[str, Value] = dataclasses.field(default_factory=dict)
    task: Annotated[str, _row_of(TASKS)] = "corridor"
    action_delay_ms: Annotated[float, Field(ge=0, le=1000)] = 0.0
    velocity_noise_mps: Annotated[float, Field(ge=0, le=1000)] = 0.0
    vehicle_radius_m: Annotated[float, Field(ge=0, le=10)] = 0.3
    camera_height_m: Annotated[float, Field(ge=0, le=1000)] = 2.0
    time_limit_s: Positive = 10.0
    observation: Observation = "window"
    window_capacity: Annotated[int, Field(ge=1, le=10_000_000)] | None = 4096
    filter_support: Annotated[int, Field(ge=0, le=8)] = 0
    filter_tau_us: Annotated[int, Field(ge=0, le=10**9)] = 5_000
    split: Split = "train"
    renderer: Literal["auto", "raycast", "pyrender", "spheres"] = "auto"
    camera: CameraConfig = dataclasses.field(default_factory=lambda: with_floor(CameraConfig()))
    faults: FaultsConfig = dataclasses.field(default_factory=FaultsConfig)
    fidelity: FidelityConfig = dataclasses.field(default_factory=FidelityConfig)

    @property
    def delay_steps(self) -> int:
        """Number of control steps from an observation to its action."""
        steps = 1e-3 * self.action_delay_ms * self.control_hz
        return math.ceil(steps * (1 - 1e-12))  # 3 * 1e-3 * 1000 is above 3

    @field_validator("camera", "faults", "fidelity", mode="before")
    @classmethod
    def _by_name(cls, value: Any, info: ValidationInfo) -> Any:
        """Create a section from a mapping of its fields, which is how a policy's manifest stores it."""
        return SECTIONS[str(info.field_name)](**value) if isinstance(value, Mapping) else value

    @field_validator("camera")
    @classmethod
    def _rendered(cls, value: CameraConfig) -> CameraConfig:
        return with_floor(value)


def hashed_settings(config: EnvConfig) -> dict[str, Any]:
    """Return all settings as plain containers, to be hashed.

    `LATER_ENV_SETTINGS` and `LATER_FAULTS` are included only if they change something, so that older hashes
    stay valid.
    """
    settings = dataclasses.asdict(config)
    faults = settings["faults"]
    settings["faults"] = {name: faults[name] for name in faults if name not in LATER_FAULTS or faults[name]}
    return {name: value for name, value in settings.items() if LATER_ENV_SETTINGS.get(name, ...) != value}


def seen_settings(config: EnvConfig, observation: str) -> EnvConfig:
    """Return the settings that an observation depends on; all others are set to their defaults.

    Two simulations for which this function returns equal settings give the same episodes, step by step, to
    an agent that observes "luminance" (whatever the event camera) or "none" (whatever the camera). For other
    observations every setting may matter.
    """
    if observation not in WITHOUT_EVENTS:
        return config
    lens = {name: getattr(config.camera, name) for name in ("width", "height", "fov_deg")}
    seen = dataclasses.replace(
        config,
        observation=cast(Observation, observation),
        window_capacity=EnvConfig.window_capacity,
        velocity_noise_mps=EnvConfig.velocity_noise_mps,
        filter_support=EnvConfig.filter_support,
        filter_tau_us=EnvConfig.filter_tau_us,
        camera=CameraConfig(**lens),
        faults=FaultsConfig(),
        fidelity=dataclasses.replace(config.fidelity, max_step_m=None),
    )
    if observation == "none":
        seen = dataclasses.replace(seen, camera=CameraConfig(), fidelity=FidelityConfig(), renderer="auto")
    return seen


def sensor_settings(config: EnvConfig) -> dict[str, Setting]:
    """Return the settings that give an event its meaning; data, encoder and policy must share them.

    They include the neighbour filter only if it is on, the vehicle only if it is not kinematic, and each of
    `LATER_SETTINGS` only if it is not the default, so that hashes from before those settings stay valid.
    """
    camera = dataclasses.asdict(config.camera)
    for name in LATER_SETTINGS:
        if camera[name] == getattr(CameraConfig, name):
            del camera[name]
    own: dict[str, Any] = {"control_hz": config.control_hz, "speed_mps": config.speed_mps}
    if config.filter_support > 0:
        own |= {"filter_support": config.filter_support, "filter_tau_us": config.filter_tau_us}
    if config.vehicle != "kinematic":
        own |= {"vehicle": config.vehicle, "body": dict(config.body)}
    return {**camera, **own, **dataclasses.asdict(config.fidelity)}


def sensor_differences(theirs: Mapping[str, object], config: EnvConfig) -> dict[str, tuple[object, object]]:
    """Return the sensor settings that differ: setting -> (their value, this simulation's value)."""
    ours = sensor_settings(config)
    pairs = {key: (theirs.get(key), ours.get(key)) for key in {**theirs, **ours}}
    return {key: pair for key, pair in pairs.items() if pair[0] != pair[1]}


def settings_hash(settings: Mapping[str, object]) -> str:
    """Return the first 12 hexadecimal digits of the SHA-256 of `settings` as canonical JSON."""
    text = json.dumps(settings, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:12]
