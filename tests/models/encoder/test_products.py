import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from jobs.run.torch_threads import torch_threads
from models.encoder.event_images import nature_layers
from models.encoder.products import (
    DEPTH,
    HEIGHT,
    LINE,
    ROWS,
    Linear,
    PackedLinear,
    Product,
    add_product,
    add_product_shared,
    add_rows,
    affine,
    dot,
    orthogonal_,
    packed,
    product,
)

ROOT = Path(__file__).resolve().parents[3]
SIZES = st.sampled_from([0, 1, 2, 3, ROWS - 1, ROWS, ROWS + 1, 13, 15, 16, 17, 31, 33])
LAYOUTS = {
    "rows": np.ascontiguousarray,
    "columns": np.asfortranarray,
    "neither": lambda x: np.repeat(np.repeat(x, 2, 0), 3, 1)[::2, ::3],
}


def numbers(rng, *shape, dtype="f4"):
    return rng.standard_normal(shape).astype(dtype)


def fused(a, b, c):
    """a * b + c, rounded to float32 once; exact for the products of float32 in extended precision."""
    exact, c = np.longdouble(a) * np.longdouble(b), np.longdouble(c)  # 48 bits
    total = exact + c
    # Where the sum of 64 bits lies on the middle of two float32, what it lost decides.
    lost = (exact - (total - c)) + (c - (total - (total - c)))
    nudged = np.nextafter(total, np.copysign(np.longdouble(np.inf), lost))
    return np.where(lost == 0, total, nudged).astype(np.float32)


def chains(a, b, first):
    """The order that the file states, one inner index at a time."""
    out = np.ascontiguousarray(first)
    for k in range(a.shape[1]):
        out = fused(a[:, k, None], b[None, k], out)
    return out


@settings(max_examples=30)
@given(
    shape=st.tuples(SIZES, SIZES, SIZES),
    seed=st.integers(0, 99),
    layouts=st.tuples(*[st.sampled_from(sorted(LAYOUTS))] * 3),
)
def test_a_product_is_the_chains_of_its_elements_bit_for_bit(shape, seed, layouts):
    rng, (m, k, n) = np.random.default_rng(seed), shape
    a, b, first = (
        LAYOUTS[layout](numbers(rng, *size))
        for layout, size in zip(layouts, ((m, k), (k, n), (m, n)), strict=True)
    )
    out = LAYOUTS[layouts[2]](first.copy())
    add_product(a, b, out, False)
    assert out.tobytes() == chains(a, b, first).tobytes()
    add_product(a, b, out, True)
    assert out.tobytes() == chains(a, b, np.zeros_like(first)).tobytes()


