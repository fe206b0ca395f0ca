"""Select the settings that name a run folder. Folders of older versions keep their names."""

import dataclasses
from collections.abc import Iterator
from typing import Any

from envs.config import EnvConfig
from jobs.config.algorithms import AlgoConfig
from jobs.config.config import SECTIONS, Config, as_dict
from jobs.config.env_keys import ENV_FIELDS, ENV_GROUPS
from jobs.config.plugins import plugin_digests
from models.kinds import ADDED_MODEL_SETTINGS

# The settings that can change what is trained: not the job, nor where a run is computed and recorded.
TRAINED_BY = (
    *("exp", "budget", "seed", "env", "camera", "faults", "renderer", "fidelity"),
    *("model", "algo", "collect", "pretrain", "train"),
)
HASHED = (*TRAINED_BY, "recording")
# The hash has always covered these fields, also at their defaults. Every other field counts only if it
# differs from its default, so a field that is added to a class renames no folder and needs no row here.
FIRST = {
    "env": "scene layout control_hz speed_mps action_delay_ms vehicle_radius_m camera_height_m time_limit_s "
    "window_capacity",
    "camera": "width height fov_deg contrast_threshold contrast_threshold_off memory luminance_floor "
    "max_events_per_pixel response threshold_mismatch threshold_seed refractory_us excess encoding",
    "faults": "sparsity background_activity background_activity_hz event_dropout shot_noise_hz leak_hz "
    "hot_pixel_share hot_pixel_hz",
    "fidelity": "tolerance max_step_m samples cull_m",
}
CLASSES: dict[str, type[Any]] = {"env": EnvConfig, "algo": AlgoConfig, **ENV_GROUPS, **SECTIONS}
# Settings of two jobs, which older versions hashed for every run: section -> name in the hash, values.
ALWAYS: dict[str, tuple[str, dict[str, object]]] = {
    "replay": ("replay", {"recording": "events.raw", "policy": "bytestream_hold-s0"}),
    "video_events": (
        "video",
        {
            "path": "video.mp4",
            "output": None,
            "fps": None,
            "transfer": None,
            "interpolate": "linear",
            "luminance_floor": None,
        },
    ),
}


def _later(section: str, cls: type[Any]) -> Iterator[tuple[str, object]]:
    """Yield name and default of each field of a section that `FIRST` does not name."""
    first = FIRST.get(section, "").split()
    for field in dataclasses.fields(cls):
        default = field.default
        if field.default_factory is not dataclasses.MISSING:
            default = field.default_factory()
        elsewhere = section == "env" and field.name not in ENV_FIELDS
        if field.name not in first and not elsewhere and default is not dataclasses.MISSING:
            yield field.name, default


# Section -> the fields that older run folders lack, each with the value that reproduces the old behaviour.
ADDED_SETTINGS = {name: dict(_later(name, cls)) for name, cls in CLASSES.items() if name in HASHED}
ADDED_SETTINGS["model"] = ADDED_MODEL_SETTINGS


def identity(config: Config) -> dict[str, Any]:
    """Return the settings whose hash names the run folder.

    The content of plug-ins counts: another version of a plug-in is another experiment. A job's own settings
    do not count, except those in `ALWAYS`.
    """
    values: dict[str, Any] = as_dict(config)
    settings = {name: values[name] for name in HASHED}
    for section, added in ADDED_SETTINGS.items():
        own = settings[section].items()
        settings[section] = {name: value for name, value in own if added.get(name, ...) != value}
    if not settings["recording"]:
        del settings["recording"]
    for job, (name, usual) in ALWAYS.items():
        own = values.get(job, {}).items()  # of newer fields only those that are not null
        settings[name] = usual | {key: value for key, value in own if key in usual or value is not None}
    if config.plugins:
        settings["plugins"] = plugin_digests()
    return settings
