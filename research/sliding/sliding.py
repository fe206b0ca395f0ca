"""Test a probe fitted in simulation on a real, sliding camera's events: read the depth ahead.

Run: python -m platform.launch +exp=sliding sliding.folder=slider_depth camera=davis240_slider
Expect: a minute or two; a table of correlations between read and true proximity, in simulation and for the
recording, with the ideal and with the configured camera; `sliding/read.png` in the run folder.
"""

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from pydantic import Field
from pydantic.dataclasses import dataclass

from envs.config import STRICT, CameraConfig, EnvConfig, FaultsConfig
from envs.recordings import downscale_events
from envs.scene.range_scan import NEAR_M
from jobs.analysis.colours import AMBER, BLUE, INK
from jobs.analysis.plots import tidy
from jobs.analysis.statistics import CONFIDENCE
from jobs.analysis.tables import markdown_table, save_plot, show_table
from jobs.config.config import Config, ConfigError
from jobs.config.schema import Name, RecordingConfig
from jobs.rollout.policies import find_one_policy
from jobs.run.files import write_atomic
from jobs.run.folder import locate_run, open_run
from jobs.run.progress import console
from jobs.tools.calibrate.footage import Footage, simulate
from jobs.tools.calibrate.sources import read_frames, read_greys, read_source
from jobs.training.real_recordings import cropped
from models.encoder.evae import EventVAE
from models.encoder.weights import load_encoder
from models.policy import load_policy
from research.probe.dataset import SECTORS, ProbeData, column_features, latents, stacked
from research.probe.readout import inner_episodes, ridge
from research.sliding.depth import Lens, distorted, inverse_depth, straightened
from research.sliding.world import Slide, record_slides

SCALE = 10.0  # metres of the simulated world per metre of the recording
KNOWN = 2.0  # least confidence of a depth, as returned by `inverse_depth`
SPAN_S = 0.7  # of the frames for a depth map: the longer, the wider the baseline
EVERY = 2  # use every second one of these frames
BLOCK = 3  # sectors resampled together for intervals, because neighbours see the same obstacles
DRAWS = 2000
STACK = 6  # control steps that are read together
KINDS = {"latents": "latents", "columns": "image columns"}
HEADINGS = ("Events", "Camera", "Read from", "r", "r of the means over time", "Error, share of the usual")


Key = tuple[str, str, str]  # events, camera, what is read


@dataclass(frozen=True, config=STRICT)
class Settings:
    """The recording of a sliding camera, and the policy whose encoder is probed.

    Attributes:
        folder: Folder with images.txt, calib.txt and groundtruth.txt in the format of Mueggler et al.
            (IJRR 2017).
        events: The event file in the folder.
        frame_delay_us: Time from a frame's timestamp to the middle of its exposure [us].
        policy: A name in models/pretrained, "newest", or a path.
        episodes: Simulated episodes to fit the probe.
    """

    folder: Name
    events: Name
    frame_delay_us: Annotated[int, Field(ge=-1_000_000, le=1_000_000)]
    policy: Name
    episodes: Annotated[int, Field(ge=8)]


class Truth(NamedTuple):
    """Depth and motion found from the frames.

    Attributes:
        inverse_per_m: Inverse depth in frames with events, as seen through the lens [1 / m], float64
            (K, H, W); NaN: unknown.
        times_us: Times of these frames [us].
        speed_mps: Speed of the camera to the right [m/s].
        focal: Focal length [pixels].
    """

    inverse_per_m: np.ndarray
    times_us: np.ndarray
    speed_mps: float
    focal: float


class Score(NamedTuple):
    """Agreement of the read proximity with the true proximity; (value, low, high) each.

    Attributes:
        together: Correlation over steps and sectors.
        over_time: Correlation of the means over the steps of an episode.
        error: Squared error, relative to the error of always predicting the mean of training.
        read: The read proximity.
    """

    together: tuple[float, float, float]
    over_time: tuple[float, float, float]
    error: tuple[float, float, float]
    read: np.ndarray


