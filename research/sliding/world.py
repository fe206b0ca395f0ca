"""Simulate a camera that slides sideways past poles, with the proximity of the nearest pole per sector."""

import dataclasses

import numpy as np

from envs.config import CameraConfig, FaultsConfig
from envs.events import EventCamera, RealSensor
from envs.kinematics import clock_us
from envs.raycast.renderer import RaycastRenderer
from envs.scene import Scene, make_scene
from envs.scene.range_scan import NEAR_M, sector_bearings, sector_proximity
from envs.scene.textures import Texture
from models.encoder.evae import SECTORS
from research.probe.dataset import ProbeData

HEIGHT_M, SAMPLES = 2.0, 2
SIDE_M, ALONG_M = 8.0, 60.0  # range of a camera's start [m], sideways and along
CLEAR_M = 3.0  # clear distance ahead of the camera at the start
POLES = {
    **{"num_obstacles": 100, "radius_min_m": 0.2, "radius_max_m": 1.0, "min_gap_m": 2.1},
    **{"albedo_min": 0.05, "albedo_max": 0.6, "wall_albedo": 0.6, "passable": False},
    "ground_texture": Texture("noise", period_m=1.0, contrast=0.5, seed=1),
    "wall_texture": Texture("checker", period_m=4.0, contrast=0.4),
    "obstacle_texture": Texture("noise", period_m=0.7, contrast=0.6, seed=2),
}


@dataclasses.dataclass(frozen=True)
class Slide:
    """The sensor and its motion.

    Attributes:
        camera, faults: The sensor.
        speed_mps: Speed to the right [m/s].
        control_hz: Steps per second [Hz].
        steps: Steps per episode.
    """

    camera: CameraConfig
    faults: FaultsConfig
    speed_mps: float
    control_hz: float
    steps: int


def record_slides(slide: Slide, episodes: int, seed: int) -> ProbeData:
    """Record episodes, each in its own world: the window of each step, and the proximity at its end."""
    rng = np.random.default_rng(seed)
    windows, near = [], []
    for _ in range(episodes):
        events, ends_us, truth = _episode(slide, rng)
        cuts = np.searchsorted(events["t"], ends_us, side="right")
        for k in range(slide.steps):
            duration = int(ends_us[k + 1] - ends_us[k])
            windows.append((events[cuts[k] : cuts[k + 1]], int(ends_us[k]), duration))
        near.append(truth)
    episode = np.repeat(np.arange(episodes), slide.steps)
    bearings = np.degrees(sector_bearings(slide.camera.fov_deg, SECTORS))[:, 0]
    return ProbeData(windows, episode, np.concatenate(near), bearings)


def _episode(slide: Slide, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return events, start and ends of the steps [us], and proximity (steps, SECTORS)."""
    camera = slide.camera
    while True:
        scene = make_scene("poles", rng, **POLES)
        place = rng.uniform(-SIDE_M, SIDE_M), rng.uniform(0.0, ALONG_M)
        if _scan(scene, place, camera.fov_deg).max() < np.exp(-CLEAR_M / NEAR_M):
            break
    ends_us = np.array([clock_us(step, slide.control_hz) for step in range(slide.steps + 1)], np.int64)
    poses = np.zeros((slide.steps + 1, 5))
    poses[:, 0], poses[:, 1] = place[0] + slide.speed_mps * 1e-6 * ends_us, place[1]
    poses[:, 2], poses[:, 4] = HEIGHT_M, 1e-6 * ends_us
    renderer = RaycastRenderer(scene, camera.width, camera.height, camera.fov_deg, SAMPLES)
    frames = renderer.render_way(poses)
    eye = EventCamera(camera)
    eye.reset(frames[0], 0)
    sensor = RealSensor(camera, slide.faults, (eye.state, eye.pixels), rng, 0)
    times = ends_us.tolist()
    steps = zip(frames[1:], times[:-1], times[1:], strict=True)
    events = np.concatenate([sensor.events(eye.step(frame, end), begin, end) for frame, begin, end in steps])
    return events, ends_us, np.stack([_scan(scene, (x, y), camera.fov_deg) for x, y in poses[1:, :2]])


def _scan(scene: Scene, place: tuple[float, float], fov_deg: float) -> np.ndarray:
    """Return the proximity of the nearest pole in each sector, float64 (SECTORS,)."""
    return sector_proximity(scene, (*place, HEIGHT_M, 0.0), fov_deg, SECTORS)
