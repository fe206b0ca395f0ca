"""One control step of a camera that looks at columns when something changes in them.

The whole image is rendered at the end of each part of the way. Before that, a column is looked
at when the silhouette of a body enters or leaves it, and once half-way where one moves fast. The
light of a pixel is linear in time between, so far fewer renders give the same events.
"""

import numba
import numpy as np

from envs.checks import LIMIT_M, LIMIT_S
from envs.events.crossings import named
from envs.events.emission import EVENT, Span
from envs.events.ramps import Watch, events_of_ramps, look_at
from envs.raycast.columns import paint_columns
from envs.raycast.silhouettes import Stretch, aim_along, fastest, find_looks, find_silhouettes

BAD_POSE = -2
FAST = 0.7  # columns from one render to the next; a body that moves more is near, and all its edges move


@numba.njit(cache=True, error_model="numpy")
def sense_way(scene, way, parts, image, camera, looks):
    """Events of a way, and the image at its end.

    Args:
        scene: Bodies, filtered tiles, FRAME without a pose, distance beyond which bodies are not
            drawn [m], and `Workspace`.
        way: `Way`.
        parts: In how many parts of equal time the way is cut; twice as many where something is near.
        image: float32 (H, W), the last one; becomes that at the end.
        camera: The model, memory and scratch of an `EventCamera`, when each column was looked at
            last [us], and room for `Ramps` of three times as many pixels.
        looks: Room for `Looks`.

    Returns:
        First invalid pixel, -1 or BAD_POSE; events lost; columns looked at; EVENT array, sorted.
    """
    bodies, stacks, scene_frame, cull, room = scene
    values, rows, scratch, seen_us, ramps = camera
    model, memory = named(values, rows)
    watch = Watch(model, memory, seen_us, scratch, ramps)
    frame, width = room.frames[0], image.shape[1]
    room.frames[0] = scene_frame[0]
    if not _is_near(way):
        return BAD_POSE, 0, 0, np.empty(0, EVENT)
    before, after = np.empty((len(bodies), 2)), np.empty((len(bodies), 2))
    aim_along(frame, way, way.start_us + way.moving_us)
    find_silhouettes(bodies, width, cull, room, before)
    aim_along(frame, way, way.start_us)
    find_silhouettes(bodies, width, cull, room, after)
    if fastest(before, after) > FAST * parts:
        parts *= 2
    events, lost, columns, begin_us = np.empty(0, EVENT), 0, 0, way.start_us
    for part in range(1, parts + 1):
        end_us = way.start_us + way.moving_us * part // parts
        before, after = after, before
        aim_along(frame, way, end_us)
        find_silhouettes(bodies, width, cull, room, after)
        count = find_looks(bodies, way, Stretch(begin_us, end_us, before, after), room, looks)
        kept = 0
        for k in range(count + 1):
            t_us, first, last = end_us, 0, width
            if k < count:
                t_us, first, last = looks.t_us[k], looks.first[k], looks.last[k]
                if kept + 2 * image.size > ramps.pixels.size or seen_us[first:last].max() >= t_us:
                    continue
            aim_along(frame, way, t_us)
            paint_columns(bodies, stacks, image, first, last, cull, room)
            bad, kept, more = look_at(image, first, last, t_us, watch, kept)
            if bad >= 0:
                return bad, 0, 0, np.empty(0, EVENT)
            lost, columns = lost + more, columns + last - first
        more_events = events_of_ramps(watch, kept, Span(begin_us, end_us))
        events = more_events if part == 1 else _joined(events, more_events)
        begin_us = end_us
    return -1, lost, columns, events


@numba.njit(cache=True, error_model="numpy")
def _is_near(way):
    """Whether `envs.checks.check_pose` would accept the end of a way."""
    near = abs(way.end_x) <= LIMIT_M and abs(way.end_y) <= LIMIT_M and 0.0 <= way.height <= LIMIT_M
    return near and (way.start_us + way.moving_us) * 1e-6 <= LIMIT_S


@numba.njit(cache=True, error_model="numpy")
def _joined(events, more):
    """Two EVENT arrays as one."""
    joined = np.empty(events.size + more.size, EVENT)
    joined[: events.size] = events
    joined[events.size :] = more
    return joined
