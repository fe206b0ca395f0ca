"""Choose renderer, renders per control step and anti-aliasing of a scene from one tolerance.

The tolerance is the accepted event error of `envs.event_error`. The rules below are fitted to
measurements of this error over all layouts, 45 to 400 Hz and thresholds 0.05 to 0.5
(`python -m benchmarks.fidelity`), with the constants rounded to the safe side.
"""

import importlib
import importlib.util
import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import numba
import numpy as np

from envs.config import EnvConfig
from envs.events.ramps import can_look
from envs.raycast import RaycastRenderer
from envs.raycast.stretches import Shifts
from envs.scene import CONE, ELLIPSOID, OBSTACLE, Scene

CULL_M = 143.0  # at tolerance 0.05: obstacles farther away add a twentieth of the tolerance
RENDERS_TEXTURED = 1.3  # factor against a plain scene; for bodies only if their pattern has edges
# Largest motion of an edge between two looks, at tolerance 0.05 in a control step of 0.1 m [pixels].
UPRIGHT_PX = 0.48
LEVEL_PX = 0.25
BENT_PX = 0.126
LONGEST_BENT = 2.4  # largest factor on BENT_PX, for long control steps
SHORT = 2.0  # [time constants of a photoreceptor] longer control steps need a second render
FOCAL_PIXELS = 32.0  # 64 pixels over 90 degrees
# Samples at tolerance 0.05 in a control step of 0.1 m. Straight edges are exact with any number of samples.
# The light and the arcs of cones and ellipsoids, and the patterns of textures, converge with more samples.
SAMPLES = {"straight": 0.5, "textured": 1.5, "curved": 1.95, "curved noise": 2.9, "curved pattern": 10.0}
MAX_SAMPLES = 16
LOW_WALL_M = 0.1  # walls up to this height count as no walls
PYRENDER_SAMPLES = ((0.3, 1), (0.15, 2), (0.0, 4))  # (smallest tolerance, samples)


@dataclass(frozen=True)
class RenderPlan:
    """Rendering settings of one scene.

    Attributes:
        renderer: "raycast", "pyrender" or "spheres".
        samples: Anti-aliasing of the renderer.
        max_shifts_px: Largest motion of outlines between two looks at their columns [pixels].
        max_step_m: Longest way between two renders [m]; infinite: one render per control step.
        by_looks: Whether single columns are also rendered between the renders of whole images, when
            something changes in them (`envs.sensor.looks`).
        cull_m: Obstacles farther than this are not drawn [m]; infinite: all are drawn.
    """

    renderer: str
    samples: int
    max_shifts_px: Shifts
    max_step_m: float
    by_looks: bool
    cull_m: float


def plan_renders(config: EnvConfig, scene: Scene) -> RenderPlan:
    """Return the cheapest plan within `config.fidelity.tolerance`; settings given in `config.fidelity` stay.

    The paper's two-frame cameras (memory "frame" and "legacy") get one frame per control step: more frames
    would change their events, not make them more accurate.

    Raises:
        ValueError: The chosen renderer cannot draw the scene.
    """
    asked = config.fidelity
    renderer = choose_renderer(config.renderer, scene)
    remembers = config.camera.memory == "reference"
    by_looks = renderer != "pyrender" and can_look(config.camera)
    step_m = asked.max_step_m or _max_step_m(config, scene, by_looks)
    return RenderPlan(
        renderer=renderer,
        samples=asked.samples or _samples(config, scene, renderer),
        max_shifts_px=_max_shifts_px(config, scene),
        max_step_m=step_m if remembers else math.inf,
        by_looks=by_looks,
        cull_m=asked.cull_m or _cull_m(asked.tolerance, scene),
    )


