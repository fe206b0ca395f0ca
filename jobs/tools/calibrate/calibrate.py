"""Fit the settings of the simulated camera to a recording, and write them as a file of conf/camera.

Run: python -m platform.launch +exp=calibrate calibrate.recording=events.txt calibrate.frames=images.txt
Expect: seconds to minutes. A table of settings with their intervals; the file `calibrate/camera.yaml` and the
hot pixels in the run folder; with frames also a table and a figure that compare simulated with recorded
events.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import numpy as np
from matplotlib.figure import Figure
from pydantic import Field
from pydantic.dataclasses import dataclass

from envs.config import LUMINANCE_FLOOR, STRICT, CameraConfig, FaultsConfig, with_floor
from envs.recordings.event_file import EventFile
from jobs.analysis.colours import AMBER, BLUE, GREEN, INK
from jobs.analysis.plots import tidy
from jobs.analysis.tables import save_plot, show_table, write_csv
from jobs.config.config import Config
from jobs.config.schema import Name
from jobs.run.files import write_atomic
from jobs.run.folder import open_run
from jobs.run.progress import console
from jobs.run.provenance import REPOSITORY
from jobs.run.recordings import refusing
from jobs.tools.calibrate.camera_file import camera_text, unit
from jobs.tools.calibrate.estimate import Calibration, estimate, settings
from jobs.tools.calibrate.footage import Footage, simulate, still_footage
from jobs.tools.calibrate.found import Found
from jobs.tools.calibrate.likeness import INTERVALS_MS, Likeness, likeness
from jobs.tools.calibrate.sources import frames_beside, read_frames, read_source

OF_LIGHT = ("response", "luminance_floor")
OF_STILL = ("contrast_threshold", "contrast_threshold_off", "refractory_us")
HEADINGS = ("Setting", "Value", "95 % interval", "Not found, because")
SIMULATED = (
    *("Events", "per pixel [Hz]", "ON [%]", "Same polarity [%]", "Median interval [ms]"),
    *("Neighbours, r", "Recorded, r"),
)


@dataclass(frozen=True, config=STRICT)
class Settings:
    """The recording to calibrate against.

    Attributes:
        recording: An event file in any format that `envs.recordings.read_events` reads.
        frames: Text file with a line "seconds picture" for each frame of the same sensor, with the clock of
            the events. None: the event file's own frames; without these the scene was still and uniform.
        frame_delay_us: Delay from the time of a frame to the middle of its exposure [us].
        luminance: Luminance of a still scene, white = 1.
        camera: Name of the file to write in conf/camera; None: only the file in the run folder.
    """

    recording: Name
    frames: Name | None
    frame_delay_us: Annotated[int, Field(ge=-1_000_000, le=1_000_000)]
    luminance: Annotated[float, Field(gt=0, le=1)]
    camera: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$")] | None


def run(config: Config) -> Calibration:
    """Calibrate against `calibrate.recording`; return the settings.

    Raises:
        ConfigError: The recording or its frames are invalid, or there are too few events.
    """
    chosen, camera = config.own, config.env.camera
    frames: Footage | None
    with refusing("calibrate.recording", chosen.recording):
        if chosen.frames:
            frames = read_frames(chosen.frames, chosen.frame_delay_us)
        else:
            frames = frames_beside(chosen.recording, chosen.frame_delay_us, config.recording)
        file = read_source(chosen.recording, frames, config.recording)
        footage = within(frames or _still(file, chosen.luminance), file.events)
        taken = assumed(camera, footage.is_still)
        calibration = estimate(file.events, footage, taken, config.seed)
    name = Path(chosen.recording).name
    show_table(
        f"The camera of {name}", HEADINGS, [line(*pair) for pair in calibration.found.items()], words=4
    )
    folder = open_run(config).path / "calibrate"
    text = camera_text(calibration, name, taken)
    write_atomic(folder / "camera.yaml", text)
    y, x = np.nonzero(calibration.hot)
    write_csv(folder / "hot_pixels.csv", ("x", "y"), [*zip(x, y, strict=True)])
    if frames is not None and len(footage.times_us) > 2:
        _compare(config, calibration, footage, file.events, folder)
    if chosen.camera is not None:
        write_atomic(REPOSITORY / "conf" / "camera" / f"{chosen.camera}.yaml", text)
        console.print(f"Take it with: camera={chosen.camera}")
    console.print(f"Written: {folder / 'camera.yaml'}")
    return calibration


def line(name: str, part: Found) -> tuple[str, ...]:
    """Return a text for each of `HEADINGS`."""
    if part.value is None:
        return name, "-", "-", part.reason
    return name + unit(name), f"{part.value:.3g}", f"{part.low:.3g} to {part.high:.3g}", ""


def _still(file: EventFile, luminance: float) -> Footage:
    """Return the frames of a still scene that lasts as long as the events."""
    if not len(file.events) or file.height is None or file.width is None:
        raise ValueError("has no events")
    span_us = int(file.events["t"][0]) - 1, int(file.events["t"][-1])
    return still_footage((file.height, file.width), luminance, span_us)


def within(footage: Footage, events: np.ndarray) -> Footage:
    """Return the frames during which events were recorded.

    Raises:
        ValueError: There are fewer than two such frames.
    """
    first, last = (int(events["t"][k]) for k in (0, -1)) if len(events) else (0, -1)
    kept = (footage.times_us >= first - 1) & (footage.times_us <= last)
    if kept.sum() < 2:
        raise ValueError(
            f"must have two frames between its first and last event, {first} and {last} us; "
            f"got {kept.sum()}, of frames from {footage.times_us[0]} to {footage.times_us[-1]} us"
        )
    return Footage(footage.luminance[kept], footage.times_us[kept])


def assumed(camera: CameraConfig, still: bool) -> CameraConfig:
    """Return a camera with the settings that are assumed to be as configured; all others are ideal.

    These are the conversion of light into a response, and for a still scene also the thresholds and the
    refractory period.
    """
    names = (*OF_LIGHT, *OF_STILL) if still else OF_LIGHT
    return CameraConfig(**{name: getattr(camera, name) for name in names})


def compared(calibration: Calibration, camera: CameraConfig, faults: FaultsConfig) -> dict[str, tuple]:
    """Return name -> camera and faults of the sensors to simulate: ideal, as configured, calibrated."""
    height, width = calibration.hot.shape
    size = {"height": height, "width": width}
    sensors = {"ideal": (with_floor(CameraConfig(**size), LUMINANCE_FLOOR), FaultsConfig())}
    configured = dataclasses.replace(camera, **size), faults
    if configured != sensors["ideal"]:
        sensors["as configured"] = configured
    taken = dataclasses.replace(assumed(camera, still=False), **size)
    return {**sensors, "calibrated": settings(taken, calibration.found)}


def _compare(
    config: Config, calibration: Calibration, footage: Footage, events: np.ndarray, folder: Path
) -> None:
    """Simulate the frames with each camera; print and draw a comparison with the recording."""
    shape, times_us = calibration.hot.shape, footage.times_us[1:]  # levels settle in the first interval
    inside = events[(events["t"] > times_us[0]) & (events["t"] <= times_us[-1])]
    rows = {"recorded": likeness(inside, inside, times_us, shape)}
    for name, (camera, faults) in compared(calibration, config.env.camera, config.env.faults).items():
        made = simulate(footage, camera, faults, config.seed)
        made = made[made["t"] > times_us[0]]
        rows[name] = likeness(made, inside, times_us, shape)
    show_table(
        "Recorded and simulated events", SIMULATED, [(name, *texts(row)) for name, row in rows.items()]
    )
    save_plot(folder / "likeness.png", plot_likeness(rows))
    console.print(f"Drawn: {folder / 'likeness.png'}")


def texts(row: Likeness) -> tuple[str, ...]:
    """Return a text for each of `SIMULATED` except the first."""
    return (
        f"{row.rate_hz:.2f}", f"{100 * row.on_share:.1f}", f"{100 * row.same_share:.1f}",
        f"{row.median_ms:.1f}", f"{row.neighbours:.2f}", f"{row.real:.3f}",
    )  # fmt: skip


def plot_likeness(rows: Mapping[str, Likeness]) -> Figure:
    """Draw intervals between a pixel's events, shares of ON and of equal polarities, and correlations."""
    figure = Figure(figsize=(9.0, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.6, 1.0))
    colours = {"recorded": INK, "ideal": AMBER, "as configured": GREEN, "calibrated": BLUE}
    for name, row in rows.items():
        left.stairs(100 * row.intervals, INTERVALS_MS, color=colours[name], lw=1.8, label=name)
    left.set(xscale="log", xlabel="Interval between two events of a pixel [ms]", ylabel="Share [%]")
    left.legend(frameon=False, fontsize=9)
    shown = ("ON", "same polarity\nas before", "neighbours,\n100 r")
    width = 0.8 / len(rows)
    for place, (name, row) in enumerate(rows.items()):
        heights = [100 * row.on_share, 100 * row.same_share, 100 * row.neighbours]
        right.bar(
            np.arange(3) + width * (place - (len(rows) - 1) / 2), heights, 0.9 * width, color=colours[name]
        )
    right.set(xticks=range(3), xticklabels=shown, ylabel="[%]", ylim=(0, 100))
    for panel in (left, right):
        tidy(panel, "y")
    return figure
