"""Conditions and axes in words, the same on every page and figure."""

from collections.abc import Callable

from jobs.config.conditions import NOMINAL
from jobs.study.results import Condition, Value, text_of

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
NOISE: dict[Value, str] = {0.0: "no sensor noise", 0.1: "noise by day", 5.0: "noise by night"}


def _percent(value: Value) -> str:
    return f"{100 * float(value):g} %"


def _memory(value: Value) -> str:
    return MEMORIES.get(str(value), f"memory {value}")


# Axis -> function that returns one of its values in words.
WORDS: dict[str, Callable[[Value], str]] = {
    NOMINAL: lambda value: "nothing changed",
    "control_hz": lambda value: f"{text_of(value)} Hz",
    "control_hz_dense": lambda value: f"more poles, {text_of(value)} Hz",
    "contrast_threshold": lambda value: f"threshold {text_of(value)}",
    "sparsity": lambda value: f"{_percent(value)} dead pixels",
    "background_activity": lambda value: f"{_percent(value)} false events",
    "sensor_noise": lambda value: NOISE.get(value, f"shot noise of {text_of(value)} Hz"),
    "world": lambda value: WORLDS.get(str(value), str(value)),
    "scene": lambda value: WORLDS.get(str(value), str(value)),
    "memory": _memory,
    "memory_400hz": lambda value: f"{_memory(value)}, 400 Hz",
    "action_delay": lambda value: f"actions {text_of(value)} ms late",
    "worst": lambda value: "nothing changed" if value == 200 else f"several at once, {text_of(value)} Hz",
    "pixels": lambda value: f"memory in each pixel, {text_of(value)} Hz",
    "speed": lambda value: f"{text_of(value)} m/s",
}
# Numeric axis -> its label with the unit.
TITLES = {
    "control_hz": "Control rate [Hz]",
    "control_hz_dense": "Among more poles [Hz]",
    "contrast_threshold": "Threshold [log intensity]",
    "sparsity": "Share of dead pixels",
    "background_activity": "False events per true one",
    "action_delay": "Delay of actions [ms]",
}


def condition_text(at: Condition) -> str:
    """Return a condition in words; axis name and value if `WORDS` lacks the axis."""
    axis, value = at
    return WORDS[axis](value) if axis in WORDS else f"{axis} {text_of(value)}"
