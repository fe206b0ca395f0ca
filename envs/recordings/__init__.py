"""Recordings of real and simulated event cameras: files in and out, and events from video."""

from envs.recordings.formats import (
    FORMATS,
    WRITERS,
    Recording,
    downscale_events,
    read_events,
    read_recording,
    write_events,
    write_recording,
)
from envs.recordings.video import video_to_events

__all__ = [
    "FORMATS",
    "WRITERS",
    "Recording",
    "downscale_events",
    "read_events",
    "read_recording",
    "video_to_events",
    "write_events",
    "write_recording",
]
