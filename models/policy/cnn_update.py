"""PPO's gradient steps for a policy of convolutions (`models.policy.networks.nature_cnn`), compiled.

Torch's convolutions already run at the processor's bound, so these multiply less: the three
convolutions and their gradients take 4/9 of the multiplications (`models.policy.winograd`), and pictures
pass in groups whose activations stay in the processor's cache. A minibatch is cut into pieces whose
gradients are added in order, whatever number of threads takes them: the same bytes for any number. The
loss, the clipped gradient and Adam are those of `models.policy.dense_update`; sums run in
another order than in torch.
"""

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from models.policy.dense_update import Adam, Rows, Settings, add_losses, read_adam, step_adam, write_adam
from models.policy.winograd import INPUT, POINTS, compiled, gather, kernel_rule, output_rule, spread

PIECE = 64  # rows of a minibatch that a thread takes at once, at most
GROUP = 16  # pictures that pass the convolutions together
PLACES = POINTS * POINTS
F32 = np.float32
ZERO = F32(0.0)
OF_BYTE = F32(1.0 / 255.0)


class Layer(NamedTuple):
    """A convolution with a stride of 1 over blocks of pixels.

    Attributes:
        kernel_rule, output_rule: As in `models.policy.winograd`, float32 (4, reach) and (step, 4).
        weights: float32 (reach, reach, inputs, outputs).
        bias: float32 (outputs,).
        points: float32 (16, inputs, outputs), the weights at the points.
        adjoint: float32 (16, outputs, inputs), the same transposed.
        tiles: Down and across.
        block: Pixels of a block of the next layer's input, down and across.
        blocks: Of them, down and across.
    """

    kernel_rule: np.ndarray
    output_rule: np.ndarray
    weights: np.ndarray
    bias: np.ndarray
    points: np.ndarray
    adjoint: np.ndarray
    tiles: np.ndarray
    block: np.ndarray
    blocks: np.ndarray


class Dense(NamedTuple):
    """A layer (inputs, outputs) over the last convolution, and both heads over it, (actions + 1, outputs)."""

    weights: np.ndarray
    bias: np.ndarray
    heads: np.ndarray
    heads_bias: np.ndarray


class Kept(NamedTuple):
    """What a thread keeps of a convolution between its forward and its backward pass, and its gradient.

    Attributes:
        images: float32 (groups, values), its inputs, with zeros beyond their edges.
        points: float32 (groups, values), the same at the points.
        of_weights, of_bias, of_points: Gradients of a `Layer`'s.
    """

    images: np.ndarray
    points: np.ndarray
    of_weights: np.ndarray
    of_bias: np.ndarray
    of_points: np.ndarray


class Work(NamedTuple):
    """The arrays of one thread.

    Attributes:
        gradient: Of all parameters.
        kept: Of each convolution.
        of_dense: Gradients of the dense layers.
        flat: float32 (rows, values), the outputs of the last convolution.
        of_flat: Their gradient.
        image, points, slopes, scratch: float32, for results that are read at once.
        figures: float64 (5,), of the piece.
    """

    gradient: np.ndarray
    kept: tuple[Kept, ...]
    of_dense: Dense
    flat: np.ndarray
    of_flat: np.ndarray
    image: np.ndarray
    points: np.ndarray
    slopes: np.ndarray
    scratch: np.ndarray
    figures: np.ndarray


def update_cnn(
    networks: Sequence[nn.Module],
    optimizer: torch.optim.Adam,
    rows: Rows,
    orders: np.ndarray,
    settings: Settings,
    threads: int = 1,
) -> np.ndarray:
    """Take all gradient steps of an iteration; parameters and optimiser change in place.

    Args:
        networks: Trunk, policy and value, as `models.policy.networks.nature_cnn` builds them.
        optimizer: Of all their parameters.
        rows: What to learn from; stacks uint8 (N, depth, height, width).
        orders: int64 (epochs, N), the order of the rows in each epoch.
        settings: Of loss and optimiser.
        threads: That share the work; the result does not depend on them.

    Returns:
        As `models.policy.dense_update.update_dense`.

    Raises:
        RuntimeError: A gradient is not finite; the weights are those before it.
    """
    sides, (trunk, *_) = rows.stacks.shape[2:], networks
    parameters = _ordered(networks)
    adam, taken = read_adam(optimizer, parameters, lambda tensors: _as_here(tensors, trunk))
    net = _cut(adam.values, networks, sides)
    pieces = _pieces(min(settings.minibatch_size, len(rows.actions)))
    works = [_work(len(adam.values), networks, sides) for _ in range(min(threads, pieces))]
    blocks = rows._replace(stacks=_blocks(rows.stacks, trunk[1].stride[0]))
    figures, taken = _take_steps(net, works, adam, blocks, orders, settings, taken)
    write_adam(adam, taken, optimizer, parameters, lambda tensors: _as_here(tensors, trunk))
    if not math.isfinite(figures[-1]):
        raise RuntimeError(f"gradients must be finite, got a non-finite norm after {taken:.0f} steps")
    return figures


