"""Records that the kernels read and write by name: the frame, a body in it, a strip of a column, its gaps.

A kernel that takes a record is handed one pointer, whatever the record holds. All lengths are
in metres, rows and columns in pixels; slopes are right / forward, as seen from the camera.
"""

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

# What the elements of such arrays are to mypy: attributes of any name.
Record: TypeAlias = np.record


def _record(fields: Sequence[tuple[str, str | np.dtype]]) -> np.dtype:
    """Return a record whose fields are attributes, in a kernel as in Python (NUMBA_DISABLE_JIT=1)."""
    return np.dtype((np.record, np.dtype(list(fields), align=True)))


def _floats(*names: str) -> list[tuple[str, str]]:
    return [(name, "f8") for name in names]


class Ends(NamedTuple):
    """One number at either end of a strip: an edge is its rows there."""

    left: float
    right: float


ENDS = _record(_floats("left", "right"))

TEXTURE = _record(
    [
        ("pattern", "i8"),  # place in `envs.scene.textures.PATTERNS`
        *_floats("frequency", "contrast", "speed_s", "speed_q"),  # [1/m], 0 if plain, [m/s]
        ("noise", "i8"),  # of noise: its place among the scene's waves
    ]
)

# The camera and what the scene looks like, without its bodies.
FRAME = _record(
    [
        *_floats("horizon", "focal", "eye_x", "eye_y", "eye_z", "cos", "sin", "time"),
        ("samples", "i8"),  # strips per column of pixels
        ("discs", "i8"),  # whether `envs.raycast.discs` draws it
        *_floats("sky", "floor"),  # luminance of the sky and of the plain ground
        ("tallest", "f8"),  # height that nothing rises above
        *_floats("wall_half", "wall_top", "wall_near", "wall_far", "wall_albedo"),  # at x = +-wall_half
        *_floats("ambient", "diffuse", "sun_x", "sun_y", "sun_z", "sun_right", "sun_forward"),
        # Luminance over albedo of faces that look up, down, along +x, -x, +y, -y.
        *_floats("lit_up", "lit_down", "lit_east", "lit_west", "lit_north", "lit_south"),
        *[(name, TEXTURE) for name in ("ground_texture", "wall_texture", "body_texture")],
    ]
)

BODY = _record(
    [
        ("kind", "i8"),  # POLE, CONE, ELLIPSOID or BOX
        ("number", "i8"),  # its place among the bodies of the scene
        *_floats("x", "y", "bottom", "top", "rx", "ry", "albedo"),
        ("turn", "f8"),  # metres of texture per radian around it
        # Whether it moves; if so, its velocity [m/s], and when it is at the place above [s].
        ("moves", "i8"),
        *_floats("vx", "vy", "vz", "since"),
        # Once it is in view: its axis from the eye, in the world and as the camera sees it, and
        # the slopes of its silhouette.
        *_floats("dx", "dy", "right", "forward", "low", "high"),
        *_floats("power", "bend", "crest"),  # of a round one: see `bodies.mean_root`
        # Its rows along the slope `at`, at which it was looked at last; `bodies.root` there, and
        # the cosine of a pole's side towards the sun.
        *_floats("at", "cap", "side", "under", "end", "root", "cosine"),
    ]
)

STRIP = _record(
    [
        ("slopes", ENDS),
        # Of what is being shown, rows where its upper level face, its side and its underside
        # begin, and where it ends.
        *[(name, ENDS) for name in ("cap", "side", "under", "end")],
        ("cosine", ENDS),  # of a pole's side towards the sun
        *_floats("entry", "leave"),  # depths where its middle enters and leaves a body
        ("mean_root", "f8"),
        *_floats("light", "level_light"),  # luminance of a body's side and of its level face
        # The wall that comes next, +1 or -1, its depth, and that of the wall after it.
        *_floats("wall_side", "wall_depth", "wall_after"),
        # Of the gap that is being painted: slopes of its ends and of its middle, its width [pixels].
        ("gap_slopes", ENDS),
        *_floats("slope", "weight"),
        ("tilt", "f8"),  # and how much brighter a pole is there to the right, by slope and as a share
    ]
)

# What nothing nearer covers of a strip: between two edges, over a part of its width, of 0 .. 1.
GAP = _record([(name, ENDS) for name in ("top", "bottom", "reach")])

# Where a column of pixels is cut, and the body that begins or ends there; -1: none does.
CUT = _record([("position", "f8"), ("body", "i8"), ("begins", "i8")])


class Noise(NamedTuple):
    """Noise of a scene.

    Attributes:
        waves: float32 (T, 4, K), of each texture: cycles a tile along s and q, turn [cycles], amplitude.
        ground: float32 (W, 2 * K, R), means of the waves' cosines and sines over the pixels of the
            ground, seen from above the origin; empty where nothing is tabulated.
        height: From which it is seen so [m].
    """

    waves: np.ndarray
    ground: np.ndarray
    height: float


class Mixing(NamedTuple):
    """Room for adding waves up.

    Attributes:
        terms: float32 (K,).
        turned: float32 (2 * K,), the ground's waves where the eye is: cosines and sines.
        means: float32 (H,), of the ground in one column.
    """

    terms: np.ndarray
    turned: np.ndarray
    means: np.ndarray


class Bends(NamedTuple):
    """Room for the rays by which a body that bends along a column is lit and textured, row by row.

    Attributes:
        lights: float64 (4 * R,), of the points of a row.
        turns, aheads: float64 (4 * R,), sines and cosines of their angles around the axis, from the direction
            to the eye, times their distance from it and the eye's [m^2]; then the angles [rad].
        ups: float64 (4 * R,), their heights [m].
        talls: float64 (4 * R,), how much of the row shows at their slopes [rows].
    """

    lights: np.ndarray
    turns: np.ndarray
    aheads: np.ndarray
    ups: np.ndarray
    talls: np.ndarray


class Canvas(NamedTuple):
    """Everything that painting a strip needs except the body itself.

    Attributes:
        frame: A FRAME record.
        strip: A STRIP record.
        gaps: GAP records; how many of them are in use is passed along.
        accumulators: (LAYERS, height + PADDING) float64 of a column, see `envs.raycast.coverage`.
        noise: Of the scene.
        mixing: Room for it.
        bends: Room for bodies that bend.
    """

    frame: Record
    strip: Record
    gaps: np.ndarray
    accumulators: np.ndarray
    noise: Noise
    mixing: Mixing
    bends: Bends
