import numpy as np
import pytest
import torch
from torch.nn import functional

from models.policy.winograd import INPUT, gather, kernel_rule, output_rule, spread

RNG = np.random.default_rng(0)


def at_points(rule, image, step):
    """`spread` by the definition, in double precision."""
    size = rule.shape[1]
    down, across = ((side - size) // step + 1 for side in image.shape[:2])
    tiles = [
        image[step * y : step * y + size, step * x : step * x + size]
        for y in range(down)
        for x in range(across)
    ]
    return np.einsum("ia,jb,tabl->ijtl", rule, rule, tiles).reshape(16, len(tiles), -1)


@pytest.mark.parametrize("reach", [2, 3])
@pytest.mark.parametrize("tiles", [(1, 1), (2, 3)])
def test_products_at_points_are_a_convolution(reach, tiles):
    step, (inputs, outputs, count) = 5 - reach, (5, 7, 3)
    sides = [step * tile for tile in tiles]
    image = RNG.normal(size=(sides[0] + reach - 1, sides[1] + reach - 1, count, inputs)).astype("f4")
    kernel = RNG.normal(size=(reach, reach, inputs, outputs)).astype("f4")
    scratch, many = np.empty(4 * 20 * 20), tiles[0] * tiles[1]
    points, weights = np.empty((16, many, count * inputs), "f4"), np.empty((16, 1, inputs * outputs), "f4")
    scratch = np.empty(4 * image.size, "f4")
    spread(INPUT, image.reshape(*image.shape[:2], -1), points, step, scratch)
    spread(kernel_rule(reach), kernel.reshape(reach, reach, -1), weights, 1, scratch)
    sums = points.reshape(16, -1, inputs) @ weights.reshape(16, inputs, outputs)
    found = np.full((*sides, count * outputs), np.nan, "f4")
    gather(output_rule(reach), sums.reshape(16, many, -1), found, step, scratch)
    expected = functional.conv2d(
        torch.from_numpy(image).double().permute(2, 3, 0, 1),
        torch.from_numpy(kernel).double().permute(3, 2, 0, 1),
    )
    expected = expected.permute(2, 3, 0, 1).numpy()
    error = np.abs(found.reshape(*sides, count, outputs) - expected).max()
    assert error < 1e-6 * np.abs(expected).max()


@pytest.mark.parametrize("step", [1, 2, 3])
@pytest.mark.parametrize(
    "rule", [INPUT, kernel_rule(2), kernel_rule(3), *(np.ascontiguousarray(output_rule(k).T) for k in (2, 3))]
)
def test_gathering_is_the_transpose_of_spreading(rule, step):
    size = rule.shape[1]
    image = RNG.normal(size=(size + 2 * step, size + step, 6)).astype("f4")
    points, back = np.empty((16, 6, 6), "f4"), np.empty_like(image)
    scratch, other = np.empty(4 * image.size, "f4"), RNG.normal(size=points.shape).astype("f4")
    spread(rule, image, points, step, scratch)
    np.testing.assert_allclose(points, at_points(rule, image.astype(float), step), atol=1e-5)
    gather(np.ascontiguousarray(rule.T), other, back, step, scratch)
    assert float(np.vdot(points, other)) == pytest.approx(float(np.vdot(image, back)), rel=1e-4)
