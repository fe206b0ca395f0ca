import math

import mpmath
import numpy as np
import pytest

from envs.events import EventCamera
from envs.events.photoreceptor import (
    MAX_LUMINANCE,
    exponential,
    light_of,
    natural_logarithm,
    respond,
    response_curve,
)


def room(values):
    return np.empty(values.size, np.int64)


def response_of(luminance, name, floor):
    if name == "log":
        return math.log(luminance + floor)
    return math.log(luminance) if luminance > floor else luminance / floor - 1.0 + math.log(floor)


@pytest.mark.parametrize("floor", [1e-6, 1e-3, 0.1, 1.0])
def test_the_linear_part_of_a_response_joins_the_logarithm_without_a_kink(floor):
    curve = response_curve("lin_log", floor)
    offset = np.array([-2e-3, -1e-3, 0.0, 1e-3, 2e-3])
    levels = np.empty(5)
    respond(curve, (floor * (1 + offset)).astype(np.float32), levels, room(levels))
    slopes = np.diff(levels) / 1e-3  # in units of 1 / floor
    assert np.abs(slopes - 1.0).max() < 3e-3
    assert levels[2] == pytest.approx(math.log(floor), abs=1e-6)


@pytest.mark.parametrize("response", ["log", "lin_log"])
def test_a_response_and_its_light_undo_each_other(response):
    curve = response_curve(response, 1e-3)
    light = np.concatenate(([0.0], np.geomspace(1e-7, 1e38, 500))).astype(np.float32)
    levels = np.empty(light.size)
    respond(curve, light, levels, room(levels))
    truth = [response_of(float(v), response, 1e-3) for v in light]
    assert np.abs(levels - truth).max() < 1e-13
    light_of(curve, levels, room(levels))
    assert np.abs(levels - light).max() <= 1e38 * 1e-11
    assert (np.abs(levels - light) <= 1e-11 * (light + 1e-3)).all()


@pytest.mark.parametrize("response", ["log", "lin_log"])
def test_light_is_by_our_own_exponential_and_the_same_on_every_machine(response):
    curve = response_curve(response, 1e-3)
    levels = np.random.default_rng(0).permutation(np.linspace(-9.0, 88.0, 1000))  # the knee is at -6.9
    expected, dark = levels.copy(), levels < curve.lowest
    exponential(expected, room(expected))
    expected[dark] = curve.knee + (levels[dark] - curve.lowest) * curve.knee
    light_of(curve, levels, room(levels))
    assert levels.tobytes() == (expected - curve.shift).tobytes()


@pytest.mark.parametrize(("encoding", "gamma"), [("linear8", 1.0), ("gamma8", 2.2)])
def test_eight_bits_round_light_as_the_formula_has_it(encoding, gamma):
    rng = np.random.default_rng(0)
    light = [(1.2 * rng.random((16, 16))).astype(np.float32) for _ in range(4)]
    codes = [np.rint(255 * np.clip(v, 0, 1).astype(np.float64) ** (1 / gamma)) for v in light]
    rounded = [((c / 255) ** gamma).astype(np.float32) for c in codes]
    encoded, plain = EventCamera(16, 16, encoding=encoding), EventCamera(16, 16)
    encoded.reset(light[0], 0)
    plain.reset(rounded[0], 0)
    for k in range(1, 4):
        events = encoded.step(light[k], 1000 * k)
        assert events.tobytes() == plain.step(rounded[k], 1000 * k).tobytes() != b""


def test_eight_bits_refuse_what_is_no_light_and_change_nothing():
    cameras = [EventCamera(2, 1, encoding="gamma8") for _ in range(2)]
    for camera in cameras:
        camera.reset(np.float32([[0.1, 0.2]]), 0)
    for bad in (np.nan, np.inf, -0.1):
        with pytest.raises(ValueError, match="x=1, y=0"):
            cameras[0].step(np.float32([[0.9, bad]]), 1000)
    last = np.float32([[0.9, 0.1]])
    assert cameras[0].step(last, 1000).tobytes() == cameras[1].step(last, 1000).tobytes() != b""


def ulps(ours, truth):
    """Largest error in units in the last place of the result."""
    return max(
        float(abs(mpmath.mpf(o) - t) / np.spacing(abs(float(t)) or 1e-300))
        for o, t in zip(ours, truth, strict=True)
    )


def test_the_logarithm_is_within_one_ulp_of_the_true_one():
    rng = np.random.default_rng(0)
    single = np.concatenate(
        (np.geomspace(1e-45, MAX_LUMINANCE, 1500), rng.random(500), [1e-45, 1.0, MAX_LUMINANCE])
    )
    near_one = 1.0 + np.concatenate((np.geomspace(1e-16, 0.3, 300), -np.geomspace(1e-16, 0.3, 300)))
    values = np.concatenate([single.astype(np.float32) + floor for floor in (1e-9, 1e-3, 1.0)] + [near_one])
    values = values.astype(np.float64)
    logs = values.copy()
    natural_logarithm(logs, room(logs))
    with mpmath.workdps(40):
        assert ulps(logs, [mpmath.log(mpmath.mpf(v)) for v in values]) < 1.0


def test_the_exponential_is_exact_enough_for_the_quiet_band():
    values = np.linspace(-110.0, 110.0, 2001)
    results = values.copy()
    exponential(results, room(results))
    with mpmath.workdps(40):
        errors = [
            abs(mpmath.mpf(r) / mpmath.exp(mpmath.mpf(v)) - 1) for r, v in zip(results, values, strict=True)
        ]
    assert max(errors) < 1e-12
