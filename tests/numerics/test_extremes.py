"""Numbers at the ends of their ranges: each extreme with its defined result and the worst error found.

`python -m tests.numerics.page` runs these tests and writes docs/numerics.md from the recorded properties.
"""

import copy
import math
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
import pytest
import torch

from envs.config import CameraConfig, EnvConfig, FaultsConfig, FidelityConfig
from envs.corridor import CorridorEnv
from envs.event_error import measure_event_error
from envs.events import EVENT, EventCamera, apply_faults, draw_pixel_faults
from envs.events.photoreceptor import MAX_LUMINANCE
from envs.kinematics import clock_us, planned_position
from envs.raycast import RaycastRenderer
from envs.scene import make_scene
from jobs.analysis.statistics import crossed_difference, rate_estimate
from models.encoder.evae import EventVAE
from models.encoder.event_batch import batch_windows
from models.encoder.table import EncoderTable
from models.kinds import DenseModel, PolicySpec
from models.policy.memory import remember
from tests.support.point_samples import sample_luminance

MAX_T_US = 2**51  # of an episode [us], 71 years
FLOOR = 1e-3  # the camera's default luminance floor
EXTREMES: list[Any] = []


def extreme(part: str, what: str, result: str, unit: str, bound: float, slow: bool = False) -> Callable:
    """Decorate a function that returns the worst error of an extreme.

    Args:
        part: Part of the platform.
        what: The extreme input.
        result: The defined result.
        unit: Unit of the error.
        bound: Largest accepted error. An extreme that is only right or wrong counts what is wrong.
        slow: Whether the measurement belongs to the system tests.
    """

    def add(worst: Callable[[], float]) -> Callable[[], float]:
        row = {"part": part, "what": what, "result": result, "unit": unit, "bound": bound}
        marks = pytest.mark.system if slow else ()
        EXTREMES.append(pytest.param(row, worst, id=f"{part}: {what}", marks=marks))
        return worst

    return add


def events_between(before: float, after: float, dt_us: int = 1000, **fields: Any) -> tuple[np.ndarray, int]:
    """Events of a pixel between two uniform frames, and how many were dropped."""
    camera = EventCamera(1, 1, **{"max_events_per_pixel": 100_000, **fields})
    camera.reset(np.full((1, 1), before, np.float32), 0)
    return camera.step(np.full((1, 1), after, np.float32), dt_us), camera.dropped


def refused(values: Iterable[float], use: Callable[[float], object]) -> float:
    """The number of values that are not refused by a ValueError."""
    accepted = 0
    for value in values:
        try:
            use(value)
        except ValueError:
            continue
        accepted += 1
    return float(accepted)


def windows() -> Iterator[tuple[np.ndarray, int]]:
    """Windows of no event, of one, of an event 1,000 times, and of 100,000; events and length [us]."""
    rng = np.random.default_rng(0)
    for count, window_us in ((0, 5_000), (1, 1), (1_000, 5_000), (100_000, 10**6)):
        events = np.zeros(count, EVENT)
        events["t"] = np.sort(rng.integers(1, window_us + 1, count))
        events["x"], events["y"] = (rng.integers(0, 64, count) for _ in range(2))
        events["p"] = rng.choice([-1, 1], count)
        if count == 1_000:
            events[:] = events[0]
        yield events, window_us


@extreme("camera", "a step of k thresholds, 0.001 to 10, k to 100", "k events", "events", 0)
def thresholds() -> float:
    """Counts of a step of k thresholds, up and down, for thresholds of the whole range."""
    wrong = 0
    for threshold in (1e-3, 0.05, 0.2, 0.7, 10.0):
        fields: dict[str, Any] = {"contrast_threshold": threshold, "luminance_floor": 1e-9}
        for k in range(1, min(100, int(80 / threshold)) + 1):
            up, _ = events_between(1.0, float(np.exp(k * threshold)), **fields)
            wrong = max(wrong, abs(len(up) - k))
    return float(wrong)


