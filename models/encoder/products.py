"""Matrix products with the same bits on every processor and for any number of threads.

A linear algebra library picks its kernels by the processor's vendor and instructions, and each kernel sums
in its own order: the same training then ends with other weights. Here each element is one chain of fused
multiply-adds in ascending order of the inner index, starting from the element's initial value:

    out[i, j] = fma(a[i, K-1], b[K-1, j], ... fma(a[i, 1], b[1, j], fma(a[i, 0], b[0, j], out[i, j])))

Vector registers hold neighbouring columns, each block continues the chains of the previous block, and threads
divide the rows or columns: none of this changes the order of a sum. The error of each element is at most K
times the rounding error of sum |a| |b|, as in any order. The blocks follow Goto and van de Geijn (2008).
"""

import functools
import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numba
import numpy as np
import torch
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic
from torch import Tensor, nn
from torch.nn import functional

ROWS = 6  # rows of a tile: with one line of columns its sums fill the AVX2 registers
LINE = 64  # bytes, one row of a tile
DEPTH, HEIGHT = 1024, 192  # size of a block, which stays in the L2 cache
NEAR = 1 << 15  # bytes; a panel is copied if its first and last line are farther apart
LINES = 4  # lines of a block of columns, read together
SMALL = 1 << 15  # bytes; a block of at most this size stays in the L1 cache
CHAINS = 64  # parallel sums of `dot`
SHARED = 1 << 21  # multiplications from which a second thread pays off


def _emit_fma(builder: Any, *values: Any) -> Any:
    """Emit a * b + c with one rounding, of numbers or vectors."""
    kind = values[0].type
    number, lanes = (kind.element, f"v{kind.count}") if isinstance(kind, ir.VectorType) else (kind, "")
    name = f"llvm.fma.{lanes}{'f32' if number == ir.FloatType() else 'f64'}"
    function = cgutils.get_or_insert_function(builder.module, ir.FunctionType(kind, [kind] * 3), name)
    return builder.call(function, values)


def _emit_moved(builder: Any, start: Any, steps: Any, stride: Any, kind: Any) -> Any:
    """Emit a pointer to a `kind`, `steps` strides [bytes] after `start`."""
    return builder.bitcast(builder.gep(start, [builder.mul(steps, stride)]), kind.as_pointer())