def choose_renderer(name: str, scene: Scene) -> str:
    """Return the renderer called `name`; "auto" is the cheapest that can draw `scene`.

    Raises:
        ValueError: The renderer cannot draw the scene. The ray caster cannot draw meshes, pyrender no moving
            bodies, "spheres" only plain spheres above plain ground.
    """
    if name == "pyrender" and scene.movers:
        raise ValueError("renderer='pyrender' cannot draw bodies that move; use 'auto'.")
    if name == "raycast" and scene.mesh is not None:
        raise ValueError(f"renderer='raycast' cannot draw the mesh of scene {scene.name!r}; use 'auto'.")
    if name == "spheres" and not _only_spheres(scene):
        rule = "draws plain spheres above plain ground, between walls that are too low to show"
        raise ValueError(f"renderer='spheres' {rule}; scene {scene.name!r} has more: use 'auto'.")
    if name == "auto":
        return "raycast" if scene.mesh is None else "pyrender"
    return name


def make_renderer(chosen: RenderPlan, scene: Scene, width: int, height: int, fov_deg: float) -> Any:
    """Create the renderer of a plan; RuntimeError if it needs pyrender or OpenGL and they are missing."""
    make: Any = RaycastRenderer
    if chosen.renderer == "spheres":
        make = partial(RaycastRenderer, discs=True)
    if chosen.renderer == "pyrender":  # imported only here, because it loads OpenGL
        if importlib.util.find_spec("pyrender") is None:
            raise RuntimeError("renderer='pyrender', which meshes need, is not installed: evade[meshes]")
        make = importlib.import_module("envs.rasterize.renderer").PyrenderRenderer
    return make(scene, width, height, fov_deg, samples=chosen.samples, cull_m=chosen.cull_m)


@numba.njit(cache=True, error_model="numpy")
def sub_renders(step_m: float, max_step_m: float) -> int:
    """Return the number of equal parts, one render each, into which to cut a way, none above `max_step_m`.

    It is at least 1, also for a step of 0 m. A step that exceeds a multiple of `max_step_m` by
    rounding alone (relative 1e-9) is not divided further. `step_m` must be finite and not negative,
    `max_step_m` positive; compiled code does not check it.
    """
    return max(1, math.ceil(step_m / max_step_m * (1.0 - 1e-9)))


def _max_step_m(config: EnvConfig, scene: Scene, by_looks: bool) -> float:
    """Return the longest way between two renders [m], from a fit of the renders per control step.

    Between looks the light of a pixel is taken as linear in time, so an event may be early or late
    within the interval; up to 5 % of a control step is accepted. A pixel's light changes faster in
    longer steps and in smaller pixels. A high threshold leaves fewer crossings, and they are the
    uncertain ones. The response of a photoreceptor of limited bandwidth changes exponentially, so
    at tolerance 0.05 a step of more than two time constants takes two renders.
    """
    step_m = config.speed_mps / config.control_hz
    renders = _renders_by_looks(config, scene) if by_looks else _renders_alone(step_m, scene)
    if 2.0 * math.pi * config.camera.cutoff_hz / config.control_hz > SHORT:
        renders = max(renders, 2.0)
    return step_m / max(1.0, renders * _renders_factor(config))


def _max_shifts_px(config: EnvConfig, scene: Scene) -> Shifts:
    """Return the largest motion of outlines between two looks [pixels], from a fit of the event error.

    An event may be late by 5 % of a control step, so outlines may move less in a shorter step. Otherwise as
    in `_max_step_m`.
    """
    share = config.speed_mps / config.control_hz / 0.1
    factor = _renders_factor(config) * (RENDERS_TEXTURED if scene.obstacle_texture.sharp else 1.0)
    return Shifts(
        upright=UPRIGHT_PX / factor * max(1.0, share) ** 0.7,
        level=LEVEL_PX / factor * max(1.0, share) ** 0.25,
        bent=BENT_PX / factor * min(LONGEST_BENT, share**0.65),
    )


