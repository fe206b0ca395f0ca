"""Kernels of the ray caster: divide an image into strips, and paint each strip from near to far.

Columns of pixels are cut at each silhouette. In a strip between two cuts all edges are taken
as straight. Nearer surfaces are painted first, and the uncovered rest is stored as gaps
between edges. Except for poses, input is assumed valid.
"""

import math
from typing import NamedTuple

import numba
import numpy as np

from envs.checks import LIMIT_M, LIMIT_S
from envs.compiled import inlined, kernel
from envs.raycast.bodies import MIN_DEPTH, corner, depths, drop_hidden, is_before, outline, see_bodies
from envs.raycast.coverage import BLOCK, LAYERS, PADDING, cover_ground, ends, put, resolve
from envs.raycast.curved import make_bends
from envs.raycast.discs import paint_discs
from envs.raycast.noise import make_mixing, turn_waves
from envs.raycast.patterns import texture_cell, texture_column
from envs.raycast.records import BODY, CUT, FRAME, GAP, STRIP, Bends, Canvas, Ends, Mixing, Noise, Record
from envs.raycast.surfaces import enter_gap, show_body, show_walls, wall_depth
from envs.scene import BOX, CONE, ELLIPSOID

MIN_STRIP = 1e-9  # [pixels] cuts closer than this count as one
ARC_PARTS = 3  # most strips of equal height at each end of an ellipsoid's outline
ARC_ROWS = 1.0  # rows of the ellipsoid for each of these strips after the first
MIN_ARC = 0.01  # [pixels] smallest distance from a cone's silhouette at which a cut is worthwhile
GAPS = (701, 301, 132, 57, 23, 10, 4, 1)  # for the Shell sort of cuts
MAX_CUTS = 2 + 2 * max(2, ARC_PARTS)  # per body: its ends, and corners or arcs


class Part(NamedTuple):
    """The range of columns of an image to paint, in pixels.

    Attributes:
        half: Half of the image's width.
        left: Start of the range.
        right: End of the range.
    """

    half: float
    left: float
    right: float


class Workspace(NamedTuple):
    """Room for painting, allocated once for many images of the same scene and height.

    Attributes:
        seen: (N,) BODY, the bodies in view.
        order: (N,) int64, indices in `seen` of the bodies in a strip.
        cuts: CUT, the places where columns are cut.
        gaps: GAP, the parts of a strip that nothing nearer covers.
        strips: (1,) STRIP.
        frames: (1,) FRAME of the pose that is painted.
        accumulators: (BLOCK, LAYERS, height + PADDING) float64, zero between two blocks of columns.
        mixing: Room for noise.
        bends: Room for curved bodies.
    """

    seen: np.ndarray
    order: np.ndarray
    cuts: np.ndarray
    gaps: np.ndarray
    strips: np.ndarray
    frames: np.ndarray
    accumulators: np.ndarray
    mixing: Mixing
    bends: Bends


def make_workspace(num_bodies: int, height: int) -> Workspace:
    """Allocate room for painting images of `height` rows of a scene with `num_bodies` bodies."""
    return Workspace(
        seen=np.empty(num_bodies, BODY),
        order=np.empty(num_bodies, np.int64),
        cuts=np.empty(MAX_CUTS * num_bodies + 5, CUT),
        gaps=np.empty(max(height + PADDING, 2 * num_bodies + 32), GAP),
        strips=np.zeros(1, STRIP),
        frames=np.zeros(1, FRAME),
        accumulators=np.zeros((BLOCK, LAYERS, height + PADDING)),
        mixing=make_mixing(height),
        bends=make_bends(height),
    )


