"""Recordings of real and simulated event cameras: files in and out, and events from video.

`read_events` takes a file of any known format, `write_events` makes one; `read_parts` and `event_writer`
do so part by part. `video_to_events` turns a video into events, and `downscale_events` makes pixels
larger. `Recording` is the simulator's own: events with the steps and settings behind them.
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