def run(config: Config) -> dict[str, Score]:
    """Fit probes in simulation, apply them to the recording; return the scores.

    Raises:
        ConfigError: A file of the folder cannot be used, or the policy has no event VAE.
    """
    chosen = config.own
    found = find_one_policy("sliding.policy", chosen.policy, config, locate_run(config))
    env = EnvConfig(**load_policy(found.agent).env_fields)
    evae = load_encoder(Path(found.agent) / "encoder.safetensors")[0]
    try:
        truth, footage, events = read_folder(Path(chosen.folder), chosen.events, chosen.frame_delay_us)
    except (ValueError, OSError) as error:
        raise ConfigError(f"sliding.folder: {error}") from error
    camera = seen_through(truth, footage, env)
    sensors = {
        "ideal": (CameraConfig(), FaultsConfig()),
        "configured": (config.env.camera, config.env.faults),
    }
    scores: dict[Key, Score] = {}
    real = windows_of(events, truth, footage, env)
    for name, (sensor, faults) in sensors.items():
        view = {name: getattr(camera, name) for name in ("width", "height", "fov_deg")}
        small = dataclasses.replace(sensor, **view)
        slide = Slide(small, faults, SCALE * truth.speed_mps, env.control_hz, len(real.windows))
        train = record_slides(slide, chosen.episodes, config.seed)
        held_out = record_slides(slide, chosen.episodes // 4, config.seed + 1)
        height, width = footage.luminance.shape[1:]
        large = dataclasses.replace(sensor, width=width, height=height)
        made = windows_of(simulate(footage, large, faults, config.seed), truth, footage, env)
        parts = {"simulated world": held_out, "simulated from frames": made, "recorded": real}
        for kind in KINDS:
            for part, (data, read) in read_from(kind, evae, train, parts).items():
                scores[part, name, KINDS[kind]] = score(data, read, train, single=data is not held_out)
    rows = [(*key, *(text(part) for part in value[:3])) for key, value in sorted(scores.items())]
    show_table("Proximity read by a probe of the simulation", HEADINGS, rows, words=3)
    folder = open_run(config).path / "sliding"
    folder.mkdir(parents=True, exist_ok=True)
    write_atomic(folder / "table.md", markdown_table(HEADINGS, rows, 3))
    save_plot(folder / "read.png", plot_read(real, scores))
    console.print(f"Written: {folder / 'table.md'}", markup=False)
    return {" ".join(key): value for key, value in scores.items()}


def read_folder(folder: Path, events: str, delay_us: int) -> tuple[Truth, Footage, np.ndarray]:
    """Read a folder in the format of Mueggler et al. (2017): events, images.txt, calib.txt, groundtruth.txt.

    Raises:
        ValueError: A file cannot be used, or the camera did not only move sideways.
    """
    lens = read_lens(folder / "calib.txt")
    poses = np.loadtxt(folder / "groundtruth.txt")
    if poses.shape[1:] != (8,) or np.abs(poses[:, 2:7] - poses[0, 2:7]).max() > 1e-3:
        raise ValueError(f"{folder / 'groundtruth.txt'}: must be of a camera that moves along x alone")
    footage = read_frames(folder / "images.txt", delay_us)
    recorded = read_source(folder / events, footage, RecordingConfig()).events
    if not recorded.size:
        raise ValueError(f"{folder / events}: must have events, got 0; name another file by `sliding.events`")
    inside = (footage.times_us >= recorded["t"][0]) & (footage.times_us <= recorded["t"][-1])
    if inside.sum() < 2:
        raise ValueError(f"{folder / events}: must last for two frames or more")
    truth = find_depth(read_greys(folder / "images.txt"), footage.times_us, inside, poses, lens)
    footage = Footage(footage.luminance[inside], footage.times_us[inside])
    span = (recorded["t"] > footage.times_us[0]) & (recorded["t"] <= footage.times_us[-1])
    return truth, footage, recorded[span]


def read_lens(path: Path) -> Lens:
    """Read a lens from a text file of 4 to 9 numbers.

    Raises:
        ValueError: The file has something else.
    """
    text = path.read_text()
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        numbers = []
    if not 4 <= len(numbers) <= len(Lens._fields) or not np.isfinite(numbers).all():
        raise ValueError(
            f"{path}: must have 4 to {len(Lens._fields)} numbers, {' '.join(Lens._fields)}; "
            f"got {len(text.split())} words, {text[:60]!r}"
        )
    return Lens(*numbers)


def find_depth(
    pictures: np.ndarray, times_us: np.ndarray, inside: np.ndarray, poses: np.ndarray, lens: Lens
) -> Truth:
    """Find the inverse depth of frames `inside`, bool (K,), from frames up to `SPAN_S` after the first."""
    first = int(np.flatnonzero(inside)[0])
    used = np.flatnonzero((times_us >= times_us[first]) & (times_us <= times_us[first] + 1e6 * SPAN_S))
    ways_m = np.interp(1e-6 * times_us, poses[:, 0], poses[:, 1])
    maps = []
    row, column = undistorted(lens, pictures.shape[1:])
    for frame in np.flatnonzero(inside):
        chosen = np.union1d(used[::EVERY], [frame])
        straight = np.stack([straightened(pictures[k], lens) for k in chosen])
        inverse, sure = inverse_depth(straight, ways_m[chosen], int(np.searchsorted(chosen, frame)), lens.fx)
        maps.append(np.where(sure > KNOWN, inverse, np.nan)[row, column])
    speed = float(np.polyfit(poses[:, 0], poses[:, 1], 1)[0])
    return Truth(np.stack(maps), times_us[inside], speed, lens.fx)


def undistorted(lens: Lens, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the nearest row and column in a pinhole's picture for each pixel of the lens, int64 (H, W)."""
    row, column = np.mgrid[: shape[0], : shape[1]]
    down, across = distorted(lens, shape)
    back = np.rint(2 * row - down).astype(np.int64), np.rint(2 * column - across).astype(np.int64)
    return np.clip(back[0], 0, shape[0] - 1), np.clip(back[1], 0, shape[1] - 1)


def seen_through(truth: Truth, footage: Footage, env: EnvConfig) -> CameraConfig:
    """Return the policy's camera with the field of view of the middle of the frames."""
    shape = footage.luminance.shape[1:]
    across = min(shape[0] / env.camera.height, shape[1] / env.camera.width) * env.camera.width
    return dataclasses.replace(env.camera, fov_deg=2.0 * math.degrees(math.atan(0.5 * across / truth.focal)))


def windows_of(events: np.ndarray, truth: Truth, footage: Footage, env: EnvConfig) -> ProbeData:
    """Convert events of the frames' size to control steps of the policy's camera, with their proximity.

    Proximity is exp(-depth / 1 m) of the median depth in each sector of the middle. This matches the poles of
    the simulated world, which fill most of a sector and are `SCALE` times as far away.
    """
    shape, begin = footage.luminance.shape[1:], int(footage.times_us[0])
    part, middle = cropped(events, shape, env.camera)
    part = downscale_events(part, middle, (env.camera.height, env.camera.width))
    steps = int((footage.times_us[-1] - begin) * 1e-6 * env.control_hz)
    ends = begin + np.rint(np.arange(steps + 1) * 1e6 / env.control_hz).astype(np.int64)
    cuts = np.searchsorted(part["t"], ends, side="right")
    windows = [(part[cuts[k] : cuts[k + 1]], int(ends[k]), int(ends[k + 1] - ends[k])) for k in range(steps)]
    left = (shape[1] - middle[1]) // 2
    edges = left + np.arange(SECTORS + 1) * middle[1] / SECTORS
    frame = np.abs(ends[1:, None] - truth.times_us).argmin(axis=1)
    near = np.stack([_middle(picture, edges) for picture in truth.inverse_per_m])
    depth_m = SCALE / np.maximum(near, 1e-3)
    return ProbeData(windows, np.zeros(steps, np.int64), np.exp(-depth_m / NEAR_M)[frame], np.zeros(SECTORS))


def _middle(inverse: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return the median inverse depth of each sector of columns, (SECTORS,); 0 if no depth is known."""
    sectors = (inverse[:, math.floor(a) : math.ceil(b)] for a, b in itertools.pairwise(edges))
    return np.array([np.nanmedian(part) if np.isfinite(part).any() else 0.0 for part in sectors])


def read_from(
    kind: str, evae: EventVAE, train: ProbeData, parts: Mapping[str, ProbeData]
) -> dict[str, tuple[ProbeData, np.ndarray]]:
    """Return each part with the proximity (N, SECTORS) that a ridge regression of `train` reads from it."""

    def features(data: ProbeData) -> np.ndarray:
        own = latents(data, evae) if kind == "latents" else column_features(data, evae.grid)
        return stacked(own, data.episode, STACK)

    x = features(train)
    mean, scale = x.mean(axis=0, dtype=np.float64), np.maximum(x.std(axis=0, dtype=np.float64), 1e-6)
    inner, fitted = inner_episodes(train.episode), ((x - mean) / scale).astype(np.float32)
    read = {}
    for name, data in parts.items():
        inputs = ((features(data) - mean) / scale).astype(np.float32)
        read[name] = data, ridge(fitted, train.proximity, inner, inputs)
    return read


def score(data: ProbeData, read: np.ndarray, train: ProbeData, single: bool) -> Score:
    """Return how well read proximity (N, SECTORS) agrees with the true proximity.

    Intervals come from resampling episodes or, for a single episode, blocks of neighbouring sectors.
    """
    steps = np.bincount(data.episode)[0]
    truth, read = (part.reshape(-1, steps, SECTORS) for part in (data.proximity, read))
    usual = np.broadcast_to(train.proximity.mean(axis=0), truth.shape)
    if single:  # blocks of sectors in place of episodes
        truth, read, usual = (_blocks(part) for part in (truth, read, usual))
    chosen = np.random.default_rng(0).integers(0, len(truth), (DRAWS, len(truth)))
    chosen = np.concatenate((np.arange(len(truth))[None], chosen))
    values = np.array([_agreement(truth[k], read[k], usual[k]) for k in chosen])
    tails = np.nanquantile(values[1:], ((1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2), axis=0)
    ends = [(float(values[0, k]), float(tails[0, k]), float(tails[1, k])) for k in range(3)]
    return Score(ends[0], ends[1], ends[2], read)


def _blocks(part: np.ndarray) -> np.ndarray:
    """Reshape (1, steps, SECTORS) to (SECTORS / BLOCK, steps, BLOCK)."""
    return part[0].reshape(part.shape[1], -1, BLOCK).swapaxes(0, 1)


def _agreement(truth: np.ndarray, read: np.ndarray, usual: np.ndarray) -> tuple[float, float, float]:
    """Return correlation of all values and of means over time, and squared error relative to `usual`."""
    means = truth.mean(axis=1).ravel(), read.mean(axis=1).ravel()
    error = np.square(read - truth).mean() / np.square(usual - truth).mean()
    return _correlation(truth.ravel(), read.ravel()), _correlation(*means), float(error)


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Return Pearson's correlation; NaN if either is constant."""
    return float(np.corrcoef(a, b)[0, 1]) if np.ptp(a) > 0.0 and np.ptp(b) > 0.0 else math.nan


def text(part: Sequence[float]) -> str:
    """Return a value with its interval as text."""
    return f"{part[0]:.2f} [{part[1]:.2f}, {part[2]:.2f}]"


def plot_read(real: ProbeData, scores: Mapping[Key, Score]) -> Figure:
    """Draw true proximity and proximity read from the recording, means over time, from left to right."""
    figure = Figure(figsize=(6.8, 3.6), layout="constrained")
    panel = figure.subplots()
    panel.step(range(SECTORS), real.proximity.mean(axis=0), color=INK, lw=2.2, where="mid", label="true")
    lines = {"recorded": "-", "simulated from frames": ":"}
    for (part, camera, kind), found in scores.items():
        if kind == "latents" and part in lines:
            mean = found.read.mean(axis=1).ravel()
            colour = {"ideal": AMBER, "configured": BLUE}[camera]
            panel.plot(mean, lines[part], color=colour, lw=1.8, label=f"{part}, probe of the {camera} camera")
    panel.set(xlabel="Sector of the field of view, from left to right", ylabel="Proximity, exp(-depth / 1 m)")
    figure.legend(loc="outside upper center", ncols=2, frameon=False, fontsize=8)
    tidy(panel, "y")
    return figure
