"""Obstacles as plain records, and their sections by a level plane.

x, y, z is the centre of an obstacle and rx, ry, rz are its half-axes [m]; the bottom is at
z - rz, the top at z + rz. Bodies stand upright: poles, cones and ellipsoids are round about
their vertical axis (rx = ry); a cone has its base of radius rx at the bottom and its apex at
the top; a box is aligned with the axes, and four boxes form a gate. Bodies do not overlap.

A section is a level rectangle with rounded corners, stored as a row (x, y, ux, uy, hx, hy, r):
all points within r of the rectangle around (x, y) with half-sizes hx along (ux, uy) and hy
across it. A disc has hx = hy = 0, a box has r = 0, a straight edge has hy = r = 0.
"""

import numpy as np

OBSTACLE = np.dtype(
    [
        ("kind", "u1"),
        ("x", "f8"),
        ("y", "f8"),
        ("z", "f8"),
        ("rx", "f8"),
        ("ry", "f8"),
        ("rz", "f8"),
        ("albedo", "f4"),
    ]
)
POLE, CONE, ELLIPSOID, BOX = range(4)
KINDS = ("pole", "cone", "ellipsoid", "box")
ROUNDING = 1e-6  # excess over 1 allowed to a product with an albedo, which is float32


def checked_obstacles(obstacles: np.ndarray, contrast: float) -> np.ndarray:
    """Check obstacles whose texture raises the albedo by at most `contrast`; return a read-only copy.

    Raises:
        ValueError: The array is not of OBSTACLE records, or a record breaks a rule; the message names both.
    """
    if getattr(obstacles, "dtype", None) != OBSTACLE or obstacles.ndim != 1:
        raise ValueError(f"obstacles must be a 1-D array of scene.OBSTACLE, got {obstacles!r:.80}")
    numbers = np.stack([obstacles[name] for name in OBSTACLE.fields or () if name != "kind"])
    albedo = obstacles["albedo"].astype(np.float64)
    rules = {
        f"kind must be below {len(KINDS)}": obstacles["kind"] < len(KINDS),
        "numbers must be finite": np.isfinite(numbers).all(axis=0),
        "rx, ry and rz must be > 0": (numbers[3:6] > 0.0).all(axis=0),
        "rx must equal ry, boxes aside": (obstacles["rx"] == obstacles["ry"]) | (obstacles["kind"] == BOX),
        f"albedo must be in [0, 1], also times 1 + {contrast} (the texture's contrast)": (albedo >= 0.0)
        & (albedo * (1.0 + contrast) <= 1.0 + ROUNDING),
    }
    for rule, holds in rules.items():
        if not holds.all():
            first = int(np.argmin(holds))
            raise ValueError(f"obstacles: {rule}, got record {first}: {obstacles[first]}")
    kept = obstacles.copy()
    kept.flags.writeable = False
    return kept


def checked_mesh(vertices: np.ndarray, faces: np.ndarray, luminance: np.ndarray) -> tuple[np.ndarray, ...]:
    """Check a mesh; return read-only vertices (V, 3) [m], faces (F, 3) and luminance (V,).

    Raises:
        ValueError: A shape or a value is wrong.
    """
    points, corners, shades = np.asarray(vertices), np.asarray(faces), np.asarray(luminance)
    if points.shape[1:] != (3,) or corners.shape[1:] != (3,) or shades.shape != points.shape[:1]:
        shapes = (points.shape, corners.shape, shades.shape)
        raise ValueError(f"mesh must have shapes (V, 3), (F, 3) and (V,), got {shapes}")
    if corners.dtype.kind not in "iu" or not ((corners >= 0) & (corners < len(points))).all():
        raise ValueError(f"faces of the mesh must be integers below {len(points)}, the number of vertices")
    if not (np.isfinite(points).all() and (shades >= 0.0).all() and (shades <= 1.0 + ROUNDING).all()):
        raise ValueError("mesh must have finite vertices, and luminance in [0, 1]")
    arrays = tuple(array.copy() if array.flags.writeable else array for array in (points, corners, shades))
    for array in arrays:
        array.flags.writeable = False
    return arrays


