"""Conditions and axes of a sweep in words, the same on every page and figure."""

from collections.abc import Callable

from jobs.config.conditions import NOMINAL

WORLDS = {
    "poles_eval": "nothing changed",
    "poles": "poles as in training",
    "poles_dense": "more poles",
    "texture_change": "other textures",
    "shape_change": "other shapes",
    "dynamic": "moving textures",
}
MEMORIES = {
    "reference": "memory in each pixel",
    "frame": "two-frame camera",
    "legacy": "camera of the published code",
}
NOISE = {"0": "no sensor noise", "0.1": "noise by day", "5": "noise by night"}


def _percent(value: str) -> str:
    return f"{100 * float(value):g} %"


# Axis -> a value of it in words.
WORDS: dict[str, Callable[[str], str]] = {
    NOMINAL: lambda value: "nothing changed",
    "control_hz": lambda value: f"{value} Hz",
    "control_hz_dense": lambda value: f"more poles, {value} Hz",
    "contrast_threshold": lambda value: f"threshold {value}",
    "sparsity": lambda value: f"{_percent(value)} dead pixels",
    "background_activity": lambda value: f"{_percent(value)} false events",
    "sensor_noise": lambda value: NOISE.get(value, f"shot noise of {value} Hz"),
    "world": lambda value: WORLDS.get(value, value),
    "scene": lambda value: WORLDS.get(value, value),
    "memory": lambda value: MEMORIES.get(value, f"memory {value}"),
    "memory_400hz": lambda value: f"{MEMORIES.get(value, f'memory {value}')}, 400 Hz",
    "action_delay": lambda value: f"actions {value} ms late",
    "worst": lambda value: "nothing changed" if value == "200" else f"several at once, {value} Hz",
    "pixels": lambda value: f"memory in each pixel, {value} Hz",
    "speed": lambda value: f"{value} m/s",
}
# Axis of numbers -> what is varied, with its unit.
TITLES = {
    "control_hz": "Control rate [Hz]",
    "control_hz_dense": "Among more poles [Hz]",
    "contrast_threshold": "Threshold [log intensity]",
    "sparsity": "Share of dead pixels",
    "background_activity": "False events per true one",
    "action_delay": "Delay of actions [ms]",
}


def condition_text(axis: str, value: str) -> str:
    """A condition in words; of an axis without any, its name and the value."""
    return WORDS[axis](value) if axis in WORDS else f"{axis} {value}"