@extreme(
    "camera", "black to 1e-45 .. 3.4e38 and back", "the whole part of log ratio / threshold", "events", 0
)
def greys() -> float:
    """Counts between black and greys up to the largest float32, against the logarithm in float64."""
    wrong = 0
    for light in (1e-45, 1e-38, 1e-9, 1e-3, 1.0, 100.0, 1e30, float(MAX_LUMINANCE)):
        for before, after in ((0.0, light), (light, 0.0)):
            exact = np.log(np.float64(np.float32(light)) + FLOOR) - np.log(FLOOR)
            found, _ = events_between(before, after, contrast_threshold=0.2)
            distance = abs(exact / 0.2 - round(exact / 0.2))
            if distance > 1e-6:  # else it is the rounding of the light itself that decides
                wrong = max(wrong, abs(len(found) - int(exact / 0.2)))
    return float(wrong)


@extreme("camera", "20,000 steps up and down", "as many ON as OFF events", "events", 0)
def drift() -> float:
    """Events too many or too few after a million steps up and down."""
    camera = EventCamera(1, 1, contrast_threshold=0.2)
    low, high = (np.full((1, 1), value, np.float32) for value in (0.1, 0.9))
    camera.reset(low, 0)
    counts = [0, 0]
    for step in range(20_000):
        events = camera.step(high if step % 2 == 0 else low, 10 * (step + 1))
        counts[step % 2] += int(events["p"].sum())
    return float(abs(counts[0] + counts[1]))


@extreme("camera", "ramps of 0.1 ms to 1 s", "events at the crossings, in whole microseconds", "us", 1.0)
def event_times() -> float:
    """Time of events on a ramp of the logarithm against the exact crossing, rounded up [us]."""
    worst = 0.0
    for threshold in (0.01, 0.1, 0.5):
        for dt_us in (100, 10_000, 1_000_000):
            start, end = 0.1, 0.9
            found, _ = events_between(start, end, dt_us, contrast_threshold=threshold)
            span = np.log(np.float32(end) + FLOOR) - np.log(np.float32(start) + FLOOR)
            exact = dt_us * threshold * np.arange(1, len(found) + 1) / span
            worst = max(worst, float(np.abs(found["t"] - exact).max()))
    return worst


@extreme("camera", "caps of 1 to 1,000 events a pixel", "what is over the cap is counted", "events", 0)
def kept_or_counted() -> float:
    """Events that are neither there nor counted as dropped, at caps of 1 to 1,000 a pixel."""
    whole, _ = events_between(1e-3, 2.0, contrast_threshold=1e-3)
    lost = 0
    for cap in (1, 10, 1000):
        found, dropped = events_between(1e-3, 2.0, contrast_threshold=1e-3, max_events_per_pixel=cap)
        lost = max(lost, abs(len(whole) - len(found) - dropped))
    return float(lost)


@extreme("camera", "NaN, infinite or negative light", "refused, the pixel named", "values accepted", 0)
def bad_light() -> float:
    """Frames that are no light and yet accepted."""
    camera = EventCamera(3, 2)
    camera.reset(np.ones((2, 3), np.float32), 0)

    def see(value: float) -> None:
        light = np.ones((2, 3), np.float32)
        light[1, 2] = value
        camera.step(light, 1000)

    return refused((np.nan, np.inf, -np.inf, -1.0, -1e-45), see)


@extreme(
    "faults",
    "more than 16 million false events a step, rates that are no number",
    "refused",
    "values accepted",
    0,
)
def too_many_faults() -> float:
    """Rates of false events beyond memory that are accepted."""
    none, rng = np.zeros(0, EVENT), np.random.default_rng(0)

    def add(rate: float) -> None:
        faults = FaultsConfig(background_activity_hz=rate)
        pixels = draw_pixel_faults((64, 64), faults, rng)
        apply_faults(none, 0, 10**7, faults, pixels, rng)

    return refused((1e4, 1e5, 1e6, 1e7, np.nan, np.inf, -1.0), add)


