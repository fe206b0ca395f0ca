import math

import numpy as np
import pytest

from envs.scene import Texture
from envs.scene.textures import TILE, TILE_PERIODS, around, noise_tile, noise_waves
from tests.support.point_samples import pattern_points


def test_the_noise_has_only_waves_of_one_to_two_periods_all_equally_strong():
    tile = noise_tile(7)
    assert tile.shape == (TILE, TILE)
    assert tile.dtype == np.float32
    assert np.abs(tile).max() == 1.0
    power = np.abs(np.fft.fft2(tile.astype(np.float64)))
    b, a = np.meshgrid(*[np.fft.fftfreq(TILE, 1 / TILE)] * 2, indexing="ij")
    inside = (np.hypot(a, b) >= TILE_PERIODS / 2) & (np.hypot(a, b) <= TILE_PERIODS)
    assert power[~inside].max() < 1e-4 * power.max()
    assert power[inside].min() > 0.999 * power.max()


def test_the_noise_depends_on_its_seed_alone_and_cannot_be_written_to():
    assert np.array_equal(noise_tile(3), noise_tile.__wrapped__(3))
    assert not np.array_equal(noise_tile(3), noise_tile(4))
    with pytest.raises(ValueError, match="read-only"):
        noise_tile(3)[0, 0] = 0.0


def test_points_of_the_noise_are_the_sum_of_its_waves_to_a_thousandth():
    s, q = np.random.default_rng(3).uniform(-50.0, 50.0, (2, 500))
    cycles, amplitudes = noise_waves(5)
    turns = np.exp(
        2j * math.pi / (2.0 * TILE_PERIODS) * (np.outer(s, cycles[:, 0]) + np.outer(q, cycles[:, 1]))
    )
    np.testing.assert_allclose(
        pattern_points(Texture("noise", 2.0, 1.0, seed=5), s, q), (turns @ amplitudes).real, atol=1.5e-3
    )


@pytest.mark.parametrize("name", ["checker", "noise"])
def test_a_whole_number_of_periods_goes_around(name):
    for radius in (1e-3, 0.3, 0.5, 2.0):
        texture = Texture(name, 0.5, 0.5)
        repeat = 0.5 * (TILE_PERIODS if name == "noise" else 1)
        turns = 2.0 * math.pi * around(texture, radius) / repeat
        assert turns == pytest.approx(round(turns))
        assert abs(turns - max(1.0, 2.0 * math.pi * radius / repeat)) <= 0.5


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("pattern", "dots"),
        ("period_m", 0.0),
        ("contrast", math.nan),
        ("velocity_mps", (0.0, math.inf)),
        ("velocity_mps", (1.0,)),
        ("seed", -1),
        ("seed", 0.5),
    ],
)
def test_a_value_that_cannot_be_is_refused_by_name(field, value):
    with pytest.raises(ValueError, match=field):
        Texture(**{"pattern": "noise", field: value})
