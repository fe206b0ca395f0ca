"""Recordings of real and simulated event cameras: files in and out, and events from video.

`read_events` takes a file of any known format, `write_events` makes one, `video_to_events` turns a
video into events and `downscale_events` makes pixels larger. `Recording` is the simulator's own:
events with the steps and settings that made them.
"""

from envs.recordings.downscale import downscale_events
from envs.recordings.formats import FORMATS, WRITERS, read_events, write_events
from envs.recordings.hdf5 import Recording, read_recording, write_recording
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