@extreme(
    "renderer",
    "poses in, on, over and far from poles, along the axes",
    "finite light within the surfaces'",
    "of white",
    1e-06,
    slow=True,
)
def light_of_poses() -> float:
    """Light of renders that is not finite, or outside what the scene's surfaces can show [1 is white]."""
    rng, worst = np.random.default_rng(0), 0.0
    scene = make_scene("poles", rng)
    albedos = np.array([scene.ground_albedo, scene.wall_albedo, *scene.obstacles["albedo"]])
    least = min(albedos.min() * scene.ambient, scene.sky_luminance)
    most = max(albedos.max(), scene.sky_luminance)
    renderer = RaycastRenderer(scene, 33, 21)
    for pole in rng.choice(scene.obstacles, 200):
        reach = pole["rx"] * rng.choice([0.0, 0.5, 1.0, 1.0 + 1e-9, 3.0])
        place = pole["x"] + reach, pole["y"], rng.choice([0.0, 1e-9, 2.0, 8.0 + 1e-9, 1e4])
        light = renderer.render(*place, rng.choice([0.0, np.pi, -np.pi / 2, 0.3])).astype(np.float64)
        if not np.isfinite(light).all():
            return float("inf")
        worst = max(worst, least - light.min(), light.max() - most)
    return float(worst)


@extreme("renderer", "edges of poles", "the mean light over each pixel", "of white, mean", 0.001, slow=True)
def coverage_of_pixels() -> float:
    """Light of pixels against 96 x 96 point samples each, the mean over a picture [1 is white]."""
    scene = make_scene("poles", np.random.default_rng(3))
    worst = 0.0
    for pose in ((0.0, 0.0, 2.0, 0.0), (5.0, 20.0, 2.0, 0.4), (0.0, 50.0, 12.0, 0.2)):
        exact = sample_luminance(scene, pose, 16, 16, samples=96)
        found = RaycastRenderer(scene, 16, 16, samples=8).render(*pose)
        worst = max(worst, float(np.abs(found - exact).mean()))
    return worst


@extreme(
    "simulator",
    "seven settings of world, rate (45 to 800 Hz) and tolerance (0.5 to 20 %)",
    "an event error within the tolerance",
    "of the tolerance",
    1.0,
    slow=True,
)
def error_over_tolerance() -> float:
    """Event error achieved, as a share of the one that was asked, over scenes, rates and tolerances."""
    worst = 0.0
    for scene, rate, tolerance in (
        ("poles", 45.0, 0.05), ("poles", 800.0, 0.05), ("poles", 200.0, 0.005), ("gates", 200.0, 0.05),
        ("texture_change", 200.0, 0.2), ("shape_change", 200.0, 0.1), ("poles_dense", 200.0, 0.05),
    ):  # fmt: skip
        config = EnvConfig(scene=scene, control_hz=rate, fidelity=FidelityConfig(tolerance=tolerance))
        worst = max(worst, measure_event_error(config, flights=2, steps=6).error / tolerance)
    return worst


@extreme(
    "encoder",
    "windows of 0, 1, 1,000 equal and 100,000 events, of 1 us to 1 s",
    "the network's latent",
    "of the latent",
    1e-05,
    slow=True,
)
def latents() -> float:
    """Latents of the table in float32 against the network in float64, in units of the latent."""
    torch.manual_seed(0)
    evae = EventVAE(context=128).freeze()
    table, exact = EncoderTable.from_evae(evae), copy.deepcopy(evae).double()
    worst = 0.0
    for events, window_us in windows():
        found = table.encode(events, 0, window_us)
        if not np.isfinite(found).all():
            return float("inf")
        context = exact.ecn.plain(batch_windows([(events, 0, window_us)], exact.grid))
        true = exact.encoder(context).chunk(2, dim=-1)[0][0].detach().numpy()
        worst = max(worst, float(np.abs(found - true).max()))
    return worst


@extreme("encoder", "the same windows in any order", "the same bits", "latents", 0, slow=True)
def order_of_events() -> float:
    """Latents that another order of the same events changes by any bit."""
    torch.manual_seed(0)
    table, rng = EncoderTable.from_evae(EventVAE(context=64).freeze()), np.random.default_rng(1)
    changed = 0
    for events, window_us in windows():
        other = table.encode(rng.permutation(events), 0, window_us)
        changed += other.tobytes() != table.encode(events, 0, window_us).tobytes()
    return float(changed)


@extreme(
    "policy",
    "steps of 1 us to 11 days, memories of 1 ms to 17 minutes",
    "means within what was seen",
    "of a feature",
    0,
)
def memories() -> float:
    """Decaying means outside what was seen, for short and long steps and time constants."""
    spec = PolicySpec(DenseModel(name="event_columns", stack=1, hidden=[4], memory_ms=[1.0, 1e6]), 1, 1)
    rng, worst = np.random.default_rng(0), 0.0
    for window_us in (1, 5_000, 10**12):
        kept = np.zeros((1, 3, 2), np.float32)
        for step in range(300):
            kept = remember(
                kept, rng.random((1, 2), np.float32), np.array([step == 0]), spec, window_us, np.zeros(1, int)
            )
            worst = max(worst, float(-kept.min()), float(kept.max() - 1.0))
    return worst


