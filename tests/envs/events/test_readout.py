"""Latency, jitter and a full readout: every event leaves, waits, or is counted as lost."""

import numpy as np
import pytest

from envs.config import CameraConfig, EnvConfig
from envs.corridor import CorridorEnv
from envs.events import EVENT
from envs.events.readout import Readout

SHAPE = (8, 12)


def some_events(count, length_us, seed=0):
    rng = np.random.default_rng(seed)
    events = np.empty(count, EVENT)
    events["t"] = np.sort(rng.integers(1, length_us + 1, count))
    events["x"], events["y"] = rng.integers(0, SHAPE[1], count), rng.integers(0, SHAPE[0], count)
    events["p"] = rng.choice([-1, 1], count)
    return events[np.lexsort((events["x"], events["y"], events["t"]))]


def sent(events, cuts, **fields):
    """What leaves at each of these times, and how many events are lost."""
    readout = Readout(CameraConfig(width=12, height=8, **fields), 0, np.random.default_rng(0))
    parts, lost, before = [], 0, 0
    for cut in cuts:
        inside = events[(events["t"] > before) & (events["t"] <= cut)]
        part, more = readout.send(inside, cut)
        assert ((part["t"] > before) & (part["t"] <= cut)).all()
        assert np.array_equal(np.lexsort((part["x"], part["y"], part["t"])), np.arange(len(part)))
        parts.append(part)
        lost, before = lost + more, cut
    return np.concatenate(parts), lost, len(readout._waiting)


@pytest.mark.parametrize("step_us", [100, 20_000])
def test_a_latency_moves_every_event_by_it_across_the_ends_of_steps(step_us):
    events = some_events(2000, 19_000)
    late, lost, waiting = sent(events, range(step_us, 20_001, step_us), latency_us=700)
    expected = events.copy()
    expected["t"] += 700
    assert lost == waiting == 0
    assert late.tobytes() == expected.tobytes()


def test_jitter_has_its_deviation_and_no_event_comes_before_its_cause():
    events = some_events(5000, 19_000)
    events["t"] = 10_000
    late, lost, waiting = sent(events, [20_000], latency_us=500, latency_jitter_us=100.0)
    assert lost == waiting == 0
    assert abs(late["t"].mean() - 10_500) < 4 * 100 / np.sqrt(5000)
    assert abs(late["t"].std() / 100 - 1) < 4 / np.sqrt(2 * 5000)
    early = sent(events, [20_000], latency_jitter_us=100.0)[0]
    assert early["t"].min() >= 10_000


@pytest.mark.parametrize("readout_hz", [1e4, 1e6])
def test_no_more_events_leave_than_the_limit_and_none_is_forgotten(readout_hz):
    events = some_events(3000, 20_000)
    out, lost, waiting = sent(events, range(50, 20_001, 50), readout_hz=readout_hz)
    assert len(out) + lost + waiting == len(events)
    assert len(out) <= readout_hz * 0.02 + SHAPE[1]  # the row that is being sent
    assert lost > 0 or readout_hz == 1e6
    whole = sent(events, [20_000], readout_hz=readout_hz)
    assert whole[0].tobytes() == out.tobytes()
    assert whole[1:] == (lost, waiting)


def test_rows_take_turns_and_leave_whole():
    events = np.zeros(96, EVENT)
    events["t"], events["p"] = 100, 1
    events["y"], events["x"] = np.divmod(np.arange(96), 12)
    out, lost, _ = sent(events, [20_000], readout_hz=1e5)  # 10 us an event, 120 us a row
    assert lost == 0
    assert np.array_equal(out["t"], 100 + 120 * out["y"].astype(int))


def test_a_pixel_that_waits_fires_no_other_event():
    events = np.zeros(3, EVENT)
    events["t"], events["p"], events["y"] = [1, 2, 3], [1, 1, -1], [0, 1, 1]
    out, lost, _ = sent(events, [20_000], readout_hz=1e4)
    assert lost == 1
    assert out["t"].tolist() == [1, 101]
    assert out["p"].tolist() == [1, 1]


def test_an_environment_counts_what_its_readout_loses():
    def played(**fields):
        camera = CameraConfig(width=16, height=16, contrast_threshold=0.02, **fields)
        env = CorridorEnv(EnvConfig(camera=camera, window_capacity=None))
        env.reset(seed=0)
        infos = [env.step(0)[4] for _ in range(30)]
        return sum(info["num_events"] for info in infos), sum(info["dropped_events"] for info in infos)

    free, none = played()
    assert none == 0
    kept, lost = played(readout_hz=1000.0)
    assert kept <= 1000.0 * 0.15 + 16
    assert 0 < lost <= free - kept
