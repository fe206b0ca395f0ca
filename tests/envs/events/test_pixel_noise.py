"""Noise that acts on the pixel, against closed forms and a simulation of its process in small steps."""

import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import ks_2samp, norm

from envs.config import CameraConfig, EnvConfig, FaultsConfig
from envs.corridor import CorridorEnv
from envs.events import EVENT, EventCamera, RealSensor
from envs.events.pixel_noise import PER_SIGMA, mean_rate, passage_times, return_times, threshold_in_sigmas
from envs.events.ramps import ColumnCamera

SECOND = 10**6


def sensor_of(eye, config, seed=0, **faults):
    return RealSensor(config, FaultsConfig(**faults), (eye.state, eye.pixels), np.random.default_rng(seed), 0)


def still(seconds, step_us, light=0.0, shape=(16, 16), camera=None, **faults):
    """Events of a sensor in front of a still picture."""
    config = CameraConfig(width=shape[1], height=shape[0], **(camera or {}))
    eye, picture = EventCamera(config), np.full(shape, light, np.float32)
    eye.reset(picture, 0)
    real, parts = sensor_of(eye, config, **faults), []
    for t in range(0, round(seconds * SECOND), step_us):
        parts.append(real.events(eye.step(picture, t + step_us), t, t + step_us))
        assert ((parts[-1]["t"] > t) & (parts[-1]["t"] <= t + step_us)).all()
    return np.concatenate(parts)


def by_pixel(events, width=16):
    """Times and polarities of each pixel that fired."""
    place = events["y"].astype(int) * width + events["x"]
    order = np.argsort(place, kind="stable")
    ends = np.flatnonzero(np.diff(place[order])) + 1
    return [(events["t"][part], events["p"][part]) for part in np.split(order, ends)]


def test_passage_and_return_times_are_those_of_siegert():
    for sigmas in (0.25, 2.5, 8.0):
        k = round(sigmas * PER_SIGMA)
        up = math.sqrt(2 * math.pi) * quad(lambda y: math.exp(y * y / 2) * norm.cdf(y), 0, sigmas)[0]
        back = math.sqrt(2 * math.pi) * quad(lambda y: math.exp(y * y / 2) * norm.cdf(-y), 0, sigmas)[0]
        assert passage_times()[k] == pytest.approx(up, rel=2e-4)
        assert return_times()[k] == pytest.approx(back, rel=2e-4)


def test_the_rate_is_that_of_the_process_simulated_in_small_steps():
    """An Ornstein-Uhlenbeck process and a level that moves with each event: 200 steps in a time constant."""
    rng, dt, sigmas, size, time = np.random.default_rng(0), 1 / 200, 2.5, 1500, 15.0
    keep, kick = math.exp(-dt), math.sqrt(1 - math.exp(-2 * dt))
    step = 0.5826 * math.sqrt(2 * dt)  # a walk in steps passes a level later than the process
    x, level = rng.standard_normal(size), -sigmas * rng.random(size)
    count = 0
    for k in range(round(time / dt)):
        x = keep * x + kick * rng.standard_normal(size)
        up, down = x - level >= sigmas - step, x - level <= -sigmas + step
        level += sigmas * (up.astype(float) - down)
        count += int((up | down).sum()) if k * dt >= 3.0 else 0
    assert count / size / (time - 3.0) == pytest.approx(mean_rate(sigmas), rel=0.05)
    assert threshold_in_sigmas(mean_rate(sigmas)) == pytest.approx(sigmas, abs=1e-6)


def test_shot_noise_has_its_rate_alternates_and_does_not_drift_whatever_the_step():
    gaps = []
    for step_us in (4000, 200_000):
        events = still(2, step_us, shape=(48, 48), camera={"cutoff_hz": 30.0}, shot_noise_hz=5.0)
        assert len(events) / 48**2 / 2 == pytest.approx(5.0, rel=0.1)  # pixels differ by where their level is
        pixels = by_pixel(events, 48)
        assert max(abs(int(p.astype(int).sum())) for _, p in pixels) <= 2
        changes = np.concatenate([p[1:] != p[:-1] for _, p in pixels])
        assert changes.mean() > 0.995
        gaps.append(np.concatenate([np.diff(t) for t, _ in pixels]))
    assert ks_2samp(*gaps).pvalue > 0.01


