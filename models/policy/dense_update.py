"""PPO's gradient steps for a policy of two dense tanh networks, all of an update in one compiled call.

At a minibatch of 32 the arithmetic of such networks takes tens of microseconds, and dispatching torch's
operations and their gradients ten times as long. The loss, gradient clipping and Adam are the same as in
RLlib's PPO in torch, which trains all other networks and is the reference in the tests. Sums run in
another order, and the relative error of tanh is at most 4e-7.
"""

import math
from collections.abc import Sequence
from enum import IntEnum
from typing import Any, NamedTuple

import numba
import numpy as np
import torch
from torch import nn

from models.encoder.products import add_product, add_rows, aligned, dot, fma

compiled = numba.njit(cache=True, error_model="numpy", nogil=True)
F32 = np.float32
TANH_IS_ONE = F32(7.9053111)  # tanh is 1 in float32 from here on
# tanh(x) = x P(x^2) / Q(x^2), highest power first: the rational approximation of the library Eigen.
P6, P5, P4 = F32(-2.76076847742355e-16), F32(2.00018790482477e-13), F32(-8.60467152213735e-11)
P3, P2, P1 = F32(5.12229709037114e-08), F32(1.48572235717979e-05), F32(6.37261928875436e-04)
Q3, Q2, Q1 = F32(1.19825839466702e-06), F32(1.18534705686654e-04), F32(2.26843463243900e-03)
P0, Q0 = F32(4.89352455891786e-03), F32(4.89352518554385e-03)


class Figure(IntEnum):
    """Metrics of a minibatch, as indices of their array."""

    POLICY_LOSS = 0
    VALUE_LOSS = 1
    ENTROPY = 2
    TOTAL_LOSS = 3
    NORM = 4


NUM_FIGURES = len(Figure)


class Rows(NamedTuple):
    """The N steps of an iteration as arrays (N, ...); actions are int64, all others float32.

    Attributes:
        stacks: Inputs of both networks.
        privileged: Further inputs of the value network alone, after the stacks; any width, also 0.
    """

    stacks: np.ndarray
    privileged: np.ndarray
    actions: np.ndarray
    logps: np.ndarray
    advantages: np.ndarray
    targets: np.ndarray


class Settings(NamedTuple):
    """Numbers of the loss and of Adam, as `torch.optim.Adam` and RLlib's PPO name them."""

    minibatch_size: int
    clip_param: float
    vf_loss_coeff: float
    vf_clip_param: float
    entropy_coeff: float
    grad_clip: float
    lr: float
    beta1: float
    beta2: float
    eps: float


class Network(NamedTuple):
    """One network as flat arrays, in the order of `torch.nn.utils.parameters_to_vector`.

    Attributes:
        widths: Numbers of inputs and of each layer's outputs, int64.
        values: The parameters.
        gradient: Gradient of the parameters.
        outputs: Outputs of all layers, one layer after the other.
        of_outputs: Gradients of the outputs.
    """

    widths: np.ndarray
    values: np.ndarray
    gradient: np.ndarray
    outputs: np.ndarray
    of_outputs: np.ndarray


class Adam(NamedTuple):
    """The parameters of both networks, their gradient, and Adam's two moments, one array each."""

    values: np.ndarray
    gradient: np.ndarray
    first: np.ndarray
    second: np.ndarray


def update_dense(
    networks: Sequence[nn.Sequential],
    optimizer: torch.optim.Adam,
    rows: Rows,
    orders: np.ndarray,
    settings: Settings,
) -> np.ndarray:
    """Take all gradient steps of an iteration; parameters and optimiser change in place.

    Args:
        networks: The policy and the value network, as built by `models.policy.networks.mlp`.
        optimizer: Optimiser of the parameters of both networks, in this order.
        rows: Steps to learn from.
        orders: int64 (epochs, N), the order of the rows in each epoch.
        settings: Settings of loss and optimiser.

    Returns:
        Means over the minibatches of the last epoch, float64, indexed by `Figure`; the norm is that of the
        gradient before clipping.

    Raises:
        RuntimeError: A gradient is not finite; the weights are those before this gradient's step.
    """
    parameters = [value for network in networks for value in network.parameters()]
    states = [_adam_state(optimizer, value) for value in parameters]
    ends = np.cumsum([value.numel() for value in parameters])
    kept = parameters, [one["exp_avg"] for one in states], [one["exp_avg_sq"] for one in states]
    adam = Adam(*(aligned(ends[-1]) for _ in range(4)))
    values, first, second = adam.values, adam.first, adam.second
    for flat, parts in zip((values, first, second), kept, strict=True):
        np.concatenate([part.detach().flatten().numpy() for part in parts], out=flat)
    pi, vf = _flat(networks, adam, min(settings.minibatch_size, len(rows.actions)))
    figures, taken = _take_steps(pi, vf, adam, rows, orders, settings, float(states[0]["step"]))
    for flat, parts in zip((values, first, second), kept, strict=True):
        for part, new in zip(parts, np.split(flat, ends[:-1]), strict=True):
            part.detach().copy_(torch.from_numpy(new).view_as(part))
    for state in states:
        state["step"].fill_(taken)
    if not math.isfinite(figures[Figure.NORM]):
        raise RuntimeError(f"gradients must be finite, got a non-finite norm after {taken:.0f} steps")
    return figures


