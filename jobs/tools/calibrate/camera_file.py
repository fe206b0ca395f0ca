"""Write a calibration as a file of conf/camera."""

from envs.config import CameraConfig
from jobs.tools.calibrate.estimate import DEAD, OFF, ON, Calibration
from jobs.tools.calibrate.found import Found

UNITS = {"hz": " [Hz]", "us": " [us]"}


def camera_text(calibration: Calibration, source: str, taken: CameraConfig) -> str:
    """Return the text of a file in conf/camera; comments name the settings that could not be estimated.

    Args:
        calibration: The estimated settings.
        source: Name of the recording, for the header of the file.
        taken: The assumed camera.
    """
    height, width = calibration.hot.shape
    absent = [
        f"# {name}: not found, {part.reason}"
        for name, part in calibration.found.items()
        if part.value is None
    ]
    groups: dict[str, list[str]] = {
        "camera": [f"  width: {width}  # [pixels]", f"  height: {height}  # [pixels]"],
        "faults": [],
    }
    groups["camera"] += [f"  {key}: {value}  # assumed" for key, value in assumptions(calibration, taken)]
    for name, part in calibration.found.items():
        if part.value is not None:
            group, key = name.split(".")
            groups[group].append(
                f"  {key}: {value_text(name, part)}  # 95 %: {part.low:.3g} to {part.high:.3g}{unit(key)}"
            )
    lines = ["# @package _global_", f"# Found in {source} by +exp=calibrate.", *absent]
    lines += ["defaults: [paper@camera, _self_]  # what is not named here"]
    for group, rows in groups.items():
        lines += [f"{group}:", *rows] if rows else []
    return "\n".join(lines) + "\n"


def assumptions(calibration: Calibration, taken: CameraConfig) -> list[tuple[str, object]]:
    """Return keys and values of the settings that were assumed instead of estimated."""
    keys = ["response", "luminance_floor"]
    if calibration.found[ON].value is None:
        keys += [
            name.removeprefix("camera.") for name in (ON, OFF, DEAD) if calibration.found[name].value is None
        ]
    values = [(key, getattr(taken, key)) for key in keys]
    return [(key, "null" if value is None else value) for key, value in values]


def value_text(name: str, part: Found) -> str:
    """Return a value as YAML: the dead time in whole microseconds, others with three digits."""
    if name == DEAD:
        return str(round(part.value or 0.0))
    text = f"{part.value:.3g}"
    return text if any(mark in text for mark in ".e") else f"{text}.0"


def unit(key: str) -> str:
    """Return the unit in brackets that the end of a key implies; "" if there is none."""
    return UNITS.get(key.rsplit("_", 1)[-1], "")
