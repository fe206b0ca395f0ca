"""Measure the ray caster's time per frame by scene, size and texture, compared with pyrender, and its error.

Run: python -m benchmarks.render
Expect: two tables in about two minutes on one core. Times are CPU time of the thread
(`time.thread_time`), which other processes disturb less than wall time, along a flight
from y = 0 to 90 m at 2 m height; medians of interleaved rounds. The error is the difference
from the mean of 32 x 32 point samples per pixel. That mean is itself wrong by up to 1 / 64 of
a pixel at a vertical edge.
"""

import contextlib
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial

import numpy as np

from envs.rasterize import PyrenderRenderer
from envs.raycast import RaycastRenderer
from envs.scene import BOX, CONE, ELLIPSOID, OBSTACLE, POLE, Scene, Texture
from envs.scene.obstacles import KINDS
from jobs.analysis.tables import show_table
from jobs.measure.timing import interleaved
from tests.support.point_samples import sample_luminance

ROUNDS = 9
PATH_M = np.linspace(0.0, 90.0, 30)
POSES = ((0.3, 0.0, 2.0, 0.0), (-4.0, 30.0, 2.0, 0.2), (6.0, 55.0, 2.0, -0.5), (2.0, 70.0, 2.0, 0.05))
SIZES = (64, 128, 256)


def main() -> None:
    """Measure and print both tables."""
    scenes = cases()
    times = frame_times(scenes)
    title = f"ms per frame, CPU time of one thread, medians of {ROUNDS} interleaved rounds"
    head = ("scene", *(f"{n}x{n}" for n in SIZES), "64x64, samples 2", "pyrender 64x64")
    show_table(title, head, [
        (name, *(f"{times[name, column]:.3f}" if (name, column) in times else "none" for column in head[1:]))
        for name in scenes
    ])  # fmt: skip
    rows = []
    for name, scene in scenes.items():
        for samples, found in errors(scene).items():
            worst = (found.mean(), np.quantile(found, 0.999), found.max())
            rows.append((name, str(samples), *(f"{value:.5f}" for value in worst)))
    title = "|difference| of luminance from 32 x 32 point samples, 64x64"
    show_table(title, ("scene", "samples", "mean", "p99.9", "largest"), rows)


def cases() -> dict[str, Scene]:
    """Return name -> scene: several numbers of poles, each kind of obstacle, and textures on 40 poles."""
    scenes = {f"{count} poles": crowd(POLE, count) for count in (0, 40, 400)}
    scenes |= {f"40 {KINDS[kind]}s": crowd(kind, 40) for kind in (CONE, ELLIPSOID)}
    scenes["12 gates"] = gates(12)
    for pattern in ("checker", "stripes", "rings", "noise"):
        scenes[f"40 poles, all {pattern}"] = textured(scenes["40 poles"], pattern)
    return scenes


def crowd(kind: int, count: int) -> Scene:
    """Return a scene of `count` obstacles of a kind on a jittered grid, 30 m wide and 90 m long."""
    rng = np.random.default_rng(0)
    made = np.zeros(count, OBSTACLE)
    columns = max(1, round(math.sqrt(count * 28.0 / 90.0)))
    pitch_x, pitch_y = 28.0 / columns, 90.0 / max(1, math.ceil(count / columns))
    radius = min(0.5, 0.2 * min(pitch_x, pitch_y))
    k = np.arange(count)
    room_x, room_y = 0.5 * pitch_x - radius, 0.5 * pitch_y - radius
    made["x"] = (k % columns + 0.5) * pitch_x - 14.0 + rng.uniform(-room_x, room_x, count)
    made["y"] = (k // columns + 0.5) * pitch_y + 10.0 + rng.uniform(-room_y, room_y, count)
    made["kind"], made["rx"], made["ry"], made["albedo"] = kind, radius, radius, 0.25
    made["rz"] = 4.0 if kind == POLE else 1.5
    made["z"] = made["rz"]
    return Scene("bench", made)


def gates(count: int) -> Scene:
    """Return a scene of `count` gates, one behind the other, each of four boxes."""
    made = np.zeros((count, 4), OBSTACLE)
    x = np.random.default_rng(0).uniform(-11.0, 11.0, count)
    made["kind"], made["albedo"], made["ry"] = BOX, 0.25, 0.25
    made["x"] = x[:, None] + [-1.75, 1.75, 0.0, 0.0]
    made["y"] = (10.0 + 90.0 / max(1, count) * np.arange(count))[:, None]
    made["z"], made["rz"], made["rx"] = [3.0, 3.0, 4.75, 0.5], [3.0, 3.0, 1.25, 0.5], [0.25, 0.25, 1.5, 1.5]
    return Scene("bench", made.ravel())


def textured(scene: Scene, pattern: str) -> Scene:
    """Return the scene with a pattern on all its surfaces."""
    return replace(
        scene,
        ground_texture=Texture(pattern, 2.0, 0.3),
        wall_texture=Texture(pattern, 1.5, 0.2),
        obstacle_texture=Texture(pattern, 0.5, 0.3),
    )


def frame_times(scenes: Mapping[str, Scene]) -> dict[tuple[str, str], float]:
    """Return the time per frame [ms] by scene and column of the table; without pyrender if EGL fails."""
    work: dict[tuple[str, str], Callable[[], object]] = {}
    for name, scene in scenes.items():
        for size in SIZES:
            work[name, f"{size}x{size}"] = partial(follow_path, RaycastRenderer(scene, size, size).render)
        fine = RaycastRenderer(scene, 64, 64, samples=2)
        work[name, "64x64, samples 2"] = partial(follow_path, fine.render)
        with contextlib.suppress(RuntimeError, ValueError):
            work[name, "pyrender 64x64"] = partial(follow_path, PyrenderRenderer(scene, 64, 64).render)
    seconds = interleaved(work, ROUNDS, time.thread_time)
    return {key: 1e3 * value / len(PATH_M) for key, value in seconds.items()}


def follow_path(render: Callable[..., object]) -> None:
    """Render the frames along the path."""
    for y_m in PATH_M:
        render(0.3, float(y_m), 2.0)


def errors(scene: Scene) -> dict[int, np.ndarray]:
    """Return absolute differences from point samples, by number of samples."""
    found: dict[int, list[np.ndarray]] = {1: [], 2: [], 4: []}
    for pose in POSES:
        points = sample_luminance(scene, pose, 64, 64, samples=32)
        for samples, differences in found.items():
            image = RaycastRenderer(scene, 64, 64, samples=samples).render(*pose)
            differences.append(np.abs(image - points))
    return {samples: np.stack(differences) for samples, differences in found.items()}


if __name__ == "__main__":
    main()
