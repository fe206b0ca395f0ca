"""Simulate one control step of a camera by looks: renders of single columns when something changes in them.

The whole image is rendered at the end of each part of the way. Before that, a column is rendered when a
body's silhouette enters or leaves it, once half-way if a silhouette moves fast in it, and more often the
farther its outlines move. Distant bodies move little, so their columns need no extra look. Between two
looks a pixel's light is taken as linear in time, so far fewer renders give the same events.
"""

from functools import lru_cache
from typing import NamedTuple

import numba
import numpy as np

from envs.checks import LIMIT_M, LIMIT_S
from envs.compiled import inlined, kernel
from envs.events.crossings import Room, make_room, named
from envs.events.emission import EVENT, Span
from envs.events.flicker import Flicker, brightness, looks_needed
from envs.events.lowpass import ColumnFilter
from envs.events.ramps import Ramps, Watch, events_of_ramps, look_at, make_ramps
from envs.raycast.columns import Workspace, make_workspace, paint_columns
from envs.raycast.records import BODY, Noise
from envs.raycast.silhouettes import (
    Looks,
    Stretch,
    aim_along,
    find_looks,
    find_near,
    find_silhouettes,
    follow_bodies,
    make_looks,
)
from envs.raycast.stretches import Outlines, Shifts, divide_time, find_rows, make_outlines

BAD_POSE = -2
ROOM = 8  # [images]: ramps for this many images of firing pixels; then only the end of a part is rendered


class Scratch(NamedTuple):
    """Scratch arrays for one step of one camera, shared by all cameras of a process with this image size.

    Attributes:
        room: `Workspace` for at least as many bodies as the scene has.
        near: (N,) BODY, room for the bodies that can be in view on a way.
        columns: float32 (W, H), the rendered image, column after column.
        pixels: The scratch of `crossings.steps`.
        ramps: Room for `ROOM` ramps per pixel of the image.
        looks: Room for the looks at the image.
        outlines: Room for the outlines of the bodies.
        block: Room for a block of pixels.
    """

    room: Workspace
    near: np.ndarray
    columns: np.ndarray
    pixels: tuple[np.ndarray, np.ndarray]
    ramps: Ramps
    looks: Looks
    outlines: Outlines
    block: Room


class View(NamedTuple):
    """The scene of one camera and the camera's memory; a step changes the arrays in place.

    Attributes:
        bodies: (N,) BODY, the obstacles.
        noise: Noise textures of the scene.
        frame: (1,) FRAME without the fields that depend on the pose.
        cull_m: Obstacles farther than this are not drawn [m].
        model: Model of a `ColumnCamera`, as in its `state`.
        memory: Memory of the camera, including the last image (as filtered by the photoreceptors, if they
            limit the bandwidth).
        seen_us: int64 (W,), time of the last look at each column [us].
        bandwidth: Bandwidth of the photoreceptors.
        shifts: Largest motion of outlines between two looks.
        flicker: Flicker of the scene's light.
        scratch: Scratch for a step.
    """

    bodies: np.ndarray
    noise: Noise
    frame: np.ndarray
    cull_m: float
    model: tuple
    memory: tuple
    seen_us: np.ndarray
    bandwidth: ColumnFilter
    shifts: Shifts
    flicker: Flicker
    scratch: Scratch


def scratch_for(width: int, height: int, num_bodies: int) -> Scratch:
    """Return scratch for images of `width` x `height` pixels and scenes of `num_bodies` bodies."""
    return _scratch(width, height, 1 << (num_bodies - 1).bit_length())


@lru_cache(maxsize=4)
def _scratch(width: int, height: int, num_bodies: int) -> Scratch:
    """Allocate one scratch per size; scenes share it, so that it stays in the processor's cache."""
    size, words = width * height, (width * height + 7) // 8
    return Scratch(
        room=make_workspace(num_bodies, height),
        near=np.empty(num_bodies, BODY),
        columns=np.zeros((width, height), np.float32),
        pixels=(np.zeros(words, np.uint64), np.zeros(8 * words, np.int64)),
        ramps=make_ramps(ROOM * size),
        looks=make_looks(width),
        outlines=make_outlines(num_bodies),
        block=make_room(),
    )


