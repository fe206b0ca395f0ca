"""Argument checks of both renderers."""

import math

LIMIT_M = 1e6  # largest distance of a pose from the origin, per axis
LIMIT_S = 1e9


def check_image(width: int, height: int, fov_deg: float, samples: int, cull_m: float) -> None:
    """Raise ValueError unless sizes and samples are >= 1, fov_deg is in [1, 170] and cull_m positive."""
    if not (min(width, height, samples) >= 1 and 1.0 <= fov_deg <= 170.0):
        raise ValueError(
            "width, height and samples must be >= 1 and fov_deg in [1, 170], "
            f"got {width}, {height}, {samples}, {fov_deg}"
        )
    if not cull_m > 0.0:
        raise ValueError(f"cull_m must be > 0 m (inf: draw everything), got {cull_m!r}")


def check_pose(pose: tuple[float, float, float, float], t_s: float) -> None:
    """Raise ValueError unless `pose` (x, y, z [m], yaw [rad]) is finite, above ground and within 1000 km."""
    x, y, z, yaw = pose
    # Each value separately: Python's max() may ignore a NaN.
    near = all(abs(value) <= LIMIT_M for value in (x, y, z))
    if not (near and z >= 0.0 and math.isfinite(yaw)):
        raise ValueError(f"pose (x, y, z, yaw) must be finite, z >= 0 and within {LIMIT_M:g} m, got {pose}")
    if not abs(t_s) <= LIMIT_S:
        raise ValueError(f"t_s must be within +-{LIMIT_S:g} s; got {t_s!r}.")