def _ordered(networks: Sequence[nn.Module]) -> list[Tensor]:
    """All parameters as they lie here: the weights of the heads side by side, then their biases."""
    trunk, *heads = networks
    return [*trunk.parameters(), *(one.weight for one in heads), *(one.bias for one in heads)]


def _as_here(tensors: Sequence[Tensor], trunk: nn.Module) -> list[Tensor]:
    """Views of tensors like the parameters, with the axes in the order in which they lie here."""
    views = list(tensors)
    layers = [layer for layer in trunk if isinstance(layer, nn.Conv2d | nn.Linear)]
    for k, layer in enumerate(layers):
        weight = tensors[2 * k]
        if isinstance(layer, nn.Conv2d):
            stride = layer.stride[0]
            cut = (layer.kernel_size[0] // stride, stride) * 2
            views[2 * k] = weight.view(*weight.shape[:2], *cut).permute(2, 4, 3, 5, 1, 0)
        else:
            views[2 * k] = weight.view(len(weight), layers[k - 1].out_channels, -1).permute(2, 1, 0)
    return views


def _blocks(stacks: np.ndarray, side: int) -> np.ndarray:
    """Pictures (N, depth, height, width) as blocks of `side` x `side` pixels: (N, down, across, channels)."""
    count, depth, height, width = stacks.shape
    down, across = height // side, width // side
    whole = stacks[:, :, : down * side, : across * side]
    cut = whole.reshape(count, depth, down, side, across, side).transpose(0, 2, 4, 3, 5, 1)
    return cut.reshape(count, down, across, -1)


def _cut(
    flat: np.ndarray, networks: Sequence[nn.Module], sides: Sequence[int]
) -> tuple[tuple[Layer, ...], Dense]:
    """The layers whose parameters, or their gradients, lie in an array; `sides` of a picture."""
    parameters = _ordered(networks)
    parts = np.split(flat, np.cumsum([value.numel() for value in parameters])[:-1])
    convolutions = [layer for layer in networks[0] if isinstance(layer, nn.Conv2d)]
    strides = [layer.stride[0] for layer in convolutions]
    blocks, layers = np.array(sides) // strides[0], []
    for k, layer in enumerate(convolutions):
        reach, inputs = layer.kernel_size[0] // strides[k], strides[k] ** 2 * layer.in_channels
        made, shape = blocks - reach + 1, (inputs, layer.out_channels)
        block = made if k + 1 == len(strides) else np.full(2, strides[k + 1])
        blocks = made // block
        rules = kernel_rule(reach), output_rule(reach)
        own = parts[2 * k].reshape(reach, reach, *shape), parts[2 * k + 1]
        points = np.empty((PLACES, *shape), F32), np.empty((PLACES, *shape[::-1]), F32)
        layers.append(Layer(*rules, *own, *points, -(-made // len(rules[1])), block, blocks))
    weights, bias, *heads = parts[2 * len(layers) :]
    wide, ends = len(bias), np.cumsum([0, *(part.size for part in heads)])
    both = flat[len(flat) - ends[-1] :]
    dense = weights.reshape(-1, wide), bias, both[: ends[2]].reshape(-1, wide), both[ends[2] :]
    return tuple(layers), Dense(*dense)


def _work(size: int, networks: Sequence[nn.Module], sides: Sequence[int]) -> Work:
    """The arrays of a thread, for a number of parameters and the sides of a picture."""
    gradient = np.empty(size, F32)
    of_layers, of_dense = _cut(gradient, networks, sides)
    groups, kept, most = -(-PIECE // GROUP), [], np.zeros(4, np.int64)
    for of in of_layers:
        inputs, outputs = of.points.shape[1:]
        made = of.tiles * len(of.output_rule)
        shown = GROUP * inputs * np.prod(made + of.kernel_rule.shape[1] - 1)
        places = GROUP * PLACES * np.prod(of.tiles)
        images, points = (np.empty((groups, values), F32) for values in (shown, places * inputs))
        kept.append(Kept(images, points, of.weights, of.bias, of.points))
        scratch = POINTS * max(inputs * outputs, shown)
        most = np.maximum(most, [GROUP * outputs * np.prod(made), places * outputs, shown, scratch])
    flat, of_flat = (np.empty((PIECE, len(of_dense.weights)), F32) for _ in range(2))
    image, points, slopes, scratch = (np.empty(values, F32) for values in most)
    buffers = flat, of_flat, image, points, slopes, scratch
    return Work(gradient, tuple(kept), of_dense, *buffers, np.zeros(5))


def _pieces(count: int) -> int:
    """How many pieces a minibatch of so many rows is cut into: two at least, for two threads."""
    return min(count, max(2, -(-count // PIECE)))


def _take_steps(
    net: tuple[tuple[Layer, ...], Dense],
    works: Sequence[Work],
    adam: Adam,
    rows: Rows,
    orders: np.ndarray,
    settings: Settings,
    taken: float,
) -> tuple[np.ndarray, float]:
    """Figures as `update_cnn` returns them, the norm NaN if one was not finite; and Adam's steps so far."""
    count, size, threads = orders.shape[1], settings.minibatch_size, len(works)
    shares = [Adam(*part) for part in zip(*(np.array_split(one, threads) for one in adam), strict=True)]
    with ThreadPoolExecutor(threads) as pool:
        for order in orders:
            figures = np.zeros(5)
            for begin in range(0, count, size):
                figures += _add_up(pool, net, works, adam, rows, order[begin : begin + size], settings)
                norm = math.sqrt(np.dot(adam.gradient, adam.gradient))
                if not math.isfinite(norm):
                    figures[4] = math.nan
                    return figures, taken
                figures[4] += norm
                taken += 1.0
                scale = min(1.0, settings.grad_clip / (norm + 1e-6))
                list(pool.map(step_adam, shares, *([one] * threads for one in (settings, scale, taken))))
    return figures / math.ceil(count / size), taken


def _add_up(
    pool: ThreadPoolExecutor,
    net: tuple[tuple[Layer, ...], Dense],
    works: Sequence[Work],
    adam: Adam,
    rows: Rows,
    picked: np.ndarray,
    settings: Settings,
) -> np.ndarray:
    """Fill the gradient of a minibatch; its figures without the norm."""

    def learn(work: Work, piece: np.ndarray) -> None:
        _learn(*net, work, rows, piece, settings, len(piece) / len(picked))

    _to_points(net[0], works[0].scratch)
    adam.gradient[:] = ZERO
    figures = np.zeros(5)
    pieces = np.array_split(picked, _pieces(len(picked)))
    for at in range(0, len(pieces), len(works)):
        done = works[: len(pieces) - at]
        list(pool.map(learn, done, pieces[at : at + len(works)]))
        for work in done:
            adam.gradient[:] += work.gradient
            figures += work.figures
    return figures


@compiled
def _to_points(layers, scratch):  # type: ignore[no-untyped-def]
    """Fill the weights at the points."""
    for layer in layers:
        reach, _, inputs, outputs = layer.weights.shape
        kernel = layer.weights.reshape((reach, reach, inputs * outputs))
        spread(layer.kernel_rule, kernel, layer.points.reshape((PLACES, 1, inputs * outputs)), 1, scratch)
        for p in range(PLACES):
            for k in range(inputs):
                for n in range(outputs):
                    layer.adjoint[p, n, k] = layer.points[p, k, n]


@compiled
def _learn(layers, dense, work, rows, picked, settings, share):  # type: ignore[no-untyped-def]
    """Fill the gradient and the figures of a piece that is this share of its minibatch."""
    count = len(picked)
    for begin in range(0, count, GROUP):
        _show(rows.stacks, picked[begin : begin + GROUP], work.kept[0].images[begin // GROUP], layers[0])
        for k in range(len(layers)):
            _forward(layers, work, k, begin, min(GROUP, count - begin))
    _learn_dense(dense, work, rows, picked, settings, share)
    for kept in work.kept:
        kept.of_points[:] = ZERO
        kept.of_bias[:] = ZERO
    for begin in range(0, count, GROUP):
        for k in range(len(layers) - 1, -1, -1):
            _backward(layers, work, k, begin, min(GROUP, count - begin))
    for k in range(len(layers)):
        of_points, of_weights = work.kept[k].of_points, work.kept[k].of_weights
        reach, _, inputs, outputs = of_weights.shape
        at_points, kernel = (PLACES, 1, inputs * outputs), (reach, reach, inputs * outputs)
        rule = np.ascontiguousarray(layers[k].kernel_rule.T)
        gather(rule, of_points.reshape(at_points), of_weights.reshape(kernel), 1, work.scratch)


@compiled
def _sides(layer):  # type: ignore[no-untyped-def]
    """Height and width of its inputs with all tiles, and of its outputs."""
    down, across = layer.tiles[0] * len(layer.output_rule), layer.tiles[1] * len(layer.output_rule)
    more = layer.kernel_rule.shape[1] - 1
    return down + more, across + more, down, across


@compiled
def _cube(flat, a, b, c):  # type: ignore[no-untyped-def]
    """The beginning of an array as one of three axes."""
    return flat[: a * b * c].reshape((a, b, c))


@compiled
def _read(layers, work, k, begin, count):  # type: ignore[no-untyped-def]
    """The images that layer k makes: float32 (down, across, rows, pixels of a block, outputs), in blocks."""
    pixels, outputs = layers[k].block[0] * layers[k].block[1], len(layers[k].bias)
    if k + 1 == len(layers):
        return work.flat[begin : begin + count].reshape((1, 1, count, pixels, outputs))
    height, width, _, _ = _sides(layers[k + 1])
    images = work.kept[k + 1].images[begin // GROUP]
    return images[: height * width * count * pixels * outputs].reshape(
        (height, width, count, pixels, outputs)
    )


@compiled
def _forward(layers, work, k, begin, count):  # type: ignore[no-untyped-def]
    """Layer k of a group of pictures."""
    layer, kept = layers[k], work.kept[k]
    step, tiles = len(layer.output_rule), layer.tiles[0] * layer.tiles[1]
    height, width, down, across = _sides(layer)
    _, inputs, outputs = layer.points.shape
    image = _cube(kept.images[begin // GROUP], height, width, count * inputs)
    points = _cube(kept.points[begin // GROUP], PLACES, tiles, count * inputs)
    spread(INPUT, image, points, step, work.scratch)
    sums = _cube(work.points, PLACES, tiles, count * outputs)
    _multiply(points, layer.points, sums)
    made = _cube(work.image, down, across, count * outputs)
    gather(layer.output_rule, sums, made, step, work.scratch)
    _rectify(made.reshape((down, across, count, outputs)), layer, _read(layers, work, k, begin, count))


@compiled
def _backward(layers, work, k, begin, count):  # type: ignore[no-untyped-def]
    """Add the gradient of layer k, given that of its outputs; fill that of its inputs but for the first."""
    layer, kept = layers[k], work.kept[k]
    step, tiles = len(layer.output_rule), layer.tiles[0] * layer.tiles[1]
    height, width, down, across = _sides(layer)
    _, inputs, outputs = layer.points.shape
    made = _cube(work.image, down, across, count * outputs)
    read = _read(layers, work, k, begin, count)
    slopes = work.of_flat[begin : begin + count].reshape(read.size) if k + 1 == len(layers) else work.slopes
    _rectify_back(
        slopes[: read.size].reshape(read.shape), read, layer, made.reshape((down, across, count, outputs))
    )
    of_sums = _cube(work.points, PLACES, tiles, count * outputs)
    spread(np.ascontiguousarray(layer.output_rule.T), made, of_sums, step, work.scratch)
    rows = of_sums.reshape((PLACES, tiles * count, outputs))
    for row in rows[POINTS + 1]:  # at 1 a polynomial is the sum of its coefficients
        for n in range(outputs):
            kept.of_bias[n] += row[n]
    points = _cube(kept.points[begin // GROUP], PLACES, tiles, count * inputs)
    product = work.scratch[: inputs * outputs].reshape((inputs, outputs))
    for p in range(PLACES):
        np.dot(points[p].reshape((tiles * count, inputs)).T, rows[p], product)
        kept.of_points[p] += product
    if k > 0:
        _multiply(of_sums, layer.adjoint, points)
        below = _cube(work.slopes, height, width, count * inputs)
        gather(np.ascontiguousarray(INPUT.T), points, below, step, work.scratch)


@compiled
def _multiply(points, weights, sums):  # type: ignore[no-untyped-def]
    """The product at each point."""
    _, inputs, outputs = weights.shape
    rows = points[0].size // inputs
    for p in range(PLACES):
        np.dot(points[p].reshape((rows, inputs)), weights[p], sums[p].reshape((rows, outputs)))


@compiled
def _show(stacks, picked, flat, layer):  # type: ignore[no-untyped-def]
    """Bytes to numbers in [0, 1], and zeros beyond the edges."""
    _, down, across, lanes = stacks.shape
    height, width, _, _ = _sides(layer)
    image = flat[: height * width * len(picked) * lanes].reshape((height, width, len(picked), lanes))
    for y in range(height):
        for x in range(width):
            if y >= down or x >= across:
                image[y, x] = ZERO
                continue
            for b in range(len(picked)):
                for k in range(lanes):
                    image[y, x, b, k] = OF_BYTE * F32(stacks[picked[b], y, x, k])


@compiled
def _rectify(made, layer, read):  # type: ignore[no-untyped-def]
    """Add the bias and replace what is negative by 0; zeros beyond the edges."""
    down, across = layer.block
    for y in range(read.shape[0]):
        for x in range(read.shape[1]):
            if y >= layer.blocks[0] or x >= layer.blocks[1]:
                read[y, x] = ZERO
                continue
            for q in range(down * across):
                row = made[y * down + q // across, x * across + q % across]
                for b in range(read.shape[2]):
                    for n in range(len(layer.bias)):
                        value = row[b, n] + layer.bias[n]
                        read[y, x, b, q, n] = ZERO if value < ZERO else value  # NaN stays


@compiled
def _rectify_back(slopes, read, layer, made):  # type: ignore[no-untyped-def]
    """The gradient of outputs from that of what reads them; zeros where nothing does."""
    down, across = layer.block
    for y in range(made.shape[0]):
        for x in range(made.shape[1]):
            v, u = y // down, x // across
            if v >= layer.blocks[0] or u >= layer.blocks[1]:
                made[y, x] = ZERO
                continue
            q = y % down * across + x % across
            for b in range(made.shape[2]):
                for n in range(made.shape[3]):
                    made[y, x, b, n] = slopes[v, u, b, q, n] if read[v, u, b, q, n] > ZERO else ZERO


@compiled
def _learn_dense(dense, work, rows, picked, settings, share):  # type: ignore[no-untyped-def]
    """Fill the figures, the gradient of the dense layers, and that of the last convolution's outputs."""
    count, of = len(picked), work.of_dense
    flat = work.flat[:count]
    hidden = np.dot(flat, dense.weights)
    for b in range(count):
        for n in range(len(dense.bias)):
            value = hidden[b, n] + dense.bias[n]
            hidden[b, n] = ZERO if value < ZERO else value  # NaN stays
    out = np.dot(hidden, dense.heads.T) + dense.heads_bias
    of_out = np.empty_like(out)
    work.figures[:] = 0.0
    add_losses(
        (out[:, :-1], out[:, -1:]), (of_out[:, :-1], of_out[:, -1:]), rows, picked, settings, work.figures
    )
    work.figures[:] *= share
    of_out *= F32(share)
    of_hidden = np.dot(of_out, dense.heads)
    of.heads_bias[:] = ZERO
    of.bias[:] = ZERO
    for b in range(count):
        of.heads_bias[:] += of_out[b]
        for n in range(len(dense.bias)):
            slope = of_hidden[b, n] if hidden[b, n] > ZERO else ZERO
            of_hidden[b, n] = slope
            of.bias[n] += slope
    np.dot(of_out.T, hidden, of.heads)
    np.dot(flat.T, of_hidden, of.weights)
    np.dot(of_hidden, dense.weights.T, work.of_flat[:count])
