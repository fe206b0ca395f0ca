"""Draw every scene for docs/task.md#worlds and print the numbers of its table.

Run from the repository root: python docs/draw_scenes.py [NAME ...]
Writes docs/images/scene_NAME.png, three panels each: the corridor from above the start, what
the camera sees, and the events of one control step (0.1 m at 200 Hz), ON blue and OFF orange.
"""

import statistics
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from envs.config import CameraConfig
from envs.events import EventCamera
from envs.observations import picture
from envs.rasterize import PyrenderRenderer
from envs.raycast import RaycastRenderer
from envs.scene import Scene, make_scene
from envs.scene.layouts import draw_obstacles
from envs.scene.scene import LAYOUTS

IMAGES = Path(__file__).resolve().parent / "images"
SIZE, GAP, COLOURS = 256, 4, 64
HEIGHT_M, STEP_M, STEP_US, STEPS = 2.0, 0.1, 5000, 10
ABOVE_M = (0.0, -6.0, 16.0)
SEED, CORRIDORS = 1, 200


def main() -> None:
    """Draw the scenes named on the command line, or all, and print the measurements of layouts."""
    names = sys.argv[1:] or [*(name for name in LAYOUTS if name != "spheres"), "mesh"]
    sys.stdout.write("scene: passable at the first draw, straight flights colliding, drawing, search [ms]\n")
    for name in names:
        if name == "mesh":
            with tempfile.TemporaryDirectory() as folder:
                scene = make_scene(example_mesh(folder), np.random.default_rng(SEED))
        else:
            scene = make_scene(name, np.random.default_rng(SEED))
            sys.stdout.write(measurements(name) + "\n")
        draw(scene).save(IMAGES / f"scene_{name}.png", optimize=True)


def draw(scene: Scene) -> Image.Image:
    """Return the three panels of a scene side by side, on a palette of `COLOURS` colours."""
    x, y = viewpoint(scene)
    renderer = RaycastRenderer if scene.mesh is None else PyrenderRenderer
    above = renderer(scene, 2 * SIZE, 2 * SIZE).render(*ABOVE_M)[-SIZE - 32 : -32, SIZE // 2 : -SIZE // 2]
    panels = [grey(above), grey(renderer(scene, SIZE, SIZE).render(x, y, HEIGHT_M))]
    small = renderer(scene, 64, 64)
    camera = EventCamera(CameraConfig())
    for step in range(-STEPS, 1):  # start a few steps earlier, so that each pixel has its own level
        luminance = small.render(x, y + step * STEP_M, HEIGHT_M, 0.0, (step + STEPS) * STEP_US * 1e-6)
        if step == -STEPS:
            camera.reset(luminance, 0)
        else:
            events = camera.step(luminance, (step + STEPS) * STEP_US)
    panels.append(picture(events, luminance)[:, SIZE:])
    sheet = Image.new("RGB", (3 * SIZE + 2 * GAP, SIZE), "white")
    for place, panel in enumerate(panels):
        sheet.paste(Image.fromarray(panel), (place * (SIZE + GAP), 0))
    return sheet.quantize(COLOURS, dither=Image.Dither.NONE)


def grey(luminance: np.ndarray) -> np.ndarray:
    """Return linear luminance (H, W) as a grey picture, uint8 (H, W, 3)."""
    shade = np.clip(255.0 * np.sqrt(luminance), 0, 255).astype(np.uint8)
    return np.repeat(shade[:, :, None], 3, axis=2)


def viewpoint(scene: Scene) -> tuple[float, float]:
    """Return a position [m] with an obstacle close ahead, but not on the path."""
    for y in np.arange(8.0, 40.0, 1.0):
        for x in (0.0, -2.0, 2.0, -4.0, 4.0):
            near = scene.collides((x - 2.5, y + 4.0), (x + 2.5, y + 4.0), 0.5, HEIGHT_M)
            if near and not scene.collides((x, y - 2.0), (x, y + 3.0), 1.0, HEIGHT_M):
                return x, float(y)
    return 0.0, 8.0


def example_mesh(folder: str) -> str:
    """Write a mesh file with a ring, a ball and two towers, as a modelling tool would; return its path."""
    scene = trimesh.Scene()
    ring = trimesh.creation.torus(2.5, 0.4)
    ring.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0)))
    parts = [
        (ring, (-2.0, 13.0, 2.6), 150),
        (trimesh.creation.icosphere(4, 1.6), (3.5, 17.0, 1.6), 110),
        (trimesh.creation.cylinder(1.2, 9.0, sections=6), (8.0, 26.0, 4.5), 170),
        (trimesh.creation.box((3.0, 3.0, 5.0)), (-9.0, 24.0, 2.5), 130),
    ]
    for mesh, place, shade in parts:
        mesh.visual.face_colors = (shade, shade, shade, 255)
        mesh.apply_translation(place)
        scene.add_geometry(mesh)
    path = f"{folder}/example.ply"
    scene.to_mesh().export(path)
    return path


def measurements(name: str) -> str:
    """Return a scene's row, over `CORRIDORS` seeds: passable corridors and collisions [%], times [ms]."""
    starts = np.random.default_rng(0)
    passable = hits = 0
    drawing, checking = [], []
    for seed in range(CORRIDORS):
        start = time.process_time()
        draw_obstacles(LAYOUTS[name], np.random.default_rng(seed))
        drawing.append(time.process_time() - start)
        scene = make_scene(name, np.random.default_rng(seed), passable=False)
        start = time.process_time()
        passable += scene.passable(0.3, HEIGHT_M)
        checking.append(time.process_time() - start)
        x = starts.uniform(*scene.spawn_range_m)
        hits += make_scene(name, np.random.default_rng(seed)).collides((x, 0.0), (x, 100.0), 0.3, HEIGHT_M)
    ms = [1e3 * statistics.median(seconds) for seconds in (drawing, checking)]
    return f"{name}: {passable / CORRIDORS:.1%}, {hits / CORRIDORS:.1%}, {ms[0]:.2f}, {ms[1]:.2f}"


if __name__ == "__main__":
    main()
