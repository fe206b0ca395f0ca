"""Recordings of real and simulated event cameras: files in and out, and events from video.

`read_events` reads a file of any known format, `write_events` writes one; `read_parts` and `event_writer`
do so part by part. `video_to_events` converts a video to events, and `downscale_events` reduces the
resolution. `Recording` is the simulator's own format: events with the steps and settings that produced them.
"""

from envs.recordings.beside import IMU, Frame, read_frames, read_imu
from envs.recordings.downscale import downscale_events
from envs.recordings.formats import FORMATS, WRITERS
from envs.recordings.hdf5 import Recording, read_recording, write_recording
from envs.recordings.reading import read_events, read_parts
from envs.recordings.video import video_to_events
from envs.recordings.writing_events import event_writer, write_events

__all__ = [
    "FORMATS",
    "IMU",
    "WRITERS",
    "Frame",
    "Recording",
    "downscale_events",
    "event_writer",
    "read_events",
    "read_frames",
    "read_imu",
    "read_parts",
    "read_recording",
    "video_to_events",
    "write_events",
    "write_recording",
]