@numba.njit(cache=True, error_model="numpy")
def render_way(
    bodies: np.ndarray,
    noise: Noise,
    scene_frame: np.ndarray,
    poses: np.ndarray,
    columns: np.ndarray,
    cull: float,
    room: Workspace,
) -> int:
    """Fill images with the mean luminance over the area of each pixel.

    Args:
        bodies: (N,) BODY, see `envs.raycast.records`.
        noise: Noise textures of the scene.
        scene_frame: (1,) FRAME without the fields that depend on the pose.
        poses: (K, 5) float64 x, y, z [m], yaw [rad], time [s].
        columns: (K, W, H) float32, column after column, the layout of images in column cameras.
        cull: Bodies farther than this are not drawn [m].
        room: A `Workspace` for N bodies and H rows.

    Returns:
        The index of the first pose for which `envs.checks.check_pose` would raise, or -1.
    """
    room.frames[0] = scene_frame[0]
    for k in range(len(poses)):
        x, y, z, yaw, time = poses[k]
        near = abs(x) <= LIMIT_M and abs(y) <= LIMIT_M and 0.0 <= z <= LIMIT_M
        if not (near and abs(yaw) < np.inf and abs(time) <= LIMIT_S):
            return k
        aim(room.frames[0], x, y, z, yaw, time)
        first = np.int64(0)  # a plain 0 would make numba compile everything a second time
        paint_columns(bodies, noise, columns[k].T, first, columns.shape[1], cull, room)
    return -1


@kernel
def paint_columns(
    bodies: np.ndarray,
    noise: Noise,
    image: np.ndarray,
    first: int,
    last: int,
    cull: float,
    room: Workspace,
) -> None:
    """Fill columns `first` .. `last` - 1 of an image (H, W) seen from the pose in `room.frames[0]`.

    A column has the same bytes whichever columns are painted in the same call.
    """
    frame, half = room.frames[0], 0.5 * image.shape[1]
    if frame.discs:
        paint_discs(bodies, frame, image, (first, last), cull, room.seen, room.order, room.accumulators)
        return
    low, high = (first - half) / frame.focal, (last - half) / frame.focal
    count = see_bodies(bodies, frame, low, high, cull, room.seen)
    count = drop_hidden(room.seen, count, frame)
    size, total = _find_cuts(frame, room.seen[:count], Part(half, first, last), room.cuts, room.order)
    _sort_cuts(room.cuts, size)
    turn_waves(noise, frame, room.mixing)
    _sweep(room, noise, total, room.cuts[:size], image, first, last)


@kernel
def _sort_cuts(cuts: np.ndarray, size: int) -> None:
    """Sort the first `size` cuts by position (Shell 1959, with gaps after Ciura 2001)."""
    for gap in GAPS:
        for i in range(gap, size):
            position, body, begins = cuts[i].position, cuts[i].body, cuts[i].begins
            j = i
            while j >= gap and cuts[j - gap].position > position:
                cuts[j] = cuts[j - gap]
                j -= gap
            cuts[j].position, cuts[j].body, cuts[j].begins = position, body, begins


@kernel
def _sweep(
    room: Workspace, noise: Noise, total: int, cuts: np.ndarray, image: np.ndarray, first: int, last: int
) -> None:
    """Paint the strips between cuts from left to right, each with the bodies present in it.

    At the start, `room.order` holds the `total` bodies present at the left edge of column `first`.
    """
    frame, strip, seen, order = room.frames[0], room.strips[0], room.seen, room.order
    half, samples, focal, slopes = 0.5 * image.shape[1], frame.samples, frame.focal, strip.slopes
    known, passed = 0, 0
    while passed < len(cuts) and cuts[passed].position <= first + MIN_STRIP:
        known, total = _pass(order, known, total, cuts[passed])
        passed += 1
    for cell in range(first * samples, last * samples):
        column = cell // samples
        painted = room.accumulators[(column - first) % BLOCK]
        canvas = Canvas(frame, strip, room.gaps, painted, noise, room.mixing, room.bends)
        left, edge = cell / samples, (cell + 1) / samples
        while edge - left > MIN_STRIP:
            right = edge
            if passed < len(cuts) and cuts[passed].position < edge - MIN_STRIP:
                right = cuts[passed].position
            if known < total:
                _sort_new(frame, seen, order, known, total, (0.5 * (left + right) - half) / focal)
            known = total
            put(slopes, Ends((left - half) / focal, (right - half) / focal))
            _paint_strip(canvas, seen, order[:known])
            left = right
            while passed < len(cuts) and cuts[passed].position <= left + MIN_STRIP:
                known, total = _pass(order, known, total, cuts[passed])
                passed += 1
        _texture(canvas, cell, half)
        if (cell + 1) % samples == 0:
            resolve(frame, room.accumulators, image, column, first, last)


