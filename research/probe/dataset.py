"""Random episodes with the proximity of obstacles at each step, and representations of their events."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from envs.config import EnvConfig
from envs.corridor import CorridorEnv
from envs.kinematics import SEED_STRIDE
from envs.scene.range_scan import NEAR_M, sector_bearings, sector_proximity
from jobs.training.collect import HoldingAgent, steps_of
from jobs.training.pretrain import Window
from models.encoder.evae import SECTORS, EventVAE
from models.encoder.event_batch import Grid, batch_windows
from models.encoder.event_images import cell_counts
from models.encoder.frozen import encoder_of
from models.policy.features import column_counts

ALARM_M = 15.0  # an agent must avoid obstacles nearer than this
CELLS = (8, 16)  # in each direction; the finer cells contain nearly all information of a picture


@dataclass(frozen=True)
class ProbeData:
    """Control steps of whole episodes, in their order.

    Attributes:
        windows: Events of each step.
        episode: Number of each step's episode, int64 (N,), ascending.
        proximity: Proximity of the nearest obstacle in each sector at the end of the step, float64
            (N, SECTORS), from left to right; see `envs.scene.range_scan.proximity`.
        bearing_deg: Bearing of the middle of each sector, to the right [degrees], float64 (SECTORS,).
    """

    windows: list[Window]
    episode: np.ndarray
    proximity: np.ndarray
    bearing_deg: np.ndarray

    @property
    def alarm(self) -> np.ndarray:
        """Return whether an obstacle is within `ALARM_M` at each step, bool (N,)."""
        return self.proximity.max(axis=1) >= np.exp(-ALARM_M / NEAR_M)


def record_probe_data(
    config: EnvConfig, num_steps: int, seed: int, advance: Callable[[int], None]
) -> ProbeData:
    """Record random episodes with proximity, as `jobs.training.collect` does but in other corridors.

    Args:
        config: Environment.
        num_steps: Control steps [-].
        seed: Seed of corridors and actions.
        advance: Called with the number of steps after each episode.
    """
    env = CorridorEnv(config)
    agent = HoldingAgent(np.random.SeedSequence([seed, 4]))
    windows: list[Window] = []
    episode: list[int] = []
    near: list[np.ndarray] = []
    started = env.reset(seed=seed + SEED_STRIDE)  # not the corridors in which the encoder was trained
    while len(windows) < num_steps:
        start_us, number, done = 0, (episode[-1] + 1 if episode else 0), len(windows)
        agent.reset([env], [number])
        for end_us in steps_of(env, agent, started, num_steps - len(windows)):
            windows.append((env.events.copy(), start_us, end_us - start_us))
            episode.append(number)
            near.append(sector_proximity(env.scene, env.camera_pose(), config.camera.fov_deg, SECTORS))
            start_us = end_us
        advance(len(windows) - done)
        started = env.reset()
    env.close()
    bearing_deg = np.degrees(sector_bearings(config.camera.fov_deg, SECTORS))[:, 0]
    return ProbeData(windows, np.array(episode), np.stack(near), bearing_deg)


def nothing(probe_data: ProbeData) -> np.ndarray:
    """Return zeros (N, 1), which carry no information."""
    return np.zeros((len(probe_data.episode), 1), np.float32)


def column_features(probe_data: ProbeData, grid: Grid) -> np.ndarray:
    """Return the features of the policy event_columns at each step, float32 (N, 2 width)."""
    return column_counts(batch_windows(probe_data.windows, grid))


def cell_features(probe_data: ProbeData, grid: Grid, across: int) -> np.ndarray:
    """Return log(1 + count) of OFF and ON events in `across` x `across` cells, float32 (N, 2 across^2)."""
    return np.log1p(cell_counts(batch_windows(probe_data.windows, grid), across))


def latents(probe_data: ProbeData, evae: EventVAE) -> np.ndarray:
    """Return the latent of each step's window, float32 (N, latent)."""
    encoder = encoder_of(evae)
    return np.stack([encoder.encode(*window) for window in probe_data.windows])


def stacked(features: np.ndarray, episode: np.ndarray, stack: int) -> np.ndarray:
    """Return the last `stack` rows at each step, oldest first, as in `models.policy.features.push_features`.

    Args:
        features: (N, D).
        episode: int64 (N,), ascending; the first row of an episode fills all places before it.
        stack: Number of rows.

    Returns:
        (N, stack D).
    """
    first = np.searchsorted(episode, episode)
    places = np.arange(len(episode))[:, None] - np.arange(stack)[::-1]
    return features[np.maximum(places, first[:, None])].reshape(len(features), -1)
