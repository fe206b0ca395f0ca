"""Every setting of the world and its sensor: names, units, ranges, defaults.

One `EnvConfig` describes one simulation completely. Construction is the border: a value
of the wrong type, out of range, NaN or infinite raises `pydantic.ValidationError` (a
ValueError) that names the key, the value and the rule; an unknown key does too.
"""

import dataclasses
import hashlib
import json
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)

Positive = Annotated[float, Field(gt=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]


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
            which forgets what stayed below the threshold.
        luminance_floor: Added to luminance before the logarithm, so that black is defined.
        max_events_per_pixel: Most events of one pixel between two renders; the excess is
            dropped, the reference moves on, and the number dropped is reported.
    """

    width: Annotated[int, Field(ge=1, le=4096)] = 64
    height: Annotated[int, Field(ge=1, le=4096)] = 64
    fov_deg: Annotated[float, Field(ge=1, le=170)] = 90.0
    contrast_threshold: Annotated[float, Field(ge=1e-6, le=10)] = 0.2
    contrast_threshold_off: Annotated[float, Field(ge=1e-6, le=10)] | None = None
    memory: Literal["reference", "frame"] = "reference"
    luminance_floor: Annotated[float, Field(ge=1e-9, le=1)] = 1e-3
    max_events_per_pixel: Annotated[int, Field(ge=1, le=100_000)] = 100


@dataclass(frozen=True, config=STRICT)
class FaultsConfig:
    """What a real sensor does wrong, fixed or drawn anew for each episode.

    Attributes:
        sparsity: Fraction of pixels that are dead for the whole episode.
        background_activity: Events without cause, as a fraction of the true events
            (appendix D.3); 0.1 adds one false event to ten true ones on average.
        background_activity_hz: Events without cause per pixel and second, as a real
            sensor makes them, also in a still scene.
    """

    sparsity: Fraction = 0.0
    background_activity: Annotated[float, Field(ge=0, le=100)] = 0.0
    background_activity_hz: Annotated[float, Field(ge=0, le=1e6)] = 0.0


@dataclass(frozen=True, config=STRICT)
class RendererConfig:
    """How the scene becomes luminance.

    Attributes:
        name: "raycast", "pyrender", or "auto": the cheapest that can draw the scene.
        max_step_m: Longest way flown between two renders [m]; a longer control step is
            rendered in equal parts, so that events do not depend on the control rate.
    """

    name: Literal["auto", "raycast", "pyrender"] = "auto"
    max_step_m: Positive = 0.1


@dataclass(frozen=True, config=STRICT)
class EnvConfig:
    """A corridor flight: the world, the vehicle, the sensor and the observation.

    Attributes:
        scene: Name of a layout in `envs.scene`.
        layout: Values that replace the layout's own, such as {"num_poles": 60}.
        control_hz: Actions (and event windows) per second [Hz].
        speed_mps: Constant speed [m/s]; the way of one step is speed_mps / control_hz.
        vehicle_radius_m: The vehicle is a disc of this radius [m].
        camera_height_m: Height of the camera above the ground [m].
        time_limit_s: Flight time after which the episode is truncated [s].
        observation: "window", "event_image", "luminance" or "events".
        window_capacity: Most events that one window holds; the oldest beyond it are
            dropped and counted.
        split: Which corridors: those of one split never occur in another, whatever the seed.
    """

    scene: str = "poles"
    layout: dict[str, float] = dataclasses.field(default_factory=dict)
    control_hz: Annotated[float, Field(ge=0.1, le=1e6)] = 200.0
    speed_mps: Annotated[float, Field(gt=0, le=1e6)] = 20.0
    vehicle_radius_m: Annotated[float, Field(ge=0, le=10)] = 0.3
    camera_height_m: Annotated[float, Field(ge=0, le=1000)] = 2.0
    time_limit_s: Positive = 10.0
    observation: Literal["window", "event_image", "luminance", "events"] = "window"
    window_capacity: Annotated[int, Field(ge=1, le=10_000_000)] = 4096
    split: Literal["train", "validation", "eval"] = "train"
    camera: CameraConfig = dataclasses.field(default_factory=CameraConfig)
    faults: FaultsConfig = dataclasses.field(default_factory=FaultsConfig)
    renderer: RendererConfig = dataclasses.field(default_factory=RendererConfig)


def sensor_settings(config: EnvConfig) -> dict[str, Any]:
    """The settings that give an event its meaning: data, encoder and policy must share them."""
    flight = {"control_hz": config.control_hz, "speed_mps": config.speed_mps}
    return {**dataclasses.asdict(config.camera), **flight, "max_step_m": config.renderer.max_step_m}


def sensor_differences(theirs: dict[str, Any], config: EnvConfig) -> dict[str, tuple[Any, Any]]:
    """Setting -> (their value, this simulation's value), for the sensor settings that differ."""
    ours = sensor_settings(config)
    pairs = {key: (theirs.get(key), ours.get(key)) for key in {**theirs, **ours}}
    return {key: pair for key, pair in pairs.items() if pair[0] != pair[1]}


def settings_hash(settings: dict[str, Any]) -> str:
    """First 12 hexadecimal digits of the SHA-256 of `settings` as canonical JSON."""
    text = json.dumps(settings, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:12]