def body_sections(obstacles: np.ndarray, height_m: float) -> np.ndarray:
    """Return the sections of bodies at the plane z = `height_m`; a body includes its top and bottom.

    Args:
        obstacles: (N,) OBSTACLE.
        height_m: Height of the plane [m].

    Returns:
        (M, 7) float64 sections of the M <= N bodies that reach the plane, in the same order.
    """
    up = height_m - (obstacles["z"] - obstacles["rz"])  # above the bottom
    down = (obstacles["z"] + obstacles["rz"]) - height_m  # below the top
    there = (up >= 0.0) & (down >= 0.0)
    bodies, up, down = obstacles[there], up[there], down[there]
    share = np.ones(len(bodies))
    cone, ellipsoid = bodies["kind"] == CONE, bodies["kind"] == ELLIPSOID
    share[cone] = down[cone] / (2.0 * bodies["rz"][cone])
    share[ellipsoid] = np.sqrt(up[ellipsoid] * down[ellipsoid]) / bodies["rz"][ellipsoid]
    share = np.minimum(share, 1.0)  # so that rounding never makes a section wider than its body
    box = bodies["kind"] == BOX
    sections = np.zeros((len(bodies), 7))
    sections[:, 0], sections[:, 1], sections[:, 2] = bodies["x"], bodies["y"], 1.0
    sections[:, 4], sections[:, 5] = np.where(box, bodies["rx"], 0.0), np.where(box, bodies["ry"], 0.0)
    sections[:, 6] = np.where(box, 0.0, share * bodies["rx"])
    return sections


def mesh_sections(vertices: np.ndarray, faces: np.ndarray, height_m: float) -> np.ndarray:
    """Return the straight edges in which the plane z = `height_m` cuts the surfaces of a mesh.

    A face that touches the plane along an edge or at a corner counts. A face that lies in the plane gives its
    three edges. Faces that share an edge give the same point on that edge, bit for bit.

    Args:
        vertices: (V, 3) [m].
        faces: (F, 3) integers.
        height_m: Height of the plane [m].

    Returns:
        (M, 7) float64 sections with hy = r = 0.
    """
    above = vertices[:, 2] - height_m
    sides = above[faces]
    faces = faces[(sides.min(axis=1, initial=np.inf) <= 0.0) & (sides.max(axis=1, initial=-np.inf) >= 0.0)]
    places, signs = vertices[faces].astype(np.float64), above[faces]  # (F, 3, 3), (F, 3)
    following = np.array([1, 2, 0])
    flip = signs > 0.0
    crossing = (flip & (signs[:, following] < 0.0)) | ((signs < 0.0) & flip[:, following])
    # From below to above, whatever the order of the corners, so that neighbouring faces agree.
    low = np.where(flip[..., None], places[:, following], places)
    high = np.where(flip[..., None], places, places[:, following])
    a, b = np.where(flip, signs[:, following], signs), np.where(flip, signs, signs[:, following])
    part = np.divide(a, a - b, out=np.zeros_like(a), where=crossing)
    cuts = low + part[..., None] * (high - low)
    points = np.concatenate([places, cuts], axis=1)[:, :, :2]  # up to three of these six lie in the plane
    order = np.argsort(~np.concatenate([signs == 0.0, crossing], axis=1), axis=1, kind="stable")
    count = (signs == 0.0).sum(axis=1) + crossing.sum(axis=1)
    rows = np.arange(len(faces))
    corner = points[rows[:, None], order[:, :3]]
    pairs = [(corner[:, 0], corner[rows, np.minimum(count, 2) - 1])]
    pairs += [(corner[count == 3, i], corner[count == 3, 2]) for i in (0, 1)]
    return edge_sections(*(np.concatenate(ends) for ends in zip(*pairs, strict=True)))


def edge_sections(a_m: np.ndarray, b_m: np.ndarray) -> np.ndarray:
    """Return straight edges from `a_m` to `b_m`, both (N, 2) [m], as (N, 7) sections."""
    along = b_m - a_m
    length = np.hypot(along[:, 0], along[:, 1])
    sections = np.zeros((len(a_m), 7))
    sections[:, :2], sections[:, 4] = a_m + 0.5 * along, 0.5 * length
    sections[:, 2] = 1.0
    straight = length > 0.0
    sections[straight, 2:4] = along[straight] / length[straight, None]
    return sections
