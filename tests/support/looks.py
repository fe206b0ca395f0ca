"""A camera that is looked through column by column, without a scene."""

import numpy as np

from envs.config import CameraConfig
from envs.events.crossings import make_room, named
from envs.events.emission import Span
from envs.events.ramps import ColumnCamera, Watch, events_of_ramps, look_at, make_ramps

WIDTH, HEIGHT = 16, 12


class Looker:
    """A camera that is looked through column by column."""

    def __init__(self, first, t_us=0, **fields):
        self.config = CameraConfig(width=WIDTH, height=HEIGHT, **fields)
        self.camera = ColumnCamera(self.config)
        self.camera.reset(first)
        self.seen_us = np.full(WIDTH, t_us, np.int64)
        values, rows, scratch = self.camera.state
        model, memory = named(values, rows)
        ramps = make_ramps(8 * WIDTH * HEIGHT)
        self.watch = Watch(model, memory, self.seen_us, scratch, ramps, make_room(), self.camera.bandwidth)

    def look(self, *looks):
        """Events of looks (image, first column, column after the last, time [us]), and how many are lost."""
        start_us, kept, lost = int(self.seen_us.min()), 0, 0
        for image, first, last, t_us in looks:
            bad, kept, more = look_at(np.ascontiguousarray(image.T), first, last, t_us, self.watch, kept)
            assert bad == -1
            lost += more
        span = Span(start_us, max(t_us for *_, t_us in looks))
        return events_of_ramps(self.watch, kept, span), lost