@inlined
def _texture(canvas: Canvas, cell: int, half: float) -> None:
    """Add the patterns of ground and walls to a cell, and to the column if this is its last cell."""
    frame, samples, focal = canvas.frame, canvas.frame.samples, canvas.frame.focal
    if frame.ground_texture.contrast > 0.0 or frame.wall_texture.contrast > 0.0:
        column = cell // samples
        texture_cell(canvas, (0.5 * (cell / samples + (cell + 1) / samples) - half) / focal)
        if (cell + 1) % samples == 0:
            texture_column(canvas, (column + 0.5 - half) / focal, column)


@kernel
def aim(frame: Record, x: float, y: float, z: float, yaw: float, time: float) -> None:
    """Set the fields of the frame that depend on the pose."""
    frame.eye_x, frame.eye_y, frame.eye_z, frame.time = x, y, z, time
    cos, sin = math.cos(yaw), math.sin(yaw)
    frame.cos, frame.sin = cos, sin
    frame.sun_right = frame.sun_x * cos + frame.sun_y * sin
    frame.sun_forward = frame.sun_y * cos - frame.sun_x * sin


@inlined
def _add_cut(cuts: np.ndarray, size: int, part: Part, position: float, shown: bool) -> int:
    """Store a cut of a column if it is `shown` and within the part; return the new number of cuts."""
    cuts[size].position, cuts[size].body = position, -1
    return size + (shown and part.left < position < part.right)


@kernel
def _find_cuts(
    frame: Record, seen: np.ndarray, part: Part, cuts: np.ndarray, order: np.ndarray
) -> tuple[int, int]:
    """Collect the cuts inside the part of the image that is painted.

    Returns:
        The number of cuts, and the number of bodies in `order`, which begin at or before its left edge.
    """
    size = total = 0
    centre, focal = part.half, frame.focal
    for i in range(len(seen)):
        body = seen[i]
        low, high = centre + focal * body.low, centre + focal * body.high
        if low <= part.left:
            order[total] = i
            total += 1
        else:
            cuts[size].position, cuts[size].body, cuts[size].begins = low, i, 1
            size += 1
        cuts[size].position, cuts[size].body, cuts[size].begins = high, i, 0
        size += high < part.right
        if body.kind == CONE:
            size = _cone_cuts(frame, body, part, cuts, size)
        if body.kind == ELLIPSOID:
            size = _arc_cuts(frame, body, part, cuts, size)
        if body.kind == BOX:
            size = _corner_cuts(frame, body, part, cuts, size)
    for k in range(4):
        dx = (frame.wall_half if k < 2 else -frame.wall_half) - frame.eye_x
        dy = (frame.wall_near if k % 2 else frame.wall_far) - frame.eye_y
        forward = dy * frame.cos - dx * frame.sin
        right = dx * frame.cos + dy * frame.sin
        size = _add_cut(cuts, size, part, centre + focal * right / forward, forward > 0.0)
    return size, total


@kernel
def _cone_cuts(frame: Record, body: Record, part: Part, cuts: np.ndarray, size: int) -> int:
    """Add cuts at the axis of a cone and where its straight outlines meet the edge of its base."""
    right, forward, radius = body.right, body.forward, body.rx
    square = right * right + forward * forward
    rise = body.top - frame.eye_z
    # Cosine of the angle about the axis from the eye to the outline, divided by the eye's distance.
    cosine = radius * radius * rise / ((body.top - body.bottom) * max(square, MIN_DEPTH))
    rest = radius * radius / max(square, MIN_DEPTH) - cosine * cosine
    for k in range(-1, 2):
        sine = k * math.sqrt(max(0.0, rest))
        back = abs(k) * cosine
        ahead = forward - back * forward + sine * right
        u = (right - back * right - sine * forward) / max(MIN_DEPTH, ahead)
        narrow = k != 0 and frame.focal * min(abs(u - body.low), abs(u - body.high)) < MIN_ARC
        shown = ahead > 0.0 and rest > 0.0 and not narrow
        size = _add_cut(cuts, size, part, part.half + frame.focal * u, shown)
    return size


