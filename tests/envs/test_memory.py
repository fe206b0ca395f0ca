"""Memory stays what it is, however long one flies and however many environments are made."""

import gc
import resource
from pathlib import Path

import numpy as np
import pytest

from envs.config import CameraConfig
from envs.corridor import CorridorEnv
from envs.scene import make_scene

STATM = Path("/proc/self/statm")
pytestmark = [pytest.mark.slow, pytest.mark.skipif(not STATM.exists(), reason="reads /proc, so Linux alone")]


def resident_mb():
    gc.collect()
    pages = int(STATM.read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def grown_mb(work, warm_up, count):
    """By how much memory has grown after `count` more of some work than it took to warm up."""
    work(warm_up)
    before = resident_mb()
    work(count)
    return resident_mb() - before


@pytest.mark.parametrize("observation", ["window", "events", "event_image", "luminance", "none"])
def test_twenty_thousand_steps_leave_it_as_it_was(observation):
    env, rng = CorridorEnv(observation=observation), np.random.default_rng(0)
    env.reset(seed=0)

    def fly(steps):
        for _ in range(steps):
            if any(env.step(int(rng.integers(3)))[2:4]):
                env.reset()

    assert grown_mb(fly, 4000, 20_000) < 3.0


@pytest.mark.parametrize(
    ("renderer", "warm_up", "count", "most_mb"), [("auto", 50, 200, 3.0), ("pyrender", 6, 12, 12.0)]
)
def test_environments_and_opengl_contexts_that_are_closed_leave_it_as_it_was(
    renderer, warm_up, count, most_mb
):
    def make_and_close(number):
        for seed in range(number):
            env = CorridorEnv(renderer=renderer, camera=CameraConfig(width=32, height=32))
            env.reset(seed=seed)
            env.step(0)
            env.close()

    assert grown_mb(make_and_close, warm_up, count) < most_mb


def test_three_hundred_big_scenes_leave_it_as_it_was():
    def scenes(count):
        for seed in range(count):
            make_scene("poles", np.random.default_rng(seed), num_obstacles=300, last_y_m=1000.0)

    assert grown_mb(scenes, 50, 300) < 3.0