@extreme(
    "clock", "up to 10^9 steps at 0.1 Hz to 1 MHz, at most 71 years", "the exact time, rounded", "us", 0.5
)
def clocks() -> float:
    """Time of a control step against the exact quotient, after up to 10**12 steps [us]."""
    steps = (1, 3, 1000, 10**6, 10**9)
    rates = (0.1, 45.0, 200.0, 12_345.6, 1e6)
    exact = [(step, rate, step * 1e6 / np.longdouble(rate)) for step in steps for rate in rates]
    within = [(step, rate, time) for step, rate, time in exact if time < MAX_T_US]
    return max(float(abs(clock_us(step, rate) - time)) for step, rate, time in within)


@extreme("vehicle", "a million steps", "the exact place: counts times step", "m", 1e-09)
def positions() -> float:
    """Place after a million steps against the exact one [m]."""
    errors = []
    for forward, left, right in ((10**6, 0, 0), (0, 10**6, 0), (333_333, 333_333, 333_334)):
        x, y = planned_position(0.0, (forward, left, right), (20.0, 200.0))
        half = np.sqrt(np.longdouble(0.5))
        errors += [abs(x - (right - left) * half / 10), abs(y - (forward + (left + right) * half) / 10)]
    return float(max(errors))


@extreme(
    "corridor",
    "0.1 Hz to 1 MHz, 1e-6 to 1e6 m/s, thresholds 1e-6 to 10, 1 x 1 pixel, all pixels dead",
    "finite observations and rewards",
    "steps",
    0,
    slow=True,
)
def corridors() -> float:
    """Steps at extreme rates, speeds, thresholds and sensors in which a number is not finite."""
    tiny, bad = CameraConfig(8, 8), 0
    configs = [
        *(EnvConfig(control_hz=rate, camera=tiny, time_limit_s=1e3) for rate in (0.1, 45.0, 1e6)),
        *(EnvConfig(speed_mps=speed, camera=tiny) for speed in (1e-6, 1e3, 1e6)),
        *(EnvConfig(camera=CameraConfig(8, 8, contrast_threshold=c)) for c in (1e-6, 10.0)),
        *(EnvConfig(camera=CameraConfig(*size)) for size in ((1, 1), (1, 9), (9, 1))),
        EnvConfig(camera=tiny, faults=FaultsConfig(sparsity=1.0)),
        EnvConfig(camera=tiny, faults=FaultsConfig(background_activity=100.0, event_dropout=0.5)),
    ]
    for config in configs:
        env = CorridorEnv(config)
        env.reset(seed=0)
        for action in range(3):
            window, reward, ended, _, info = env.step(action)
            numbers = (reward, info["x_m"], info["y_m"], float(window[0, 2]))
            bad += not np.isfinite(numbers).all()
            if ended:
                break
    return float(bad)


@extreme("statistics", "0 % and 100 %, 1 to 10,000 episodes", "intervals within 0 and 1", "intervals", 0)
def rates_of_all() -> float:
    """Ends of intervals of rates outside 0..1 or not finite, from one episode to ten thousand."""
    bad = 0
    for trainings, corridors_ in ((1, 1), (1, 100), (3, 1), (3, 14), (10, 1000)):
        for value in (0.0, 1.0):
            same = np.full((trainings, corridors_), value)
            interval = rate_estimate(same).interval or (np.nan,)
            bad += not all(0.0 <= end <= 1.0 for end in interval)
            bad += crossed_difference(same, same, (0.0, 1.0)).value != 0.0
    return float(bad)


@pytest.mark.parametrize(("row", "worst"), EXTREMES)
def test_the_worst_error_is_within_the_accepted_bound(row, worst, record_property):
    error = worst()
    for name, value in {**row, "error": error}.items():
        record_property(name, value)
    assert not math.isnan(error)
    assert 0 <= error <= row["bound"]