@kernel
def _arc_cuts(frame: Record, body: Record, part: Part, cuts: np.ndarray, size: int) -> int:
    """Add cuts where an ellipsoid's outline bends most: in the outermost cell at its left and right end.

    The outline rises like a square root there, so the spacing of the cuts divides its height evenly.
    """
    low, high = body.low, body.high
    reach = min(0.5 * (high - low), 1.0 / (frame.samples * frame.focal))
    rows = frame.focal * (body.top - body.bottom) / max(MIN_DEPTH, body.forward)
    parts = int(min(ARC_PARTS, 1.0 + rows / ARC_ROWS))
    for k in range(1, parts + 1):
        bend = reach * (k / parts) ** 2
        for u in (low + bend, high - bend):
            size = _add_cut(cuts, size, part, part.half + frame.focal * u, True)
    return size


@kernel
def _corner_cuts(frame: Record, body: Record, part: Part, cuts: np.ndarray, size: int) -> int:
    """Add cuts at the nearest corner of a box, or at all corners if its top or underside is visible."""
    level = frame.eye_z > body.top or frame.eye_z < body.bottom
    nearest, least = 0, math.inf
    for k in range(4):
        right, forward = corner(body, frame, k)
        if right * right + forward * forward < least:
            nearest, least = k, right * right + forward * forward
    for k in range(4):
        right, forward = corner(body, frame, k)
        shown = forward > 0.0 and (level or k == nearest)
        size = _add_cut(cuts, size, part, part.half + frame.focal * right / forward, shown)
    return size


@kernel
def _pass(order: np.ndarray, known: int, total: int, cut: Record) -> tuple[int, int]:
    """Begin or end a body at a cut; return the new `known` and `total`.

    `order` holds `total` bodies, of which the first `known` are sorted.
    """
    if cut.body < 0:
        return known, total
    if cut.begins:
        order[total] = cut.body
        return known, total + 1
    for k in range(total):
        if order[k] == cut.body:
            for j in range(k, total - 1):
                order[j] = order[j + 1]
            return known - (k < known), total - 1
    return known, total


@kernel
def _sort_new(frame: Record, seen: np.ndarray, order: np.ndarray, known: int, total: int, u: float) -> None:
    """Insert the newly begun bodies into the `known` sorted bodies, by which hides which along slope `u`.

    Bodies are convex and do not overlap, so the order of two bodies holds as long as both are present.
    """
    for k in range(known, total):
        new = order[k]
        j = k
        while j > 0 and is_before(seen[new], seen[order[j - 1]], frame, u):
            order[j] = order[j - 1]
            j -= 1
        order[j] = new


@inlined
def _paint_strip(canvas: Canvas, seen: np.ndarray, order: np.ndarray) -> None:
    """Paint one strip: bodies and walls from near to far, then the ground in the gaps."""
    frame, strip, gaps = canvas.frame, canvas.strip, canvas.gaps
    u = 0.5 * (strip.slopes.left + strip.slopes.right)
    put(gaps[0].top, Ends(0.0, 0.0))
    put(gaps[0].bottom, Ends(2.0 * frame.horizon, 2.0 * frame.horizon))
    put(gaps[0].reach, Ends(0.0, 1.0))
    count = 1
    east, west = wall_depth(frame, 1.0, u), wall_depth(frame, -1.0, u)
    strip.wall_side = 1.0 if east < west else -1.0
    strip.wall_depth, strip.wall_after = min(east, west), max(east, west)
    highest = max(0.0, frame.tallest - frame.eye_z) * frame.focal
    for i in order:
        body = seen[i]
        entry, leave = depths(body, frame, u)
        if leave <= max(0.0, entry):
            continue
        count = show_walls(canvas, count, entry)
        # Nothing behind can rise above this row, and everything below the gap is ground.
        rise = frame.horizon - highest / max(MIN_DEPTH, entry)
        bottom = gaps[0].bottom
        if count == 0 or (count == 1 and bottom.left <= rise and bottom.right <= rise):
            return
        strip.mean_root = outline(body, frame, strip)
        strip.entry, strip.leave = max(MIN_DEPTH, entry), max(MIN_DEPTH, leave)
        count = show_body(canvas, body, count)
    count = show_walls(canvas, count, math.inf)
    if frame.ground_texture.contrast > 0.0:
        for k in range(count):
            enter_gap(frame, strip, gaps[k])
            top, bottom = ends(gaps[k].top), ends(gaps[k].bottom)
            cover_ground(frame, canvas.accumulators, top, bottom, strip.weight, strip.slope)