@numba.njit(cache=True, error_model="numpy")
def sense_way(view, way, parts):
    """Simulate the camera along a way.

    Args:
        view: `View`; its last image becomes the image at the end of the way.
        way: `Way`.
        parts: Number of parts of equal time into which the way is cut. There are more if the light flickers
            faster, and more looks at columns in which something is near.

    Returns:
        First invalid pixel, -1 (all valid) or BAD_POSE; number of events lost; number of columns rendered;
        sorted EVENT array.
    """
    bodies, scratch, outlines = view.bodies, view.scratch, view.scratch.outlines
    model, memory = named(view.model, view.memory)
    watch = Watch(model, memory, view.seen_us, scratch.pixels, scratch.ramps, scratch.block, view.bandwidth)
    scratch.room.frames[0] = view.frame[0]
    if not _is_near(way):
        return BAD_POSE, 0, 0, np.empty(0, EVENT)
    for column in range(view.seen_us.size):  # nothing changed while the camera stood still
        view.seen_us[column] = max(view.seen_us[column], way.start_us)
    parts = min(max(parts, looks_needed(view.flicker, way.moving_us)), way.moving_us)
    count, stretches = _divide(view, way, parts)
    frame, near = view.frame[0], scratch.near
    near = near[: find_near(bodies, way, frame.focal, view.seen_us.size, view.cull_m, near)]
    before, after, followed = outlines.before[:count], outlines.after[:count], outlines.followed[:count]
    events, lost, columns, begun_us = np.empty(0, EVENT), 0, 0, way.start_us
    kept = np.int64(0)  # a plain 0 would make numba compile everything below a second time
    end_us = begun_us
    for number in range(1, parts * stretches + 1):
        begin_us, end_us = end_us, way.start_us + way.moving_us * number // (parts * stretches)
        if parts * stretches > 1:  # `_divide` has found both ends of a way that is one stretch
            before, after = (after, before) if number > 1 else (before, after)
            aim_along(scratch.room.frames[0], way, end_us)
            find_silhouettes(bodies, followed, view.seen_us.size, scratch.room, after)
        stretch = Stretch(number, begin_us, end_us, followed, before, after)
        ends = number % stretches == 0
        bad, kept, more, looked = _look_along(view, near, way, stretch, ends, watch, kept)
        if bad >= 0:
            return bad, 0, 0, np.empty(0, EVENT)
        lost, columns = lost + more, columns + looked
        if ends:
            more_events = events_of_ramps(watch, kept, Span(begun_us, end_us))
            events = more_events if number == stretches else joined(events, more_events)
            begun_us, kept = end_us, np.int64(0)
    return -1, lost, columns, events


@kernel
def _divide(view, way, parts):
    """Choose how many stretches each part of a way is cut into.

    The scratch's outlines become the outlines of the bodies in view at both ends of the way.

    Returns:
        The number of bodies in view and the number of stretches.
    """
    bodies, room, outlines, width = view.bodies, view.scratch.room, view.scratch.outlines, view.seen_us.size
    shifts, frame = _of_part(view.shifts, parts), room.frames[0]
    count = follow_bodies(bodies, way, frame.focal, width, view.cull_m, outlines.followed)
    followed = outlines.followed[:count]
    aim_along(frame, way, way.start_us + way.moving_us)
    find_silhouettes(bodies, followed, width, room, outlines.after)
    find_rows(bodies, followed, width, way, shifts, room, outlines.rows_after)
    aim_along(frame, way, way.start_us)
    find_silhouettes(bodies, followed, width, room, outlines.before)
    find_rows(bodies, followed, width, way, shifts, room, outlines.rows_before)
    limit = way.moving_us // parts  # a stretch lasts at least one microsecond
    return count, divide_time(bodies, count, outlines, way, frame, shifts, limit, view.scratch.looks)


@kernel
def _look_along(view, near, way, stretch, ends, watch, kept):
    """Render the columns due in a stretch of a way; all columns if the stretch `ends` a part of the way.

    `near` are the bodies that can be in view.

    Returns:
        First invalid pixel or -1, number of ramps in use, events lost, columns rendered.
    """
    room, painted, looks = view.scratch.room, view.scratch.columns, view.scratch.looks
    lost = columns = 0
    for k in range(find_looks(view.bodies, room.frames[0].focal, way, stretch, looks)):
        t_us, first, last = looks.t_us[k], looks.first[k], looks.last[k]
        needed = ends and t_us == stretch.end_us
        full = kept + 2 * painted.size > watch.ramps.pixels.size
        if not needed and (full or _is_seen(view.seen_us, first, last, t_us)):
            continue
        aim_along(room.frames[0], way, t_us)
        paint_columns(near, view.noise, painted.T, first, last, view.cull_m, room)
        if view.flicker.depth > 0.0:
            _dim(painted, first, last, brightness(view.flicker, t_us))
        bad, kept, more = look_at(painted, first, last, t_us, watch, kept)
        if bad >= 0:
            return bad, kept, lost, columns
        lost, columns = lost + more, columns + last - first
    return -1, kept, lost, columns


@inlined
def _dim(painted, first, last, factor):
    """Multiply columns `first` .. `last` - 1 of an image (W, H) by a factor."""
    for column in range(first, last):
        for row in range(painted.shape[1]):
            painted[column, row] *= factor


@inlined
def _of_part(shifts, parts):
    """Scale the shifts allowed in each part to the whole way."""
    return Shifts(shifts.upright * parts, shifts.level * parts, shifts.bent * parts)


@kernel
def _is_seen(seen_us, first, last, t_us):
    """Whether any of these columns was rendered at or after `t_us`."""
    latest = seen_us[first]
    for column in range(first + 1, last):
        latest = max(latest, seen_us[column])
    return latest >= t_us


@kernel
def _is_near(way):
    """Whether `envs.checks.check_pose` would accept the end of a way."""
    near = abs(way.end_x) <= LIMIT_M and abs(way.end_y) <= LIMIT_M and 0.0 <= way.height <= LIMIT_M
    return near and (way.start_us + way.moving_us) * 1e-6 <= LIMIT_S


@numba.njit(cache=True, error_model="numpy")
def joined(events, more):
    """Concatenate two EVENT arrays."""
    joined = np.empty(events.size + more.size, EVENT)
    joined[: events.size] = events
    joined[events.size :] = more
    return joined
