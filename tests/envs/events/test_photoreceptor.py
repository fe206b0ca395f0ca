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

each_response = pytest.mark.parametrize("response", ["log", "lin_log"])


def room(values):
    return np.empty(values.size, np.int64)


@each_response
@pytest.mark.parametrize("floor", [1e-6, 1e-3, 1.0])
def test_a_response_is_its_formula_and_its_light_undoes_it(response, floor):
    curve = response_curve(response, floor)
    light = np.concatenate(([0.0], np.geomspace(1e-7, 1e38, 500))).astype(np.float32)
    levels, exact = np.empty(light.size), light.astype(np.float64)
    respond(curve, light, levels, room(levels))
    truth = np.log(exact + floor)
    if response == "lin_log":
        truth = np.where(exact > floor, np.log(np.maximum(exact, floor)), exact / floor - 1.0 + np.log(floor))
    assert np.abs(levels - truth).max() < 1e-13
    light_of(curve, levels, room(levels))
    assert (np.abs(levels - light) <= 1e-11 * (light + floor)).all()


@each_response
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


def test_the_logarithm_is_within_one_ulp_of_the_true_one():
    rng = np.random.default_rng(0)
    single = np.concatenate(
        (np.geomspace(1e-45, MAX_LUMINANCE, 500), rng.random(200), [1e-45, 1.0, MAX_LUMINANCE])
    )
    near_one = 1.0 + np.concatenate((np.geomspace(1e-16, 0.3, 150), -np.geomspace(1e-16, 0.3, 150)))
    values = np.concatenate([single.astype(np.float32) + floor for floor in (1e-9, 1e-3, 1.0)] + [near_one])
    values = values.astype(np.float64)
    logs = values.copy()
    natural_logarithm(logs, room(logs))
    with mpmath.workdps(40):
        for ours, value in zip(logs, values, strict=True):
            truth = mpmath.log(mpmath.mpf(value))
            assert abs(mpmath.mpf(ours) - truth) < np.spacing(abs(float(truth)) or 1e-300)


def test_the_exponential_is_exact_enough_for_the_quiet_band():
    values = np.linspace(-110.0, 110.0, 701)
    results = values.copy()
    exponential(results, room(results))
    with mpmath.workdps(40):
        errors = [
            abs(mpmath.mpf(r) / mpmath.exp(mpmath.mpf(v)) - 1) for r, v in zip(results, values, strict=True)
        ]
    assert max(errors) < 1e-12