@intrinsic
def fma(typing: Any, a: Any, b: Any, c: Any) -> Any:
    """Compute a * b + c of three floats of one type with one rounding, the same on every processor."""

    def emit(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return _emit_fma(builder, *values)

    return (a(a, b, c), emit) if a == b == c and isinstance(a, types.Float) else None


@intrinsic
def _add_tile(  # noqa: PLR0913 - two factors and a sum, and where in them
    typing: Any, a: Any, i: Any, k: Any, panel: Any, depth: Any, out: Any, row: Any, column: Any, anew: Any
) -> Any:
    """Continue the chains of the tile of `out` at (row, column) by `depth` numbers of a[i:, k:] and `panel`.

    With `anew` the chains start at 0. Rows beyond the last row of `a` repeat that row. The code emits whole
    vectors, because LLVM may not reorder the sums of a loop to vectorise it.
    """
    size, index = out.dtype.bitwidth // 8, types.intp

    def emit(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        a_value, i, k, panel_value, depth, out_value, row, column, anew = values
        vector, word = ir.VectorType(context.get_value_type(out.dtype), LINE // size), depth.type
        same = ir.Constant(ir.VectorType(ir.IntType(32), vector.count), [0] * vector.count)

        def opened(kind: Any, value: Any) -> tuple[Any, Any, list[Any]]:
            array = context.make_array(kind)(context, builder, value)
            shape, strides = (cgutils.unpack_tuple(builder, part, 2) for part in (array.shape, array.strides))
            return shape[0], builder.bitcast(array.data, ir.IntType(8).as_pointer()), strides

        moved = functools.partial(_emit_moved, builder)
        (rows, a_start, a_by), (_, panel_start, panel_by), (_, out_start, out_by) = (
            opened(kind, value) for kind, value in ((a, a_value), (panel, panel_value), (out, out_value))
        )
        byte, last, zeros = ir.IntType(8), builder.sub(rows, word(1)), cgutils.alloca_once(builder, vector)
        a_rows, places, sums = [], [], []
        for r in range(ROWS):
            there = builder.add(i, word(r))
            there = builder.select(builder.icmp_signed("<", there, last), there, last)
            a_rows.append(moved(moved(a_start, there, a_by[0], byte), k, a_by[1], byte))
            out_row = moved(out_start, builder.add(row, word(r)), out_by[0], byte)
            places.append(moved(out_row, column, out_by[1], vector))
            sums.append(cgutils.alloca_once(builder, vector))
            source = builder.select(anew, zeros, places[r])
            builder.store(builder.load(source, align=size), sums[r])
        with cgutils.for_range(builder, depth) as loop:
            line = builder.load(moved(panel_start, loop.index, panel_by[0], vector), align=size)
            for start, total in zip(a_rows, sums, strict=True):
                factor = builder.load(moved(start, loop.index, a_by[1], vector.element))
                lane = builder.insert_element(vector(ir.Undefined), factor, ir.IntType(32)(0))
                factors = builder.shuffle_vector(lane, vector(ir.Undefined), same)
                builder.store(_emit_fma(builder, factors, line, builder.load(total)), total)
        for place, total in zip(places, sums, strict=True):
            builder.store(builder.load(total), place, align=size)
        return context.get_dummy_value()

    return types.void(a, index, index, panel, index, out, index, index, types.boolean), emit


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _copy(part, room) -> None:  # type: ignore[no-untyped-def]
    """Copy a matrix into the first rows and columns of another, in the memory order of the source."""
    if part.strides[0] < part.strides[1]:
        for j in range(part.shape[1]):
            for i in range(part.shape[0]):
                room[i, j] = part[i, j]
    else:
        for i in range(part.shape[0]):
            for j in range(part.shape[1]):
                room[i, j] = part[i, j]


def _of(number: Any) -> Any:
    """Return the signature of `add_product` for matrices of one number type, in any layout."""
    matrix = types.Array(number, 2, "A")
    return types.void(matrix, matrix, matrix, types.boolean)


@numba.njit([_of(types.float32), _of(types.float64)], cache=True, error_model="numpy", nogil=True)
def add_product(a, b, out, anew) -> None:  # type: ignore[no-untyped-def]  # noqa: C901 - loops over blocks
    """Add a (M, K) @ b (K, N) to `out` (M, N) in one thread, in the order that the module's docstring states.

    With `anew` the chains start at 0 instead of the values in `out`. Assumes matching shapes, one type,
    float32 or float64, and that `out` shares no memory with `a` and `b`.
    """
    rows, columns, depths, lanes = out.shape[0], out.shape[1], a.shape[1], LINE // out.itemsize
    most = min(DEPTH, depths)
    together = b.strides[0] >= b.strides[1] or most * LINE * LINES <= SMALL
    lines = max(1, min(LINES, -(-columns // lanes))) if together else 1
    wide = lines * lanes
    in_line, near = out.strides[1] == out.itemsize, b.strides[1] == b.itemsize and b.strides[0] * most <= NEAR
    room = np.empty((ROWS + 1 + most) * wide, out.dtype)
    if columns % lanes:
        room[:] = 0.0  # garbage in the padding columns could be denormal, which is slow
    room = room[-room.ctypes.data % LINE // out.itemsize :]
    corner, packed = room[: ROWS * wide].reshape((ROWS, wide)), room[ROWS * wide : (ROWS + most) * wide]
    far = a.strides[0] < a.strides[1] and a.strides[1] * most > NEAR
    turned = np.empty((most if far else 0, min(HEIGHT, rows)), out.dtype)
    for begin in range(0, rows, HEIGHT):
        end = min(begin + HEIGHT, rows)
        for k in range(0, max(depths, 1), DEPTH):
            depth = min(DEPTH, depths - k)
            own, top, first = a, 0, k
            if far:
                own, top, first = turned.T[: end - begin], begin, 0
                _copy(a[begin:end, k : k + depth], own)
            for left in range(0, columns, wide):
                right = min(left + wide, columns)
                block = b[k : k + depth, left:right]
                if not near or (right - left) % lanes:
                    block = packed.reshape((most, wide))
                    _copy(b[k : k + depth, left:right], block)
                for i in range(begin, end, ROWS):
                    for j in range(left, right, lanes):
                        panel = block[:, j - left :]
                        if in_line and i + ROWS <= end and j + lanes <= right:
                            _add_tile(own, i - top, first, panel, depth, out, i, j, anew and not k)
                            continue
                        there = out[i : min(i + ROWS, end), j : min(j + lanes, right)]
                        _copy(there, corner)
                        _add_tile(own, i - top, first, panel, depth, corner, 0, 0, anew and not k)
                        _copy(corner[: there.shape[0], : there.shape[1]], there)


@numba.njit(cache=True, error_model="numpy", nogil=True)
def add_rows(rows, out) -> None:  # type: ignore[no-untyped-def]
    """Add the rows of a matrix (M, N) to `out` (N,), one after the other."""
    for i in range(len(rows)):
        for j in range(len(out)):
            out[j] += rows[i, j]


def aligned(size: int) -> np.ndarray:
    """Return an empty float32 (size,) aligned to a cache line, so that no vector crosses two lines."""
    room = np.empty(size + LINE // 4, np.float32)
    return room[-room.ctypes.data % LINE // 4 :][:size]


@numba.njit(cache=True, error_model="numpy", nogil=True)
def dot(a, b):  # type: ignore[no-untyped-def]
    """Return the dot product of two vectors: CHAINS partial sums in parallel, then added in order."""
    sums = np.zeros(CHAINS, a.dtype)
    whole = len(a) // CHAINS * CHAINS
    for k in range(0, whole, CHAINS):
        for chain in range(CHAINS):
            sums[chain] = fma(a[k + chain], b[k + chain], sums[chain])
    for k in range(whole, len(a)):
        sums[k - whole] = fma(a[k], b[k], sums[k - whole])
    total = sums[0]
    for chain in range(1, CHAINS):
        total += sums[chain]
    return total


@functools.lru_cache(maxsize=1)
def _helpers(threads: int) -> ThreadPoolExecutor:
    """Return a pool of `threads - 1` threads that work alongside the calling thread."""
    return ThreadPoolExecutor(threads - 1)


os.register_at_fork(after_in_child=_helpers.cache_clear)  # a fork does not copy threads


def add_product_shared(a: np.ndarray, b: np.ndarray, out: np.ndarray, anew: bool) -> None:
    """Run `add_product` on as many threads as torch uses, which divide the rows or columns of `out`."""
    threads = torch.get_num_threads()
    if threads == 1 or out.size * len(b) < SHARED:
        add_product(a, b, out, anew)
        return
    by_rows = out.shape[0] >= out.shape[1]
    step = ROWS if by_rows else LINE // out.itemsize
    size = -(-max(out.shape) // (threads * step)) * step
    parts = [slice(begin, begin + size) for begin in range(0, max(out.shape), size)]
    calls: list[Any] = [
        (a[part], b, out[part], anew) if by_rows else (a, b[:, part], out[:, part], anew) for part in parts
    ]
    others = [_helpers(threads).submit(add_product, *call) for call in calls[1:]]
    add_product(*calls[0])
    for other in others:
        other.result()


class Product(torch.autograd.Function):
    """a (M, K) @ b (K, N), plus a bias (N,) if given, on the CPU, with gradients computed the same way."""

    @staticmethod
    def forward(ctx: Any, a: Tensor, b: Tensor, bias: Tensor | None) -> Tensor:
        """Return the product (M, N)."""
        ctx.save_for_backward(a, b)
        out = a.new_empty(len(a), b.shape[1]) if bias is None else bias.detach().repeat(len(a), 1)
        add_product_shared(a.detach().numpy(), b.detach().numpy(), out.numpy(), bias is None)
        return out

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradients of the inputs that need one, in the memory layout of each input."""
        (a, b), (to_a, to_b, to_bias) = ctx.saved_tensors, ctx.needs_input_grad
        of_bias = gradient.new_zeros(gradient.shape[1]) if to_bias else None
        if of_bias is not None:
            add_rows(gradient.contiguous().numpy(), of_bias.numpy())
        of_a = _product_like(a, gradient, b.T) if to_a else None
        return of_a, _product_like(b, a.T, gradient) if to_b else None, of_bias


def product(a: Tensor, b: Tensor) -> Tensor:
    """Compute a (M, K) @ b (K, N), with gradients. Uses torch on a GPU."""
    return Product.apply(a, b, None) if a.device.type == "cpu" else a @ b


def _product_like(like: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Compute a @ b in the memory layout (row- or column-major) of `like`."""
    if like.stride(0) < like.stride(1):
        return _product_like(like.T, b.T, a.T).T
    out = a.new_empty(len(a), b.shape[1])
    add_product_shared(a.detach().numpy(), b.detach().numpy(), out.numpy(), True)
    return out


def affine(inputs: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
    """Compute inputs (..., K) @ weight (M, K).T + bias (M,), with gradients.

    Uses torch on a GPU, in exported files, and for types other than float32 and float64.
    """
    ours = inputs.device.type == "cpu" and inputs.dtype == weight.dtype in (torch.float32, torch.float64)
    if not ours or torch.compiler.is_compiling():
        return functional.linear(inputs, weight, bias)
    out = Product.apply(inputs.reshape(-1, weight.shape[1]), weight.T, bias)
    return out.reshape(*inputs.shape[:-1], len(weight))


class Linear(nn.Linear):
    """A dense layer computed by `affine`."""

    def forward(self, inputs: Tensor) -> Tensor:
        """Return outputs (..., M) of inputs (..., K)."""
        return affine(inputs, self.weight, self.bias)


class PackedLinear(nn.Module):
    """A float32 `Linear` with its current weights packed, for a few rows at a time; same output bits.

    `add_product` packs its second factor in each call, which takes longer than the products of a few rows.
    """

    def __init__(self, layer: nn.Linear) -> None:
        """Copy the weights of a layer into panels (P, K, lanes), and its bias."""
        super().__init__()
        self._size, inputs = layer.weight.shape
        lanes = LINE // 4
        padded = np.zeros((-(-self._size // lanes) * lanes, inputs), np.float32)
        padded[: self._size] = layer.weight.detach().numpy()
        self._panels = aligned(padded.size).reshape(-1, inputs, lanes)
        self._panels[:] = padded.reshape(-1, lanes, inputs).transpose(0, 2, 1)
        self._bias = np.zeros(len(padded), np.float32)
        if layer.bias is not None:
            self._bias[: self._size] = layer.bias.detach().numpy()

    def forward(self, inputs: Tensor) -> Tensor:
        """Return outputs (..., M) of inputs (..., K), without gradients."""
        rows = inputs.detach().reshape(-1, self._panels.shape[1]).contiguous().numpy()
        out = aligned(-(-len(rows) // ROWS) * ROWS * len(self._bias)).reshape(-1, len(self._bias))
        out[:] = self._bias
        if len(rows):
            _add_panels(rows, self._panels, out)
        return torch.from_numpy(out[: len(rows), : self._size]).reshape(*inputs.shape[:-1], self._size)


@numba.njit(
    types.void(types.float32[:, ::1], types.float32[:, :, ::1], types.float32[:, ::1]),
    cache=True,
    error_model="numpy",
    nogil=True,
)
def _add_panels(a, panels, out) -> None:  # type: ignore[no-untyped-def]
    """Add a (M, K) @ b to `out`, whose rows are M rounded up to a multiple of ROWS; `panels` is b packed."""
    for p in range(len(panels)):
        for i in range(0, len(out), ROWS):
            _add_tile(a, i, 0, panels[p], a.shape[1], out, i, p * panels.shape[2], False)


class PairedConvolution(nn.Module):
    """A convolution whose output for one picture has the bits that it has in a batch.

    For kernels of up to 3 x 3, torch runs different code on one picture than on several.
    """

    def __init__(self, layer: nn.Conv2d) -> None:
        """Run this layer, without a copy of its weights."""
        super().__init__()
        self._layer = layer

    def forward(self, pictures: Tensor) -> Tensor:
        """Return the layer's outputs (B, ...) of pictures (B, ...)."""
        if len(pictures) != 1:
            return self._layer(pictures)
        return self._layer(pictures.expand(2, *pictures.shape[1:]))[:1]


def packed(network: nn.Module) -> nn.Module:
    """Return a network for the CPU whose outputs have the same bits in a batch of any size.

    Args:
        network: A `Linear`, whose weights are packed; an `nn.Conv2d`; an `nn.Sequential` that contains some.
            Other layers are the same objects.
    """
    if type(network) is Linear and network.weight.dtype == torch.float32:
        return PackedLinear(network)
    if type(network) is nn.Conv2d:
        return PairedConvolution(network)
    if type(network) is nn.Sequential:  # a subclass may compute something else
        return nn.Sequential(*map(packed, network))
    return network


def orthogonal_(weight: Tensor, gain: float, generator: torch.Generator | None = None) -> None:
    """Fill a weight (M, ...) as `torch.nn.init.orthogonal_` does, from the same random numbers.

    LAPACK's QR depends on the processor, like its products. Here modified Gram-Schmidt runs in float64: rows
    or columns, whichever are fewer, are orthonormal to the rounding of float32.
    """
    if weight.is_meta:  # only the shape is needed
        return
    drawn = torch.empty(len(weight), weight[0].numel()).normal_(generator=generator).double().numpy()
    tall = drawn.shape[0] >= drawn.shape[1]
    vectors = np.array(drawn.T if tall else drawn, order="C")
    _orthonormalise(vectors)
    with torch.no_grad():
        weight.copy_(torch.from_numpy(gain * (vectors.T if tall else vectors)).reshape(weight.shape))


@numba.njit(cache=True, error_model="numpy")
def _orthonormalise(vectors) -> None:  # type: ignore[no-untyped-def]
    """Orthonormalise the rows of a matrix in place, from the first to the last."""
    for i in range(len(vectors)):
        own = vectors[i]
        own /= np.sqrt(dot(own, own))
        for j in range(i + 1, len(vectors)):
            share = dot(own, vectors[j])
            for k in range(len(own)):
                vectors[j, k] -= share * own[k]
