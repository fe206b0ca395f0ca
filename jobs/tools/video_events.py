"""The events that the configured camera would have seen of a video or a folder of images, as a file.

Run: python -m platform.launch +exp=video_events video_events.path=ride.mp4 camera=davis346 light=night
Expect: seconds to minutes. A line of numbers and the file, with labels of noise where its format holds them.
"""

import dataclasses
import warnings
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from envs.config import STRICT, EnvConfig
from envs.recordings import video_to_events, write_events
from envs.recordings.event_file import EventFile
from envs.recordings.formats import LABELLED, WRITERS, WRITTEN_SUFFIXES
from jobs.analysis.tables import show_table
from jobs.config.config import Config, ConfigError
from jobs.config.schema import Name
from jobs.run.folder import open_run
from jobs.run.progress import console

SECOND_US = 1_000_000
HEADINGS = (
    *("Video", "Pixels", "Seconds", "Events", "per pixel [Hz]"),
    *("ON [%]", "Noise [%]", "Lost", "Missed [%]"),
)


@dataclass(frozen=True, config=STRICT)
class Settings:
    """Which video becomes events. The camera is that of the environment, and so are its size and its faults.

    Attributes:
        path: A video, or a folder of images, as `envs.recordings.video_steps` reads them.
        output: The event file, of the format that its suffix names; None: events.npz in the run folder.
        fps: Frames per second, in place of the times that the video or the folder has [Hz].
        transfer: How values become light; None: floating point is linear, whole numbers are sRGB.
        interpolate: What is taken to be between two frames.
        luminance_floor: Of the camera, in place of its own, white = 1; None: what is right for the frames
            (`envs.recordings.light.usual_floor`).
    """

    path: Name
    output: Name | None
    fps: Annotated[float, Field(gt=0)] | None
    transfer: Literal["srgb", "linear"] | None
    interpolate: Literal["linear", "flow"]
    luminance_floor: Annotated[float, Field(ge=1e-9, le=1)] | None


def run(config: Config) -> Path:
    """Write the events of `video_events.path` as the configured camera would report them; return their file.

    Raises:
        ConfigError: The video is refused, or `video_events.output` cannot hold its events.
    """
    output = Path(config.own.output or open_run(config).path / "video" / "events.npz")
    kind = WRITTEN_SUFFIXES.get(output.suffix.lower(), "")
    if kind not in WRITERS:
        known = ", ".join(suffix for suffix, name in WRITTEN_SUFFIXES.items() if name in WRITERS)
        raise ConfigError(f"video_events.output: must end in one of {known}, got {output.name!r}")
    file = seen(config.own, config.env, np.random.default_rng(config.seed))
    labels = file.is_noise if kind in LABELLED else None
    camera = config.env.camera
    try:
        write_events(output, file.events, camera.width, camera.height, is_noise=labels)
    except (ValueError, OSError) as error:
        raise ConfigError(f"video_events.output: {error}") from error
    unlabelled = "" if kind in LABELLED else f" ({kind} holds no labels of noise; npz and hdf5 do)"
    console.print(f"Events: {output}{unlabelled}", markup=False)
    return output


def seen(chosen: Settings, env: EnvConfig, rng: np.random.Generator) -> EventFile:
    """The events of a video, after a line of numbers and what is to be warned of."""
    try:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always", UserWarning)
            file = video_to_events(
                chosen.path,
                dataclasses.replace(env.camera, luminance_floor=chosen.luminance_floor),
                env.faults,
                transfer=chosen.transfer,
                fps=chosen.fps,
                interpolate=chosen.interpolate,
                rng=rng,
            )
    except (ValueError, OSError, RuntimeError) as error:
        raise ConfigError(f"video_events.path: {error}") from error
    show_table("The events of a video", HEADINGS, [line(Path(chosen.path).name, file)])
    for warning in said:
        console.print(str(warning.message), markup=False)
    return file


def line(name: str, file: EventFile) -> tuple[str, ...]:
    """A row of the table."""
    events, width, height = file.events, file.width or 0, file.height or 0
    span_s = (int(events["t"][-1]) - int(events["t"][0])) / SECOND_US if events.size else 0.0
    return (
        name,
        f"{width}x{height}",
        f"{span_s:.2f}",
        f"{events.size:,}",
        f"{events.size / (width * height) / span_s:.2f}" if span_s else "-",
        percent(events["p"] > 0),
        percent(np.asarray(file.is_noise)),
        f"{file.dropped:,}",
        "-" if file.missed is None else f"{100 * file.missed:.0f}",
    )


def percent(which: np.ndarray) -> str:
    """The share of what is true."""
    return f"{100 * np.mean(which):.1f}" if which.size else "-"
