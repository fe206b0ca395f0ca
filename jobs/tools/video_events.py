"""Convert a video or a folder of images to the events that the configured camera would see.

Run: python -m platform.launch +exp=video_events video_events.path=ride.mp4 camera=davis346 light=night
Expect: seconds to minutes. A line of numbers and the file, with noise labels if the format supports them.
"""

import dataclasses
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from envs.config import STRICT
from envs.recordings import event_writer
from envs.recordings.formats import LABELLED, WRITTEN_SUFFIXES
from envs.recordings.video import VideoStep, video_steps
from jobs.analysis.tables import show_table
from jobs.config.config import Config, ConfigError
from jobs.config.schema import Name
from jobs.run.folder import open_run
from jobs.run.progress import console

SECOND_US = 1_000_000
TELL_EVERY_S = 10.0
HEADINGS = (
    *("Video", "Pixels", "Seconds", "Events", "per pixel [Hz]"),
    *("ON [%]", "Noise [%]", "Lost", "Missed [%]"),
)


@dataclass(frozen=True, config=STRICT)
class Settings:
    """The video to convert. Camera, size and faults are those of the configured environment.

    Attributes:
        path: A video, or a folder of images, as `envs.recordings.video_steps` reads them.
        output: The event file, in the format of its suffix; None: events.npz in the run folder.
        fps: Frames per second, instead of the times in the video or folder [Hz].
        transfer: Transfer function from values to light; None: linear for floats, sRGB for integers.
        interpolate: Assumption about the light between two frames.
        luminance_floor: Replaces the camera's own floor, white = 1; None: a suitable one for the frames
            (`envs.recordings.light.usual_floor`).
    """

    path: Name
    output: Name | None
    fps: Annotated[float, Field(gt=0)] | None
    transfer: Literal["srgb", "linear"] | None
    interpolate: Literal["linear", "flow"]
    luminance_floor: Annotated[float, Field(ge=1e-9, le=1)] | None


def run(config: Config) -> Path:
    """Write the events of `video_events.path` as the configured camera would report them; return the file.

    Raises:
        ConfigError: The video is invalid, or `video_events.output` cannot store its events.
    """
    output = Path(config.own.output or open_run(config).path / "video" / "events.npz")
    kind = WRITTEN_SUFFIXES.get(output.suffix.lower())
    if kind is None:
        known = ", ".join(WRITTEN_SUFFIXES)
        raise ConfigError(f"video_events.output: must end in one of {known}, got {output.name!r}")
    camera, chosen = config.env.camera, config.own
    steps = video_steps(
        chosen.path,
        dataclasses.replace(camera, luminance_floor=chosen.luminance_floor),
        config.env.faults,
        transfer=chosen.transfer,
        fps=chosen.fps,
        interpolate=chosen.interpolate,
        rng=np.random.default_rng(config.seed),
    )
    size = camera.width, camera.height
    counts, said = write_steps(steps, output, kind, size)
    show_table("The events of a video", HEADINGS, [line(Path(chosen.path).name, size, counts)])
    for warning in said:
        console.print(warning)
    unlabelled = "" if kind in LABELLED else f" ({kind} stores no labels of noise; npz and hdf5 do)"
    console.print(f"Events: {output}{unlabelled}")
    return output


@dataclasses.dataclass
class Counts:
    """Statistics of a video's events, counted while they are written.

    Attributes:
        events, on, noise, dropped: Numbers of events: all, ON, noise, lost.
        first_us, last_us: Times of the first and the last event [us].
        missed: As in `envs.recordings.video.VideoStep`.
    """

    events: int = 0
    on: int = 0
    noise: int = 0
    dropped: int = 0
    first_us: int = 0
    last_us: int = 0
    missed: float | None = None

    def add(self, step: VideoStep) -> None:
        """Count the events of one frame."""
        if step.events.size:
            self.first_us = self.first_us if self.events else int(step.events["t"][0])
            self.last_us = int(step.events["t"][-1])
        self.events += step.events.size
        self.on += int(np.count_nonzero(step.events["p"] > 0))
        self.noise += int(np.count_nonzero(step.is_noise))
        self.dropped += step.dropped
        self.missed = step.missed


def write_steps(
    steps: Iterator[VideoStep], output: Path, kind: str, size: tuple[int, int]
) -> tuple[Counts, list[str]]:
    """Write the events frame by frame, printing progress now and then; return counts and warnings.

    Raises:
        ConfigError: The video is invalid, or the format cannot store its events.
    """
    counts, is_labelled, told = Counts(), kind in LABELLED, time.monotonic()
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", UserWarning)
        try:
            with event_writer(output, *size, kind, is_labelled=is_labelled) as write:
                for number, step in enumerate(_refusing(steps), 1):
                    write(step.events, step.is_noise if is_labelled else None)
                    counts.add(step)
                    if time.monotonic() - told > TELL_EVERY_S:
                        told = time.monotonic()
                        console.print(
                            f"Frame {number:,}, {step.t_us / SECOND_US:.2f} s: "
                            f"{counts.events / 1e6:,.1f} million events",
                        )
        except ConfigError:
            raise
        except (ValueError, OSError) as error:
            raise ConfigError(f"video_events.output: {error}") from error
    return counts, [str(warning.message) for warning in said]


def _refusing(steps: Iterator[VideoStep]) -> Iterator[VideoStep]:
    """Yield the steps of a video; raise ConfigError if it is invalid."""
    try:
        yield from steps
    except (ValueError, OSError, RuntimeError) as error:
        raise ConfigError(f"video_events.path: {error}") from error


def line(name: str, size: tuple[int, int], counts: Counts) -> tuple[str, ...]:
    """Return a row of the table."""
    width, height = size
    span_s = (counts.last_us - counts.first_us) / SECOND_US
    rate = counts.events / (width * height) / span_s if span_s else None
    return (
        name,
        f"{width}x{height}",
        f"{span_s:.2f}",
        f"{counts.events:,}",
        "-" if rate is None else f"{rate:.2f}",
        percent(counts.on, counts.events),
        percent(counts.noise, counts.events),
        f"{counts.dropped:,}",
        "-" if counts.missed is None else f"{100 * counts.missed:.0f}",
    )


def percent(some: int, all_of_them: int) -> str:
    """Return a share in per cent as text; "-" if the whole is 0."""
    return f"{100 * some / all_of_them:.1f}" if all_of_them else "-"
