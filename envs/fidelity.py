"""What a scene requires: the cheapest renderer that can draw it, and how often to render."""

import importlib
import math
from typing import Any

import numpy as np

from envs.raycast import KINDS, RaycastRenderer
from envs.scene import Scene

RENDERERS = ("auto", "raycast", "pyrender")


def choose_renderer(name: str, scene: Scene) -> Any:
    """The renderer class called `name`; "auto" is the cheapest that can draw `scene`.

    Raises:
        ValueError: If the name is not known, or the ray caster is forced on a scene that
            holds an obstacle it cannot draw.
    """
    if name not in RENDERERS:
        raise ValueError(f"renderer must be one of {RENDERERS}, got {name!r}")
    analytic = bool(np.isin(scene.obstacles["kind"], KINDS).all())
    if name == "raycast" and not analytic:
        kinds = sorted(set(scene.obstacles["kind"].tolist()))
        raise ValueError(f"renderer='raycast' draws kinds {KINDS} only, scene has {kinds}; use 'auto'")
    if name == "pyrender" or not analytic:
        return importlib.import_module("envs.rasterize").PyrenderRenderer
    return RaycastRenderer


def sub_renders(step_m: float, max_step_m: float) -> int:
    """How many equal parts, one render each, keep a control step of `step_m` within `max_step_m`.

    At least 1, also for a step of 0 m. A step that exceeds a multiple of `max_step_m` by
    rounding alone (relative 1e-9) is not divided further.

    Raises:
        ValueError: If step_m is negative or max_step_m not positive, or either is not finite.
    """
    if not (0.0 <= step_m < math.inf and 0.0 < max_step_m < math.inf):
        raise ValueError(f"step_m must be >= 0, max_step_m > 0, both finite; got {step_m}, {max_step_m}")
    return max(1, math.ceil(step_m / max_step_m * (1.0 - 1e-9)))
