"""Convolutions with 4/9 of the multiplications that their definition takes (Lavin and Gray 2016).

A polynomial of degree 3 is known from its values at 0, 1, -1 and infinity, and those of a product are
products of values. So a tile of `step` x `step` outputs of a kernel of `reach` x `reach` pixels, where
`step + reach` is 5, takes 4 x 4 products instead of (step reach)^2, which is 36:

    outputs = O [(K kernel K') * (I tile I')] O'

with I = INPUT (4, 4), K = `kernel_rule(reach)` and O = `output_rule(reach)`, and gradients go back by
the transposed matrices. All entries are 0, 1, -1 or a half, so that rounding grows little: an error is
at most 1e-6 of the largest output. A kernel with a stride s of s reach x s reach pixels is one of
reach x reach over blocks of s x s pixels as channels. Images lie as (height, width, lanes), where a
lane is one channel of one picture; values at points as (16, tiles, lanes).
"""

import numba
import numpy as np

compiled = numba.njit(cache=True, error_model="numpy", nogil=True, fastmath={"contract"})
POINTS = 4  # along each side of a tile
INPUT = np.array([[1, 0, -1, 0], [0, 1, 1, 0], [0, -1, 1, 0], [0, 1, 0, -1]], np.float32)
_AT_POINTS = np.array([[1, 0, 0], [1, 1, 1], [1, -1, 1]])  # powers 0, 1 and 2 of 0, 1 and -1


def kernel_rule(reach: int) -> np.ndarray:
    """The kernel as a polynomial at the four points, float32 (4, reach); halved at 1 and -1."""
    highest = np.eye(reach)[-1:]
    return np.concatenate([_AT_POINTS[:, :reach] * [[1.0], [0.5], [0.5]], highest]).astype(np.float32)


def output_rule(reach: int) -> np.ndarray:
    """From the points to a row of outputs, float32 (5 - reach, 4)."""
    step = POINTS + 1 - reach
    highest = -np.eye(step)[-1:]
    return np.concatenate([_AT_POINTS[:, :step], highest]).T.astype(np.float32)


@compiled
def spread(rule, image, points, step, scratch):  # type: ignore[no-untyped-def]
    """Fill the points of all tiles, which begin every `step` pixels: rule tile rule'.

    Args:
        rule: float32 (4, pixels of a tile each way), at most three entries of a row not 0.
        image: float32 (height, width, lanes).
        points: float32 (16, tiles, lanes), for the result.
        step: Pixels.
        scratch: float32, at least 4 width lanes.
    """
    columns, factors = _terms(rule)
    height, width, lanes = image.shape
    across = (width - rule.shape[1]) // step + 1
    rows = image.reshape((height, width * lanes))
    strips = scratch[: POINTS * width * lanes].reshape((POINTS, width * lanes))
    pixels = scratch[: POINTS * width * lanes].reshape((POINTS, width, lanes))
    for y in range((height - rule.shape[1]) // step + 1):
        for i in range(POINTS):
            a = columns[i] + y * step
            _set(strips[i], rows[a[0]], rows[a[1]], rows[a[2]], factors[i])
        for x in range(across):
            for i in range(POINTS):
                for j in range(POINTS):
                    b = columns[j] + x * step
                    to = points[POINTS * i + j, y * across + x]
                    _set(to, pixels[i, b[0]], pixels[i, b[1]], pixels[i, b[2]], factors[j])


@compiled
def gather(rule, points, image, step, scratch):  # type: ignore[no-untyped-def]
    """Add up what the points of all tiles say about an image: rule points rule', at every `step` pixels.

    Args:
        rule: float32 (pixels of a tile each way, 4), at most three entries of a row not 0.
        points: float32 (16, tiles, lanes).
        image: float32 (height, width, lanes), for the result.
        step: Pixels.
        scratch: float32, at least 4 width lanes.
    """
    columns, factors = _terms(rule)
    height, width, lanes = image.shape
    down, across = (height - len(rule)) // step + 1, (width - len(rule)) // step + 1
    planes = points.reshape((POINTS * POINTS, down, across * lanes))
    strips = scratch[: POINTS * across * lanes].reshape((POINTS, across * lanes))
    pixels = scratch[: POINTS * across * lanes].reshape((POINTS, across, lanes))
    image[:] = 0.0
    for y in range(down):
        for a in range(len(rule)):
            for j in range(POINTS):
                i = POINTS * columns[a] + j
                _set(strips[j], planes[i[0], y], planes[i[1], y], planes[i[2], y], factors[a])
            for x in range(across):
                for b in range(len(rule)):
                    j0, j1, j2 = columns[b]
                    to = image[y * step + a, x * step + b]
                    _add(to, pixels[j0, x], pixels[j1, x], pixels[j2, x], factors[b])


@compiled
def _terms(rule):  # type: ignore[no-untyped-def]
    """Of each row, the columns and the values of three entries, among them all that are not 0."""
    columns, factors = np.zeros((len(rule), 3), np.int64), np.zeros((len(rule), 3), np.float32)
    for i in range(len(rule)):
        found = 0
        for j in range(rule.shape[1]):
            if rule[i, j] != 0.0:
                columns[i, found], factors[i, found] = j, rule[i, j]
                found += 1
    return columns, factors


@compiled
def _set(to, one, two, three, factors):  # type: ignore[no-untyped-def]
    f1, f2, f3 = factors[0], factors[1], factors[2]
    for k in range(len(to)):
        to[k] = f1 * one[k] + f2 * two[k] + f3 * three[k]


@compiled
def _add(to, one, two, three, factors):  # type: ignore[no-untyped-def]
    f1, f2, f3 = factors[0], factors[1], factors[2]
    for k in range(len(to)):
        to[k] += f1 * one[k] + f2 * two[k] + f3 * three[k]
