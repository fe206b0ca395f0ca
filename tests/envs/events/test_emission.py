import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.events import EventCamera
from envs.events import camera as module
from envs.events.emission import Span, Trains, events_of


def texture(t_s, shape=(12, 16)):
    y, x = np.mgrid[: shape[0], : shape[1]]
    return (0.5 + 0.45 * np.sin((x - 40.0 * t_s) * 0.9 + 0.3 * y)).astype(np.float32)


@settings(max_examples=30)
@given(
    st.lists(
        st.tuples(st.integers(-60, 60), st.floats(-10, 6000), st.floats(0, 300)), min_size=1, max_size=40
    ),
    st.sampled_from([1, 63, 5000, 2**31, 2**51]),
    st.integers(1, 9),
)
def test_trains_become_events_in_total_order(rows, interval, width):
    counts, starts, strides = (np.array(column) for column in zip(*rows, strict=True))
    counts = counts.astype(np.int64)
    sent, pixels = np.abs(counts), np.arange(len(rows))
    trains = Trains(pixels, counts, sent, starts.astype(np.float64), strides.astype(np.float64))
    events = events_of(trains, Span(7, 7 + interval), width, int(sent.sum()))
    which = np.repeat(pixels, sent)
    order = np.concatenate([np.arange(n) for n in sent])
    t = 7 + np.clip(np.rint(trains.start[which] + order * trains.stride[which]), 1, interval).astype(np.int64)
    by_time = np.argsort(t, kind="stable")
    assert events["t"].tolist() == t[by_time].tolist()
    assert (events["y"].astype(int) * width + events["x"]).tolist() == which[by_time].tolist()
    assert events["p"].tolist() == np.sign(counts)[which[by_time]].tolist()


def test_a_burst_too_large_for_one_frame_ends_at_one_moment_for_all_pixels(monkeypatch):
    dark, light = texture(0.0), texture(0.0) * np.linspace(3.0, 30.0, 16, dtype=np.float32)

    def burst(dt_us, excess="drop"):
        camera = EventCamera(16, 12, excess=excess)
        camera.reset(dark, 0)
        return camera, camera.step(light, dt_us)

    everything, at_once = burst(5000)[1], burst(1)[1]
    monkeypatch.setattr(module, "MAX_EVENTS_PER_FRAME", 700)
    camera, kept = burst(5000)
    assert 600 < len(kept) <= 700 < len(everything)
    assert kept.tobytes() == everything[: len(kept)].tobytes()
    assert everything["t"][len(kept)] > kept["t"][-1]
    assert camera.dropped == len(everything) - len(kept)
    camera, kept = burst(1)
    assert np.unique(kept[["x", "y"]], return_counts=True)[1].tolist() == [700 // 192] * 192
    assert camera.dropped == len(at_once) - len(kept)
    camera, kept = burst(5000, "carry")
    late = [camera.step(light, 5000 + k) for k in range(1, 6)]
    assert len(kept) + sum(map(len, late)) == len(everything)
