"""The event camera: from luminance to events, the faults of its sensor, and windows of events."""

from envs.events.camera import EVENT, EventCamera
from envs.events.faults import RealSensor, apply_faults, draw_pixel_faults
from envs.events.windows import event_image, pack_window, unpack_window

__all__ = [
    "EVENT",
    "EventCamera",
    "RealSensor",
    "apply_faults",
    "draw_pixel_faults",
    "event_image",
    "pack_window",
    "unpack_window",
]
