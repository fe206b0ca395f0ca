import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.optimize import linear_sum_assignment

from envs import event_error as accuracy
from envs.config import CameraConfig, EnvConfig, FidelityConfig, with_floor
from envs.event_error import converged, event_error, measure_event_error
from envs.events import EVENT
from envs.fidelity import plan_renders
from envs.scene import make_scene
from jobs.rollout import diagnostics


def events(rows):
    return np.array([(t, x, y, p) for t, x, y, p in rows], EVENT)


STREAMS = st.lists(
    st.tuples(st.integers(0, 30), st.integers(0, 1), st.integers(0, 1), st.sampled_from([-1, 1])), max_size=12
).map(events)


@given(STREAMS, STREAMS, st.integers(0, 10))
def test_as_many_events_pair_up_as_can(one, other, tolerance_us):
    fits = np.zeros((len(one), len(other)))
    for i, a in enumerate(one):
        for j, b in enumerate(other):
            same = all(a[name] == b[name] for name in ("x", "y", "p"))
            fits[i, j] = same and abs(int(a["t"]) - int(b["t"])) <= tolerance_us
    pairs = fits[linear_sum_assignment(-fits)].sum()
    total = len(one) + len(other)
    assert event_error(one, other, tolerance_us) == pytest.approx(1 - 2 * pairs / total if total else 0.0)


@pytest.mark.parametrize("tolerance_us", [-1.0, np.nan])
def test_a_tolerance_that_cannot_be_is_refused(tolerance_us):
    with pytest.raises(ValueError, match="tolerance_us"):
        event_error(np.empty(0, EVENT), np.empty(0, EVENT), tolerance_us)


@given(arrays(np.int64, 20, elements=st.integers(0, 2**50)))
def test_far_times_are_compared_exactly(times):
    stream = np.zeros(20, EVENT)
    stream["t"], stream["p"] = times, 1
    later = stream.copy()
    later["t"] += 1
    assert event_error(stream, later, 1.0) == 0.0


def test_the_converged_simulation_has_no_error_and_more_renders_never_hurt_much():
    errors = []
    for share in (1, 2, 8):
        asked = FidelityConfig(max_step_m=0.1 / share, samples=8)
        errors.append(measure_event_error(EnvConfig(fidelity=asked), flights=3, steps=8).error)
    assert (np.diff(errors) < 2e-3).all()  # a few events of thousands come and go once it has converged
    assert errors[0] > 4 * errors[2]
    assert errors[2] < 0.003


def test_the_converged_simulation_looks_more_often_and_no_setting_spoils_it():
    scene = make_scene("texture_change", np.random.default_rng(0))
    usual = plan_renders(EnvConfig(), scene)
    camera = CameraConfig(memory="legacy", encoding="gamma8", contrast_threshold=0.2)
    spoilt = EnvConfig(camera=camera, fidelity=FidelityConfig(0.5), renderer="pyrender")
    exact = converged(spoilt, scene)
    chosen = plan_renders(exact, scene)
    assert (exact.camera, chosen.renderer) == (with_floor(CameraConfig()), "raycast")
    assert chosen.max_step_m <= usual.max_step_m / 6
    assert all(6.0 * np.array(chosen.max_shifts_px) < usual.max_shifts_px)
    assert chosen.samples > usual.samples
    assert chosen.cull_m > 1e5


def test_a_flight_weighs_as_much_as_its_events(monkeypatch):
    one, many = events([(1, 0, 0, 1)]), events([(t, 0, 0, 1) for t in range(8)])
    flights = iter([(one, one, 1), (many, many[:0], 2)])
    monkeypatch.setattr(accuracy, "_measure_flight", lambda *_: next(flights))
    found = measure_event_error(EnvConfig(), flights=2, steps=1)
    assert found.error == pytest.approx(8 / 10)  # of ten events of both streams two have a partner
    assert found.events == (4.5, 0.5)
    assert found.renders == 1.5


def test_two_measurements_agree_and_other_corridors_differ():
    config = EnvConfig(fidelity=FidelityConfig(tolerance=0.2))
    first, again, other = (measure_event_error(config, flights=2, steps=4, seed=seed) for seed in (0, 0, 1))
    assert first == again
    assert first != other


def test_a_camera_that_forgets_is_told_from_one_that_remembers():
    frame = measure_event_error(EnvConfig(camera=CameraConfig(memory="frame")), flights=2, steps=6)
    assert frame.renders == 1.0
    assert frame.error > 0.3
    assert frame.events[0] < 0.8 * frame.events[1]


@pytest.mark.parametrize(
    ("scene", "hz", "flights", "steps"), [("poles", 45.0, 4, 8), ("texture_change", 400.0, 2, 3)]
)
def test_the_error_achieved_is_within_the_tolerance_asked(scene, hz, flights, steps):
    accuracy = measure_event_error(EnvConfig(scene=scene, control_hz=hz), flights, steps)
    assert accuracy.events[1] > 10
    assert accuracy.error <= EnvConfig().fidelity.tolerance


def test_culling_by_tolerance_adds_little_to_the_error_in_a_long_lane():
    lane = EnvConfig(layout={"last_y_m": 300.0, "num_obstacles": 120}, fidelity=FidelityConfig(0.2))
    whole = dataclasses.replace(lane, fidelity=FidelityConfig(0.2, cull_m=1e5))
    culled, exact = (measure_event_error(config, flights=4, steps=8) for config in (lane, whole))
    assert exact.error < culled.error <= exact.error + 0.1 * 0.2


SCENES = ["poles", "cones", "gates", "poles_dense", "poles_eval", "shape_change", "texture_change", "dynamic"]


@pytest.mark.slow
@pytest.mark.parametrize("scene", SCENES)
def test_the_error_achieved_is_within_the_tolerance_asked_everywhere(scene):
    short = []
    rates, thresholds, tolerances = (45.0, 100.0, 200.0, 400.0), (0.05, 0.2, 0.5), (0.02, 0.05, 0.2)
    for hz, threshold, tolerance in itertools.product(rates, thresholds, tolerances):
        camera = CameraConfig(contrast_threshold=threshold)
        config = EnvConfig(scene=scene, control_hz=hz, camera=camera, fidelity=FidelityConfig(tolerance))
        error = measure_event_error(config, flights=6, steps=12).error
        if error > tolerance:
            short.append((hz, threshold, tolerance, round(error, 4)))
    assert short == []


@pytest.mark.parametrize(("error", "says"), [(0.02, False), (0.2, True)])
def test_a_job_says_what_it_achieves_and_whether_that_is_less_than_asked(monkeypatch, capsys, error, says):
    monkeypatch.setattr(
        diagnostics, "measure_event_error", lambda config: accuracy.Accuracy(error, (9.0, 10.0), 3.0)
    )
    found = diagnostics.report_event_error(EnvConfig())
    assert found == {"sim/event_error": error, "sim/renders_per_step": 3.0}
    text = " ".join(capsys.readouterr().out.split())
    assert f"{error:.1%} (asked: at most 5.0%)" in text
    assert ("more than asked" in text) == says


def test_a_simulation_without_a_camera_is_not_said_to_be_exact():
    with pytest.raises(ValueError, match=r"observation must be one that has a camera.*got 'none'"):
        measure_event_error(EnvConfig(observation="none"))