def test_waiting_goes_on_while_the_light_trembles():
    eye = EventCamera(64, 64, cutoff_hz=1e5)
    lights = [np.full((64, 64), value, np.float32) for value in (0.05, 0.05004)]
    counts = []
    for step_us in (200, 20_000):
        eye.reset(lights[0], 0)
        real, count = sensor_of(eye, eye.config, shot_noise_hz=50.0), 0
        for k in range(SECOND // 10 // step_us):
            t = k * step_us
            count += real.events(eye.step(lights[(k + 1) % 2], t + step_us), t, t + step_us).size
        counts.append(count / 4096 / 0.1)
    assert counts[0] == pytest.approx(counts[1], rel=0.05)
    assert counts[0] == pytest.approx(50.0 * (1 - 0.75 * 0.05), rel=0.2)


def test_shot_noise_falls_with_the_light_to_a_quarter():
    dark, grey, white, sun = (
        len(still(20, 4_000_000, light, shape=(64, 64), shot_noise_hz=1.0)) for light in (0.0, 0.5, 1.0, 40.0)
    )
    assert grey / dark == pytest.approx(0.625, rel=0.08)
    assert white / dark == pytest.approx(0.25, rel=0.1)
    assert sun == pytest.approx(white, rel=0.1)


@pytest.mark.parametrize(("step_us", "refractory_us"), [(4000, 20_000), (30_000, 300)])
def test_a_dead_time_holds_for_noise_and_on_is_as_likely_as_off_then(step_us, refractory_us):
    camera = {"refractory_us": refractory_us, "cutoff_hz": 100.0}
    noise = {"shape": (32, 32), "camera": camera, "shot_noise_hz": 20.0}
    events = still(0.5, step_us, leak_hz=2.0, leak_jitter=0.1, **noise)
    assert min(int(np.diff(t).min()) for t, _ in by_pixel(events, 32) if t.size > 1) >= refractory_us
    assert len(events) > 1024 * 0.5 * 5
    alone = still(2, step_us, **noise)
    alone = alone[alone["t"] > SECOND]  # all levels begin below the light
    assert abs(alone["p"].mean()) < 4 / math.sqrt(len(alone))


def test_a_dead_time_holds_between_noise_and_light():
    config = EnvConfig(
        camera=CameraConfig(width=24, height=24, refractory_us=4000),
        faults=FaultsConfig(shot_noise_hz=50.0, leak_hz=5.0),
        window_capacity=None,
    )
    env, parts = CorridorEnv(config), []
    env.reset(seed=1)
    for _ in range(20):
        env.step(0)
        parts.append(env.events)
    events = np.concatenate(parts)
    assert min(int(np.diff(t).min()) for t, _ in by_pixel(events, 24) if t.size > 1) >= 4000


@pytest.mark.parametrize("step_us", [5000, 4_000_000])
def test_leakage_is_regular_and_does_not_depend_on_the_step(step_us):
    events = still(4, step_us, leak_hz=7.0)
    assert (events["p"] == 1).all()
    assert len(events) == pytest.approx(256 * 28, abs=256)
    gaps = np.concatenate([np.diff(t) for t, _ in by_pixel(events)])
    assert np.abs(gaps - SECOND / 7).max() <= 3


def test_leakage_jitters_and_spreads_as_asked():
    events = still(40, 40_000_000, shape=(32, 32), leak_hz=3.0, leak_jitter=0.1, noise_spread=0.1)
    pixels = by_pixel(events, 32)
    means = np.array([np.diff(t).mean() for t, _ in pixels])
    shares = np.array([np.diff(t).std() / np.diff(t).mean() for t, _ in pixels])
    assert shares.mean() == pytest.approx(0.1, rel=0.05)
    assert np.log10(means).std() == pytest.approx(0.1, rel=0.1)
    assert np.median(means) == pytest.approx(SECOND / 3, rel=0.03)


def test_leakage_moves_the_levels_which_then_stand_anywhere_below_the_light():
    """So a step down by 1.5 thresholds fires once in half of the pixels, and by half a threshold nowhere."""
    eye, picture = EventCamera(64, 64), np.ones((64, 64), np.float32)
    eye.reset(picture, 0)
    real = sensor_of(eye, eye.config, leak_hz=1.0, leak_jitter=0.1)
    for t in range(0, 2 * SECOND, 20_000):
        real.events(eye.step(picture, t + 20_000), t, t + 20_000)
    assert len(eye.step(picture * np.float32(math.exp(-0.1)), 2 * SECOND + 1)) == 0
    assert len(eye.step(picture * np.float32(math.exp(-0.3)), 2 * SECOND + 2)) == pytest.approx(2048, abs=128)


def test_noise_of_a_camera_that_is_looked_through_by_columns_falls_on_its_own_pixels():
    config = CameraConfig(width=32, height=16)
    eye, picture = ColumnCamera(config), np.zeros((16, 32), np.float32)
    picture[:, 8:] = 1.0
    eye.reset(picture)
    real, begins = sensor_of(eye, config, shot_noise_hz=20.0, sparsity=0.25), range(0, 20 * SECOND, SECOND)
    events = np.concatenate([real.events(np.empty(0, EVENT), t, t + SECOND) for t in begins])
    counts = np.zeros((16, 32))
    np.add.at(counts, (events["y"], events["x"]), 1)
    assert (counts[real._pixels.dead] == 0).all()
    dark, white = (counts[:, part][~real._pixels.dead[:, part]].mean() for part in (slice(8), slice(8, 32)))
    assert white / dark == pytest.approx(0.25, rel=0.4)


def test_the_same_seed_gives_the_same_bytes_in_the_environment_and_off_is_nothing():
    def played(seed, **faults):
        camera = CameraConfig(width=16, height=16)
        env = CorridorEnv(EnvConfig(camera=camera, faults=FaultsConfig(**faults), window_capacity=None))
        env.reset(seed=seed)
        return b"".join((env.step(k % 3), env.events.tobytes())[1] for k in range(20)), env

    noise = {"shot_noise_hz": 20.0, "leak_hz": 5.0, "leak_jitter": 0.1, "noise_spread": 0.1}
    first, again, other = (played(seed, **noise)[0] for seed in (1, 1, 2))
    assert first == again != other
    plain, env = played(1)
    assert not env._sensor.has_faults
    assert plain == played(1, leak_jitter=0.5, noise_spread=0.5)[0]


def test_noise_that_slow_pixels_cannot_make_is_refused_with_the_remedy():
    with pytest.raises(ValueError, match=r"raise camera\.cutoff_hz"):
        still(0.01, 1000, camera={"cutoff_hz": 5.0}, shot_noise_hz=1000.0)
