"""Check that the scenes of a configuration can be created."""

from collections.abc import Sequence

import numpy as np

from envs.config import EnvConfig
from envs.scene.layouts import LAYOUTS


def scene_errors(named: Sequence[tuple[str, str]], env: EnvConfig) -> list[str]:
    """Return one line for each scene that cannot be created: wrong name, file or values of env.layout.

    The unchanged layouts of `envs.scene.LAYOUTS` are known to be passable for the default vehicle, so only
    changed layouts and mesh files are drawn.

    Args:
        named: Pairs of the key that names a scene, and the scene; env.layout applies to each.
        env: Gives env.layout and the vehicle for which the scene must be passable.
    """
    vehicle = env.vehicle_radius_m, env.camera_height_m
    default = vehicle == (EnvConfig.vehicle_radius_m, EnvConfig.camera_height_m) and not env.layout
    errors = []
    for key, scene in named:
        if default and scene in LAYOUTS:
            continue
        from envs.scene import make_scene  # loads numba, which takes long

        try:
            make_scene(scene, np.random.default_rng(0), *vehicle, **env.layout)
        except ValueError as error:
            text = str(error)
            key = "env.layout" if text.startswith("layout") else key
            errors.append(f"{key}: {text.removeprefix('layout: ').removeprefix('scene ')}")
    return list(dict.fromkeys(errors))