def _adam_state(optimizer: torch.optim.Adam, value: torch.Tensor) -> dict[str, Any]:
    """Return Adam's state of one parameter; before the first step, initialise it as torch does."""
    state = optimizer.state[value]
    if not state:
        state["step"] = torch.zeros(())
        state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(value), torch.zeros_like(value)
    return state


def _flat(networks: Sequence[nn.Sequential], adam: Adam, most: int) -> list[Network]:
    """Return the arrays of each network, with space for the outputs of minibatches of up to `most` rows."""
    made, begin = [], 0
    for network in networks:
        layers = [layer for layer in network if isinstance(layer, nn.Linear)]
        widths = np.array([layers[0].in_features, *(layer.out_features for layer in layers)])
        own = slice(begin, begin + sum(value.numel() for value in network.parameters()))
        room = [aligned(most * widths[1:].sum()) for _ in range(2)]
        made.append(Network(widths, adam.values[own], adam.gradient[own], *room))
        begin = own.stop
    return made


@compiled
def _take_steps(pi, vf, adam, rows, orders, settings, taken):  # type: ignore[no-untyped-def]
    """Return the metrics (norm NaN if a gradient was not finite) and the number of Adam's steps so far."""
    epochs, count = orders.shape
    size = min(settings.minibatch_size, count)
    seen, more = rows.stacks.shape[1], rows.privileged.shape[1]
    inputs = np.empty((size, seen), np.float32)
    judged = np.empty((size, seen + more), np.float32)
    figures = np.zeros(NUM_FIGURES)
    for epoch in range(epochs):
        figures[:] = 0.0
        for begin in range(0, count, size):
            picked = orders[epoch, begin : begin + size]
            shown = inputs[: len(picked)]
            for b in range(len(picked)):
                shown[b] = rows.stacks[picked[b]]
            told = judged[: len(picked)] if more else shown
            if more:
                told[:, :seen] = shown
                for b in range(len(picked)):
                    told[b, seen:] = rows.privileged[picked[b]]
            logits, of_logits = _forward(shown, pi)
            values, of_values = _forward(told, vf)
            _add_losses(logits, values, of_logits, of_values, rows, picked, settings, figures)
            _backward(shown, pi)
            _backward(told, vf)
            norm = math.sqrt(dot(adam.gradient, adam.gradient))
            if not math.isfinite(norm):
                figures[Figure.NORM] = np.nan
                return figures, taken
            figures[Figure.NORM] += norm
            taken += 1.0
            _step(adam, settings, min(1.0, settings.grad_clip / (norm + 1e-6)), taken)
    return figures / ((count + size - 1) // size), taken


@compiled
def _part(flat, begin, rows, columns):  # type: ignore[no-untyped-def]
    """Return a view of a flat array from index `begin` on, as a matrix (rows, columns)."""
    return flat[begin : begin + rows * columns].reshape((rows, columns))


@compiled
def _forward(inputs, network):  # type: ignore[no-untyped-def]
    """Fill the outputs of all layers; return the last layer's outputs and the array for their gradient."""
    widths, count = network.widths, len(inputs)
    shown, at, to = inputs, 0, 0
    for k in range(1, len(widths)):
        weights = _part(network.values, at, widths[k], widths[k - 1])
        at += weights.size + widths[k]
        bias = network.values[at - widths[k] : at]
        out = _part(network.outputs, to, count, widths[k])
        of_out = _part(network.of_outputs, to, count, widths[k])
        to += out.size
        for b in range(count):
            out[b] = bias
        add_product(shown, weights.T, out, False)
        if k < len(widths) - 1:
            tanh(out.reshape(-1))
        shown = out
    return out, of_out


@compiled
def tanh(values):  # type: ignore[no-untyped-def]
    """Replace `values`, float32 (N,), by their tanh."""
    for j in range(len(values)):
        x = values[j]
        x = -TANH_IS_ONE if x < -TANH_IS_ONE else x  # NaN stays
        x = TANH_IS_ONE if x > TANH_IS_ONE else x
        s = x * x
        above = fma(fma(fma(fma(fma(fma(P6, s, P5), s, P4), s, P3), s, P2), s, P1), s, P0)
        values[j] = x * above / fma(fma(fma(Q3, s, Q2), s, Q1), s, Q0)


@compiled
def _add_losses(  # type: ignore[no-untyped-def]
    logits, values, of_logits, of_values, rows, picked, settings, figures
):
    """Add the losses of a minibatch to the figures; fill the gradients of logits and values."""
    count, actions = logits.shape
    logps = np.empty(actions)
    policy_loss = value_loss = entropy = 0.0
    for b in range(count):
        n = picked[b]
        highest, total = logits[b].max(), 0.0
        for j in range(actions):
            total += math.exp(float(logits[b, j] - highest))
        own_entropy = 0.0
        for j in range(actions):
            logps[j] = float(logits[b, j] - highest) - math.log(total)
            own_entropy -= math.exp(logps[j]) * logps[j]
        ratio, advantage = math.exp(logps[rows.actions[n]] - rows.logps[n]), float(rows.advantages[n])
        clipped = min(max(ratio, 1.0 - settings.clip_param), 1.0 + settings.clip_param)
        policy_loss -= min(advantage * ratio, advantage * clipped)
        slope = 0.0 if advantage * ratio > advantage * clipped else -advantage * ratio  # NaN stays
        for j in range(actions):
            chance = math.exp(logps[j])
            of_policy = slope * ((j == rows.actions[n]) - chance)
            of_logits[b, j] = (of_policy + settings.entropy_coeff * chance * (logps[j] + own_entropy)) / count
        error = float(values[b, 0] - rows.targets[n])
        beyond = error * error > settings.vf_clip_param
        value_loss += settings.vf_clip_param if beyond else error * error
        of_values[b, 0] = 0.0 if beyond else 2.0 * settings.vf_loss_coeff * error / count
        entropy += own_entropy
    total_loss = policy_loss + settings.vf_loss_coeff * value_loss - settings.entropy_coeff * entropy
    figures[Figure.POLICY_LOSS] += policy_loss / count
    figures[Figure.VALUE_LOSS] += value_loss / count
    figures[Figure.ENTROPY] += entropy / count
    figures[Figure.TOTAL_LOSS] += total_loss / count


@compiled
def _backward(inputs, network):  # type: ignore[no-untyped-def]
    """Compute the gradient of all parameters from the gradient of the last layer's outputs."""
    widths, count = network.widths, len(inputs)
    at, to = len(network.values), count * widths[1:].sum()
    for k in range(len(widths) - 1, 0, -1):
        to -= count * widths[k]
        slopes = _part(network.of_outputs, to, count, widths[k])
        of_bias = network.gradient[at - widths[k] : at]
        at -= widths[k] * (widths[k - 1] + 1)
        before = to - count * widths[k - 1]
        shown = inputs if k == 1 else _part(network.outputs, before, count, widths[k - 1])
        of_weights = _part(network.gradient, at, widths[k], widths[k - 1])
        of_bias[:] = F32(0.0)
        add_product(slopes.T, shown, of_weights, True)
        add_rows(slopes, of_bias)
        if k > 1:
            below = _part(network.of_outputs, before, count, widths[k - 1])
            add_product(slopes, _part(network.values, at, widths[k], widths[k - 1]), below, True)
            for b in range(count):
                row, out = below[b], shown[b]
                for j in range(len(row)):
                    row[j] *= fma(-out[j], out[j], F32(1.0))


@compiled
def _step(adam, settings, scale, taken):  # type: ignore[no-untyped-def]
    """Take the `taken`-th step of Adam (Kingma and Ba 2015) along `scale` times the gradient."""
    scale, eps, two = F32(scale), F32(settings.eps), F32(math.sqrt(1.0 - settings.beta2**taken))
    size = F32(settings.lr / (1.0 - settings.beta1**taken))
    keep1, keep2 = F32(settings.beta1), F32(settings.beta2)
    new1, new2 = F32(1.0 - settings.beta1), F32(1.0 - settings.beta2)
    values, gradient, first, second = adam.values, adam.gradient, adam.first, adam.second
    for j in range(len(values)):
        slope = scale * gradient[j]
        first[j] = fma(keep1, first[j], new1 * slope)
        second[j] = fma(keep2, second[j], new2 * slope * slope)
        values[j] -= size * first[j] / (math.sqrt(second[j]) / two + eps)
