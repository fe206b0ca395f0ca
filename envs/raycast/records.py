"""Records that the kernels read and write by name: the frame, a body in it, a strip of a column, its gaps.

A kernel receives a record as one pointer, however large the record is. All lengths are in
metres, rows and columns in pixels; slopes are right / forward, as seen from the camera.
"""

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

# The type of such arrays' elements for mypy: attributes of any name.
Record: TypeAlias = np.record


def _record(fields: Sequence[tuple[str, str | np.dtype]]) -> np.dtype:
    """Return a record type whose fields are attributes in kernels and in Python (NUMBA_DISABLE_JIT=1)."""
    return np.dtype((np.record, np.dtype(list(fields), align=True)))


def _floats(*names: str) -> list[tuple[str, str]]:
    return [(name, "f8") for name in names]


class Ends(NamedTuple):
    """One number at each end of a strip; an edge is its rows at both ends."""

    left: float
    right: float


ENDS = _record(_floats("left", "right"))

TEXTURE = _record(
    [
        ("pattern", "i8"),  # index in `envs.scene.textures.PATTERNS`
        *_floats("frequency", "contrast", "speed_s", "speed_q"),  # [1/m], 0 if plain, [m/s]
        ("noise", "i8"),  # for noise: its index among the scene's waves
    ]
)

# The camera and the scene without its bodies.
FRAME = _record(
    [
        *_floats("horizon", "focal", "eye_x", "eye_y", "eye_z", "cos", "sin", "time"),
        ("samples", "i8"),  # strips per column of pixels
        ("discs", "i8"),  # whether `envs.raycast.discs` draws the bodies
        *_floats("sky", "floor"),  # luminance of the sky and of the plain ground
        ("tallest", "f8"),  # height of the highest point of the scene
        *_floats("wall_half", "wall_top", "wall_near", "wall_far", "wall_albedo"),  # at x = +-wall_half
        *_floats("ambient", "diffuse", "sun_x", "sun_y", "sun_z", "sun_right", "sun_forward"),
        # Luminance over albedo of faces whose normal points up, down, along +x, -x, +y, -y.
        *_floats("lit_up", "lit_down", "lit_east", "lit_west", "lit_north", "lit_south"),
        *[(name, TEXTURE) for name in ("ground_texture", "wall_texture", "body_texture")],
    ]
)

BODY = _record(
    [
        ("kind", "i8"),  # POLE, CONE, ELLIPSOID or BOX
        *_floats("x", "y", "bottom", "top", "rx", "ry", "albedo"),
        ("turn", "f8"),  # metres of texture per radian around it
        # Whether it moves; if so, its velocity [m/s], and the time of the place above [s].
        ("moves", "i8"),
        *_floats("vx", "vy", "vz", "since"),
        # Set once it is in view: its axis from the eye, in the world's and in the camera's axes, and
        # the slopes of its silhouette.
        *_floats("dx", "dy", "right", "forward", "low", "high"),
        *_floats("power", "bend", "crest"),  # of a round body, see `bodies.mean_root`
        # Its rows along the slope `at`, the last one computed; `bodies.root` there, and the cosine
        # of a pole's side towards the sun.
        *_floats("at", "cap", "side", "under", "end", "root", "cosine"),
    ]
)

STRIP = _record(
    [
        ("slopes", ENDS),
        # Of the surface being painted: rows where its upper level face, its side and its underside
        # begin, and where it ends.
        *[(name, ENDS) for name in ("cap", "side", "under", "end")],
        ("cosine", ENDS),  # of a pole's side towards the sun
        *_floats("entry", "leave"),  # depths where the strip's middle enters and leaves a body
        ("mean_root", "f8"),
        *_floats("light", "level_light"),  # luminance of a body's side and of its level face
        # The next wall, +1 or -1, its depth, and the depth of the wall after it.
        *_floats("wall_side", "wall_depth", "wall_after"),
        # Of the gap being painted: slopes of its ends and of its middle, its width [pixels].
        ("gap_slopes", ENDS),
        *_floats("slope", "weight"),
        ("tilt", "f8"),  # relative change of a pole's light per slope, positive if brighter to the right
    ]
)

# A part of a strip that nothing nearer covers: between two edges, over a range of the width in 0 .. 1.
GAP = _record([(name, ENDS) for name in ("top", "bottom", "reach")])

# Position where a column of pixels is cut, and the body that begins or ends there; -1: none.
CUT = _record([("position", "f8"), ("body", "i8"), ("begins", "i8")])


class Noise(NamedTuple):
    """Noise of a scene.

    Attributes:
        waves: float32 (T, 4, K), for each texture: cycles a tile along s and q, turn [cycles], amplitude.
        ground: float32 (W, 2 * K, R), means of the waves' cosines and sines over the pixels of the
            ground, seen from above the origin; empty if nothing is tabulated.
        height: Height of the eye for which `ground` holds [m].
    """

    waves: np.ndarray
    ground: np.ndarray
    height: float


class Mixing(NamedTuple):
    """Room for summing waves.

    Attributes:
        terms: float32 (K,), one term per wave.
        turned: float32 (2 * K,), cosines and sines of the ground's waves at the eye's position.
        means: float32 (H,), means of the ground's noise in one column.
    """

    terms: np.ndarray
    turned: np.ndarray
    means: np.ndarray


class Bends(NamedTuple):
    """Room for the sample points at which a curved body is lit and textured, four per row.

    Attributes:
        lights: float64 (4 * R,), luminance at each point times its part of the row.
        turns, aheads: float64 (4 * R,), sine and cosine of each point's angle around the axis, from the
            direction to the eye, times the distances of point and eye from the axis [m^2]; later `turns`
            holds the angles [rad].
        ups: float64 (4 * R,), height of each point [m].
        talls: float64 (4 * R,), visible height of the row at the point's slope [rows].
    """

    lights: np.ndarray
    turns: np.ndarray
    aheads: np.ndarray
    ups: np.ndarray
    talls: np.ndarray


class Canvas(NamedTuple):
    """All data for painting a strip except the body itself.

    Attributes:
        frame: A FRAME record.
        strip: A STRIP record.
        gaps: GAP records; the number in use is passed separately.
        accumulators: (LAYERS, height + PADDING) float64 of a column, see `envs.raycast.coverage`.
        noise: Noise textures of the scene.
        mixing: Room for summing their waves.
        bends: Room for curved bodies.
    """

    frame: Record
    strip: Record
    gaps: np.ndarray
    accumulators: np.ndarray
    noise: Noise
    mixing: Mixing
    bends: Bends
