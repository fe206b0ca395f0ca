"""From a pixel to the reader: latency, jitter, and a readout of limited rate."""

import numba
import numpy as np

from envs.config import CameraConfig
from envs.events.emission import EVENT


class Readout:
    """The readout of one sensor.

    With a rate limit, rows take turns. Whenever the readout is free, the next row with waiting pixels sends
    all their events with one timestamp. The readout is then busy for the time that the limit allots to these
    events. A waiting pixel fires no other event.
    """

    def __init__(
        self, camera: CameraConfig, t_us: int, rng: np.random.Generator, dtype: np.dtype = EVENT
    ) -> None:
        """Create the readout of a camera that starts at time `t_us` [us]; `rng` draws the jitter.

        Its events have the type `dtype`: EVENT, or EVENT with more fields, which stay with their event.
        """
        self._camera, self._rng = camera, rng
        self._waiting = np.empty(0, dtype)
        self._free_us, self._row = float(t_us), 0

    def send(self, events: np.ndarray, t1_us: int) -> tuple[np.ndarray, int]:
        """Return the events that leave the sensor until `t1_us`; the others wait for the next call.

        Args:
            events: Events of the pixels since the last call, sorted by t, at most `t1_us`.
            t1_us: The time [us].

        Returns:
            Events sorted by (t, y, x), and the number of events lost because their pixel was waiting.
        """
        camera = self._camera
        if camera.latency_us > 0 or camera.latency_jitter_us > 0.0:
            events = events.copy()
            late_us = camera.latency_jitter_us * self._rng.standard_normal(events.size)
            events["t"] += np.maximum(np.rint(camera.latency_us + late_us), 0.0).astype(np.int64)
        events = np.concatenate((self._waiting, events))
        events = events[np.argsort(events["t"], kind="stable")]
        if camera.readout_hz == 0.0:
            ready, lost = events["t"] <= t1_us, 0
            sent, self._waiting = events[ready], events[~ready]
        else:
            state = np.array([self._free_us, self._row])
            shape = camera.height, camera.width
            leaves_us, lost = take_turns(events, t1_us, 1e6 / camera.readout_hz, shape, state)
            self._free_us, self._row = float(state[0]), int(state[1])
            sent, self._waiting = events[leaves_us >= 0], events[leaves_us == WAITS]
            sent["t"] = leaves_us[leaves_us >= 0]
        return sent[np.lexsort((sent["x"], sent["y"], sent["t"]))], lost


WAITS, LOST = -1, -2


@numba.njit(cache=True, error_model="numpy")
def take_turns(
    events: np.ndarray, t1_us: int, event_us: float, shape: tuple[int, int], state: np.ndarray
) -> tuple[np.ndarray, int]:
    """Return the time when each event leaves, int64 (N,), `WAITS` or `LOST`, and the number of lost events.

    Args:
        events: EVENT sorted by t.
        t1_us: Events that would leave later than this wait [us].
        event_us: Time that the readout is busy with one event [us].
        shape: (H, W).
        state: float64 (2,), time when the readout is free [us], and the next row; changed in place.
    """
    leaves_us, before = np.full(events.size, WAITS), np.full(events.size, -1)
    newest, waits, waiting = np.full(shape[0], -1), np.zeros(shape, np.bool_), 0
    now_us, row, asked, lost = state[0], int(state[1]), 0, 0
    while True:
        if waiting == 0 and asked < events.size:
            now_us = max(now_us, np.float64(events[asked].t))
        while asked < events.size and events[asked].t <= now_us:
            x, y = events[asked].x, events[asked].y
            if waits[y, x]:
                leaves_us[asked] = LOST
                lost += 1
            else:
                waits[y, x] = True
                before[asked], newest[y] = newest[y], asked
                waiting += 1
            asked += 1
        if waiting == 0 or np.ceil(now_us) > t1_us:
            break
        while newest[row] < 0:
            row = (row + 1) % shape[0]
        event, stamp_us = newest[row], np.int64(np.ceil(now_us))
        while event >= 0:
            leaves_us[event] = stamp_us
            waits[row, events[event].x] = False
            now_us += event_us
            waiting -= 1
            event = before[event]
        newest[row], row = -1, (row + 1) % shape[0]
    state[0], state[1] = now_us, row
    return leaves_us, lost
