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
SMALL = CameraConfig(width=32, height=32)


def resident_mb():
    gc.collect()
    pages = int(STATM.read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def fly(env, steps, rng):
    for _ in range(steps):
        if any(env.step(int(rng.integers(3)))[2:4]):
            env.reset()


@pytest.mark.parametrize("observation", ["window", "events", "event_image", "luminance", "none"])
def test_twenty_thousand_steps_leave_it_as_it_was(observation):
    env, rng = CorridorEnv(observation=observation), np.random.default_rng(0)
    env.reset(seed=0)
    fly(env, 4000, rng)
    before = resident_mb()
    fly(env, 20_000, rng)
    assert resident_mb() - before < 3.0


def test_two_hundred_environments_that_are_closed_leave_it_as_it_was():
    def make_and_close(count):
        for seed in range(count):
            env = CorridorEnv(camera=SMALL)
            env.reset(seed=seed)
            env.step(0)
            env.close()

    make_and_close(50)
    before = resident_mb()
    make_and_close(200)
    assert resident_mb() - before < 3.0


def test_three_hundred_big_scenes_leave_it_as_it_was():
    def scenes(count):
        for seed in range(count):
            make_scene("poles", np.random.default_rng(seed), num_obstacles=300, last_y_m=1000.0)

    scenes(50)
    before = resident_mb()
    scenes(300)
    assert resident_mb() - before < 3.0


def test_twelve_opengl_contexts_that_are_closed_leave_it_as_it_was():
    def draw(count):
        for seed in range(count):
            env = CorridorEnv(renderer="pyrender", camera=SMALL)
            env.reset(seed=seed)
            env.step(0)
            env.close()

    draw(6)
    before = resident_mb()
    draw(12)
    assert resident_mb() - before < 12.0
