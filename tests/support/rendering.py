"""One picture that renderers in several processes draw."""

import numpy as np

from envs.rasterize import PyrenderRenderer
from envs.scene import make_scene

POSE = (0.5, 20.0, 2.0, 0.1)


def picture() -> np.ndarray:
    """What a renderer of its own draws, in whatever process this runs."""
    renderer = PyrenderRenderer(make_scene("poles", np.random.default_rng(1)), 64, 64)
    try:
        return renderer.render(*POSE)
    finally:
        renderer.close()