@pytest.mark.parametrize(
    ("dtype", "shape"),
    [("f4", (HEIGHT + 5, DEPTH + 3, 9)), ("f4", (7, 2 * DEPTH, LINE)), ("f8", (50, DEPTH + 1, 40))],
)
def test_blocks_continue_the_chains_and_keep_to_the_bound(dtype, shape):
    rng, (m, k, n) = np.random.default_rng(0), shape
    a, b, out = numbers(rng, m, k, dtype=dtype), numbers(rng, k, n, dtype=dtype), np.zeros((m, n), dtype)
    add_product(a, b, out, False)
    exact, size = (one.astype(np.longdouble) @ two.astype(np.longdouble) for one, two in
                   ((a, b), (np.abs(a), np.abs(b))))  # fmt: skip
    assert (np.abs(out - exact) <= (k + 0.001) * np.finfo(dtype).eps / 2 * size).all()
    part = np.zeros_like(out)
    for begin, end in ((0, k // 3), (k // 3, k // 2), (k // 2, k)):  # the chains of the whole, in three links
        add_product(a[:, begin:end], b[begin:end], part, False)
    assert part.tobytes() == out.tobytes()


@pytest.mark.parametrize("shape", [(400, 90, 130), (50, 90, 1000), (1, 3000, 900)])
def test_threads_change_no_byte(shape):
    rng, (m, k, n) = np.random.default_rng(0), shape
    a, b, found = numbers(rng, m, k), numbers(rng, k, n), []
    for threads in (1, 2, 3):
        out = np.ones((m, n), np.float32)
        with torch_threads(threads):
            add_product_shared(a, b, out, False)
        found.append(out.tobytes())
    assert found[0] == found[1] == found[2]


def test_gradients_are_those_of_torch_in_double_precision():
    torch.manual_seed(0)
    a, b, bias = torch.randn(7, 5).double(), torch.randn(5, 9).double(), torch.randn(9).double()
    for one, two in ((a, b), (a, torch.randn(9, 5).double().T), (torch.randn(5, 7).double().T, b)):
        inputs = [value.detach().requires_grad_() for value in (one, two, bias)]
        assert torch.autograd.gradcheck(Product.apply, inputs)
        assert torch.autograd.gradcheck(product, inputs[:2])


@pytest.mark.parametrize(("shape", "biased"), [((4,), True), ((2, 0, 4), True), ((2, 3, 4), False)])
def test_a_dense_layer_is_torchs_to_rounding(shape, biased):
    torch.manual_seed(0)
    own, theirs = Linear(4, 6, bias=biased), torch.nn.Linear(4, 6, bias=biased)
    theirs.load_state_dict(own.state_dict())
    inputs = torch.randn(shape)
    torch.testing.assert_close(own(inputs), theirs(inputs))
    own(inputs).square().sum().backward()
    theirs(inputs).square().sum().backward()
    torch.testing.assert_close(own.weight.grad, theirs.weight.grad)
    assert own.weight.grad.is_contiguous()
    assert affine(inputs.half(), own.weight.half(), None).dtype == torch.float16


@pytest.mark.parametrize(("inputs", "outputs"), [(1, 33), (17, 1), (1030, 16)])
def test_packed_dense_layers_have_the_bytes_of_plain_ones(inputs, outputs):
    torch.manual_seed(inputs)
    network = torch.nn.Sequential(Linear(inputs, outputs), torch.nn.Tanh(), Linear(outputs, 3, bias=False))
    own = packed(network)
    assert isinstance(own[0], PackedLinear)
    assert own[1] is network[1]
    for shape in ((0,), (1,), (7,), (2, 3)):
        given = torch.randn(*shape, inputs)
        expected = network(given).detach()
        assert own(given).numpy().tobytes() == expected.numpy().tobytes()
    with torch.no_grad():
        network[0].weight.zero_()
    assert own(given).numpy().tobytes() == expected.numpy().tobytes()  # by the weights of that moment
    double = Linear(2, 3).double()
    assert packed(double) is double
    other = type("Twice", (torch.nn.Sequential,), {})(Linear(2, 3))  # which may compute otherwise
    assert packed(other) is other


def test_a_dot_and_sums_of_rows_are_exact_where_nothing_is_rounded():
    rng = np.random.default_rng(0)
    for size in (0, 1, 63, 64, 65, 1000):
        a, b = (rng.integers(-99, 99, size).astype("f4") for _ in range(2))
        assert dot(a, b) == int(a.astype(int) @ b.astype(int))
        out = np.ones(size, np.float32)
        add_rows(np.stack([a, b, a]), out)
        np.testing.assert_array_equal(out, 2 * a + b + 1)


@pytest.mark.parametrize("shape", [(3, 64), (64, 3), (32, 3, 8, 8)])
def test_orthogonal_weights_are_those_of_torch_and_orthogonal_to_rounding(shape):
    own, theirs = torch.empty(shape), torch.empty(shape)
    orthogonal_(own, 1.5, torch.Generator().manual_seed(1))
    torch.nn.init.orthogonal_(theirs, 1.5, torch.Generator().manual_seed(1))
    torch.testing.assert_close(own, theirs, rtol=0.0, atol=1e-5)
    matrix = own.flatten(1).double() / 1.5
    gram = matrix @ matrix.T if matrix.shape[0] <= matrix.shape[1] else matrix.T @ matrix
    assert (gram - torch.eye(len(gram))).abs().max() < 2e-7


DIGITS = """
import hashlib
import numpy as np, torch
from models.encoder.evae import EventVAE, event_targets, train_step
from models.encoder.event_batch import EventBatch
from models.policy.networks import mlp
from models.encoder.products import orthogonal_
rng, evae = np.random.default_rng(0), EventVAE(context=64)
with torch.no_grad():
    for value in evae.parameters():
        value.copy_(torch.from_numpy(rng.integers(-9, 9, tuple(value.shape)) / 64.0))
code = rng.integers(0, 8192, 2000, dtype=np.int32)
bins = np.sort(rng.integers(0, 1024, (4, 500), dtype=np.int32)).ravel()
batch = EventBatch(evae.grid, code, bins, np.arange(5, dtype=np.int64) * 500)
logits = evae(batch)[0]
logits.backward(torch.from_numpy((rng.integers(-9, 9, tuple(logits.shape)) / 64.0).astype("f4")))
weight = torch.empty(64, 96)
orthogonal_(weight, 1.0, torch.Generator().manual_seed(0))
made = [logits.detach(), *(value.grad for value in evae.parameters() if value.grad is not None)]
print(hashlib.sha256(b"".join(value.contiguous().numpy().tobytes() for value in made)).hexdigest())
"""
OTHERS = [
    {"MKL_CBWR": "SSE4_2", "MKL_ENABLE_INSTRUCTIONS": "SSE4_2", "OPENBLAS_CORETYPE": "Sandybridge"},
    {"OMP_NUM_THREADS": "2", "MKL_CBWR": "AVX2", "OPENBLAS_CORETYPE": "SkylakeX"},
]


@pytest.mark.system
@pytest.mark.parametrize("changed", OTHERS, ids=["old", "wide"])
def test_gradients_of_an_encoder_do_not_change_with_what_libraries_choose(changed):
    found = [
        subprocess.check_output(
            [sys.executable, "-c", DIGITS], cwd=ROOT, env={**os.environ, **more}, text=True
        )
        for more in ({}, changed)
    ]
    assert found[0] == found[1]


def test_a_picture_alone_has_the_outputs_that_it_has_in_a_batch():
    pictures = torch.rand(5, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    run = packed(torch.nn.Sequential(*nature_layers((3, 64, 64), 32)))
    with torch.inference_mode(), torch_threads(1):
        alone = torch.cat([run(one[None]) for one in pictures])
        assert torch.equal(run(pictures), alone)
        assert torch.equal(run(pictures[:2]), alone[:2])