def _renders_factor(config: EnvConfig) -> float:
    """Return the factor on renders relative to tolerance 0.05, threshold 0.2 and `FOCAL_PIXELS`."""
    tolerance, threshold = config.fidelity.tolerance, config.camera.contrast_threshold
    focal = 0.5 * config.camera.width / math.tan(0.5 * math.radians(config.camera.fov_deg))
    factor = max(1.0, focal / FOCAL_PIXELS) ** 0.5 * max(1.0, threshold / 0.2) ** 0.4
    return factor * float((0.05 / tolerance) ** (0.8 if tolerance < 0.05 else 0.5))


def _renders_alone(step_m: float, scene: Scene) -> float:
    """Return the renders per control step at tolerance 0.05 for a camera that renders only whole images."""
    return (3.19 + 1.8 * (step_m / 0.1)) * (1.0 if _plain(scene) else RENDERS_TEXTURED)


def _renders_by_looks(config: EnvConfig, scene: Scene) -> float:
    """Return the renders of whole images that a camera needs in addition to looks at columns.

    Looks follow all edges except those of the ground's texture, and they do not follow noise.
    """
    ground, renders = scene.ground_texture, 0.75
    for texture in (ground, scene.wall_texture):
        share = (config.speed_mps + math.hypot(*texture.velocity_mps)) / config.control_hz / 0.1
        if texture.sharp and texture is ground:
            renders = max(renders, 4.7 * share**0.4 * max(1.0, 1.0 / ground.period_m) ** 0.4)
        elif not texture.plain:
            renders = max(renders, 1.3 * share**0.8, 1.4 * share**0.2)
    return renders


def _cull_m(tolerance: float, scene: Scene) -> float:
    """Return the culling distance [m] beyond which obstacles add at most 5 % of the tolerance.

    It is inf if no obstacle is farther away. Leaving out obstacles farther than d adds an error of up to
    0.05 (32 m / d)^2 in a long lane of poles, whether they are 0.5 or 2 m wide and the image 16 or 200
    pixels, because distant obstacles move slowly.
    """
    cull_m = CULL_M * math.sqrt(0.05 / tolerance)
    last_m = max([scene.obstacles["y"].max(initial=0.0), *(one.places_m[:, 1].max() for one in scene.movers)])
    farthest = math.hypot(scene.width_m, last_m)
    return cull_m if cull_m < farthest else math.inf


def _samples(config: EnvConfig, scene: Scene, renderer: str) -> int:
    """Return the samples whose error is a small part of the tolerance; shorter steps need more samples."""
    tolerance = config.fidelity.tolerance
    if renderer == "pyrender":
        return next(samples for least, samples in PYRENDER_SAMPLES if tolerance >= least)
    if renderer == "spheres":
        return 1
    kind = "straight" if _plain(scene) else "textured"
    if scene.kinds & {CONE, ELLIPSOID}:
        kind = "curved"
        if not scene.obstacle_texture.plain:
            kind = "curved pattern" if scene.obstacle_texture.sharp else "curved noise"
    share = config.speed_mps / config.control_hz / 0.1
    samples = SAMPLES[kind] * (0.05 / tolerance) ** 0.8
    if kind != "straight":
        samples *= share**-0.7
    return min(MAX_SAMPLES, math.ceil(samples))


def _only_spheres(scene: Scene) -> bool:
    """Whether `envs.raycast.discs` can draw everything visible in a scene."""
    bodies = np.concatenate([scene.obstacles, np.array([one.body for one in scene.movers], OBSTACLE)])
    round_ = (bodies["kind"] == ELLIPSOID) & (bodies["rx"] == bodies["ry"]) & (bodies["ry"] == bodies["rz"])
    return _plain(scene) and bool(round_.all()) and scene.wall_height_m <= LOW_WALL_M


def _plain(scene: Scene) -> bool:
    textures = (scene.ground_texture, scene.wall_texture, scene.obstacle_texture)
    return scene.mesh is None and all(texture.plain for texture in textures)
