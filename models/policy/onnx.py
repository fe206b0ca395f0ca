"""A policy as one ONNX file: events or a picture in, logits and the next stack of features out.

For robots without Python. The graph is the whole policy, with the preprocessing of training. It takes::

    events       int64 (N, 4), t since the window's start [us], x, y [pixels], p (-1 or +1), in time order
    window_us    int64 (), length of the window [us]        (policies that see events)
    luminance    float32 (H, W), linear                     (policies that see luminance)
    last_stack   (depth, ...), next_stack of the step before; any values at an episode's first step
    velocity_mps float32 (2,), as the vehicle measures it  (policies with own_velocity; after first)
    last_action  int64 (), the action taken in the step before  (policies with own_actions; after first)
    last_state   float32 (S,), next_state of the step before  (recurrent networks; after first)
    first        bool (), whether this is an episode's first step
    last_us      int64 (H + 2, W + 2), next_us of the step before  (policies with a neighbour filter)

and returns::

    logits       float32 (actions,), unnormalised log-probabilities
    next_stack   as last_stack: float32, uint8 for pictures, int32 for sets of events
    next_action  int64 (), the most likely; if another one was taken, pass that as last_action
    next_state   as last_state
    next_us      as last_us: when each pixel fired last, relative to the end of this step [us]
    dropped      int64 (), events or pixels that were ignored because `Policy` rejects them
    command      float32 (C,), of the most likely action, as in the vehicle's Box  (vehicles with a body)

The graph ignores events outside the image or the window, or with p other than -1 and +1. It ignores all
events if they are not in time order or window_us is not in 1 .. MAX_WINDOW_US. Pixels that are not finite
count as black.

`tests/models/policy/test_onnx.py` compares the file with `models.policy.Policy` in onnxruntime. The extra
`onnx` of this package is needed.
"""

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from core.neighbour_filter import NEVER
from core.pictures import GAMMA, GREY_OFF, GREY_ON
from core.places import resolve
from models.encoder.event_batch import MAX_WINDOW_US, ROW_OFF, ROW_ON
from models.encoder.event_images import OFF_SHARE, PictureEncoder
from models.kinds import KINDS
from models.policy.event_filter import EventFilter, filter_of
from models.policy.event_set import EVENTS, TIMES, EventSet
from models.policy.memory import VELOCITY_UNIT_MPS
from models.policy.networks import network_of
from models.policy.policy import Policy

NEEDED = ("onnx", "onnxscript")
MAX_EVENTS = 1 << 24


def export_onnx(policy: Policy, path: str | Path) -> Path:
    """Write a policy as an ONNX file, including its weights.

    Args:
        policy: From `models.policy.load_policy`.
        path: The file; its folder must exist.

    Returns:
        The file.

    Raises:
        ModuleNotFoundError: The extra `onnx` is not installed.
        ValueError: Policies of its kind have no ONNX form.
    """
    if KINDS[policy.spec.model.name].onnx is None:
        raise ValueError(f"{policy.spec.model.name} has no ONNX form; give its row in models.kinds one")
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        raise ModuleNotFoundError(f"ONNX export needs {', '.join(missing)}: pip install 'evade[onnx]'")
    graph = PolicyGraph(policy).eval()
    inputs = graph.examples()
    own: dict[str, Tensor] = {}
    inputs |= {"last_stack": torch.zeros(graph.shape, dtype=graph.dtype), "first": torch.tensor(True)}
    if graph.own_velocity:
        inputs["velocity_mps"] = torch.zeros(2)
    if graph.own_actions:
        own["action"] = torch.tensor(0)
    if graph.state_size:
        own["state"] = torch.zeros(graph.state_size)
    if graph.filter is not None:
        own["us"] = torch.from_numpy(graph.filter.last_us.copy())
    inputs |= {f"last_{name}": value for name, value in own.items()}
    outputs = ["logits", "next_stack", *(f"next_{name}" for name in own), "dropped"]
    outputs += [] if graph.commands is None else ["command"]
    count = torch.export.Dim("count", min=0, max=MAX_EVENTS)
    program: Any = torch.onnx.export(
        graph,
        tuple(inputs.values()),
        input_names=list(inputs),
        output_names=outputs,
        dynamo=True,
        dynamic_shapes=(tuple({0: count} if name == "events" else None for name in inputs),),  # of *inputs
        verbose=False,
    )
    program.save(str(path))
    return Path(path)


class PolicyGraph(nn.Module):
    """One step of one episode of a policy, as a function of tensors."""

    def __init__(self, policy: Policy) -> None:
        super().__init__()
        spec = policy.spec
        self.shape = policy.stack_shape
        kept = torch.from_numpy(np.empty(0, policy.feature.dtype)).dtype
        self.dtype = torch.int32 if kept == torch.int16 else kept  # onnxruntime has more operators for int32
        self.size, self.bands = (spec.height, spec.width), torch.tensor(spec.bands)
        self.tau_us = torch.tensor([1e3 * time_ms for time_ms in spec.memory_ms])
        self.filter = filter_of(policy.manifest.get("sensor", {}), spec.width, spec.height)
        self.sees_events = policy.feature.from_events is not None
        self.num_actions = spec.num_actions
        self.state_size = network_of(spec).state(spec)
        self.own_actions, self.own_velocity = spec.own_actions, spec.own_velocity
        commands = policy.commands
        self.commands = None if commands is None else torch.from_numpy(commands.astype(np.float32))
        self.trunk, self.pi = policy.networks["trunk"], policy.networks["pi"]
        self.read = self.trunk.plain if isinstance(self.trunk, EventSet) else self.trunk
        self.feature = resolve(KINDS[spec.model.name].onnx or "")
        if isinstance(policy.encoder, PictureEncoder):
            self.layers, self.latent = policy.encoder.layers, policy.encoder.latent_size
        elif policy.encoder is not None:
            table = policy.encoder
            self.time_bins, self.turns = table.grid.time_bins, table.phase is not None
            self.most_events, self.rank = table.most_events, table.pool_rank
            arrays = {"features": table.features, "embedding": table.embedding}
            for name, (weight, bias) in {"hidden": table.hidden, "head": table.head}.items():
                arrays |= {f"{name}_weight": weight, f"{name}_bias": bias}
            if table.phase is not None:
                arrays["phase"] = table.phase
            for name, array in arrays.items():
                self.register_buffer(name, torch.from_numpy(array.copy()))

    def examples(self) -> dict[str, Tensor]:
        """Return an example of each input that the policy observes, by its name."""
        if self.sees_events:
            events = torch.tensor([[0, 0, 0, 1], [1, 0, 0, -1], [2, 0, 0, 1]])
            return {"events": events, "window_us": torch.tensor(5000)}
        return {"luminance": torch.zeros(self.size)}

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Compute the outputs from the inputs; the module's docstring lists both."""
        outputs = self._decided(*inputs)
        return outputs if self.commands is None else (*outputs, self.commands[outputs[0].argmax()])

    def _decided(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Return all outputs but the command."""
        inputs, dropped = self._valid(*inputs)
        if self.filter is None:
            return *self._step(*inputs), dropped
        events, window_us, stack, first, *state, last_us = inputs
        passing, next_us = _filtered(self.filter, events, torch.where(first, NEVER, last_us))
        return *self._step(events[passing], window_us, stack, first, *state), next_us - window_us, dropped

    def _valid(self, *inputs: Tensor) -> tuple[tuple[Tensor, ...], Tensor]:
        """Return the inputs without events or pixels that `Policy` rejects, and the number of these."""
        if not self.sees_events:
            luminance, *rest = inputs
            finite = torch.isfinite(luminance)
            return (torch.where(finite, luminance, 0.0), *rest), (~finite).sum()
        events, window_us, *rest = inputs
        t, x, y, p = events.unbind(1)
        height, width = self.size
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height) & (t >= 0) & (t <= window_us)
        before = torch.cat([torch.full((1,), NEVER), t])[:-1]
        inside = (
            inside & (p.abs() == 1) & (before <= t).all() & (window_us >= 1) & (window_us <= MAX_WINDOW_US)
        )
        return (events[inside], window_us.clamp(1, MAX_WINDOW_US), *rest), (~inside).sum()

    def _step(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Return logits, next stack, the next action with `own_actions`, and a recurrent network's state."""
        *given, state = inputs if self.state_size else (*inputs, torch.zeros(0))
        *given, action = given if self.own_actions else (*given, torch.tensor(0))
        *given, velocity_mps = given if self.own_velocity else (*given, torch.zeros(2))
        *seen, stack, first = given
        feature = self.feature(self, *seen).to(self.dtype)
        if self.own_actions:
            known = (torch.arange(self.num_actions) == action) & ~first
            feature = torch.cat([feature, known.to(self.dtype)])
        if self.own_velocity:
            feature = torch.cat([feature, velocity_mps / VELOCITY_UNIT_MPS])
        newest = feature[None]
        kept = newest + (stack[:-1] - newest) * self._rest(*seen) if len(self.tau_us) else stack[1:]
        pushed = torch.cat([kept, newest])
        stack = torch.where(first, feature[None].expand(self.shape), pushed)
        own: tuple[Tensor, ...] = ()
        if self.state_size:
            _, after = self.trunk(stack[None, None], torch.where(first, 0.0, state)[None])
            logits, own = self.pi(after)[0], (after[0],)
        else:
            logits = self.pi(self.read(stack[None]))[0]
        return logits, stack, *((logits.argmax(), *own) if self.own_actions else own)

    def _rest(self, events: Tensor, window_us: Tensor) -> Tensor:
        """Return the factor (K, 1) by which each mean decays in this step (`models.policy.memory`)."""
        return torch.exp(-window_us.float() / self.tau_us)[:, None]


def _filtered(chosen: EventFilter, events: Tensor, last_us: Tensor) -> tuple[Tensor, Tensor]:
    """Return which events pass (`models.policy.event_filter`), bool (N,), and each pixel's last event time.

    Compares every event with all others: exact, and fast for up to a few thousand events.
    """
    t, x, y, _ = events.unbind(1)
    width = chosen.last_us.shape[1]
    place, since = (y + 1) * width + x + 1, t - chosen.tau_us
    number = torch.ones_like(t).cumsum(0)
    recent = (number[None] < number[:, None]) & (t[None] >= since[:, None])
    fired, before = torch.zeros_like(t), last_us.flatten()
    for step in (-width - 1, -width, -width + 1, -1, 1, width - 1, width, width + 1):
        beside = place + step
        fired = (
            fired + ((recent & (place[None] == beside[:, None])).any(1) | (before[beside] >= since)).long()
        )
    after = before.scatter_reduce(0, place, t, "amax").reshape(last_us.shape)
    return fired >= chosen.support, after


def table_latent(policy: PolicyGraph, events: Tensor, window_us: Tensor) -> Tensor:
    """Return the latent: the largest (or `pool_rank`-th) table row, then the dense layers (appendix C)."""
    there = torch.ones_like(events[:, :1], dtype=torch.bool)
    if policy.most_events is not None:
        events, there = _thinned(events, policy.most_events)
    bins = _bins(events[:, 0], window_us, policy.time_bins)
    rows = policy.features[_code(policy, events) % len(policy.features)] + policy.embedding[bins]
    rows = torch.cat([torch.where(there, rows, 0.0), torch.zeros(policy.rank, rows.shape[1])])
    context = rows.amax(0) if policy.rank == 1 else rows.topk(policy.rank, 0).values[-1]  # 0 without events
    if policy.turns:  # EventNet's coding: the phase of the newest event of this magnitude
        times = torch.cat([bins, torch.zeros(1, dtype=bins.dtype)])
        newest = torch.where(rows == context, times[:, None], 0).amax(0)
        context = (context * policy.phase[:, newest]).flatten()
    hidden = torch.relu(policy.hidden_weight @ context + policy.hidden_bias)
    return policy.head_weight @ hidden + policy.head_bias


def picture_latent(policy: PolicyGraph, events: Tensor, window_us: Tensor) -> Tensor:
    """Return the mean of the latent of the event image, in which ON is 1 and OFF is `OFF_SHARE`."""
    picture = event_image(policy, events, window_us)
    shares = torch.where(picture == GREY_ON, 1.0, torch.where(picture == GREY_OFF, OFF_SHARE, 0.0))
    return policy.layers(shares[None, None])[0, : policy.latent]


def event_set(policy: PolicyGraph, events: Tensor, window_us: Tensor) -> Tensor:
    """Return rows of events, as in `models.encoder.event_batch.event_rows`."""
    events, there = _thinned(events, EVENTS)
    t, x, y, p = events.unbind(1)
    rows = torch.stack([torch.where(p > 0, ROW_ON, ROW_OFF), _bins(t, window_us, TIMES), x, y], dim=1)
    return torch.where(there, rows, 0)


def _thinned(events: Tensor, most: int) -> tuple[Tensor, Tensor]:
    """Return `most` rows of events, evenly over their order (`event_batch.thin`), and which are filled."""
    count = torch.ones_like(events[:, 0]).sum()
    kept = count.clamp(max=most)
    k = torch.arange(most)
    places = torch.div((2 * k + 1) * count, 2 * kept.clamp(min=1), rounding_mode="floor")
    padded = torch.cat([events, torch.zeros(1, 4, dtype=torch.int64)])
    return padded[torch.minimum(places, count)], (k < kept)[:, None]


def _bins(t: Tensor, window_us: Tensor, time_bins: int) -> Tensor:
    """Return the time bin of each event (`models.encoder.embedding.time_bin`)."""
    offset = torch.minimum(t.clamp(min=0), window_us)
    return torch.div(offset * time_bins, window_us, rounding_mode="floor").clamp(max=time_bins - 1)


def columns(policy: PolicyGraph, events: Tensor, window_us: Tensor) -> Tensor:
    """Return log(1 + count) of ON, then of OFF events in each column of each band."""
    _, x, y, p = events.unbind(1)
    width, count = policy.size[1], len(policy.bands) - 1
    band = (y[:, None] >= policy.bands).sum(1) - 1
    place = x + width * (count * (p < 0) + band.clamp(0, count - 1))
    seen = ((band >= 0) & (band < count)).float()
    return torch.log1p(torch.zeros(2 * count * width).scatter_add(0, place, seen))


def event_image(policy: PolicyGraph, events: Tensor, window_us: Tensor) -> Tensor:
    """Return 255 or 125 by each pixel's last event (the one with the highest number), else 0."""
    _, x, y, p = events.unbind(1)
    numbered = 2 * torch.ones_like(p).cumsum(0) + (p > 0)
    none = torch.zeros(policy.size[0] * policy.size[1], dtype=torch.int64)
    last = none.scatter_reduce(0, y * policy.size[1] + x, numbered, "amax")
    return torch.where(last == 0, 0, torch.where(last % 2 == 1, GREY_ON, GREY_OFF)).reshape(policy.size)


def grey(policy: PolicyGraph, luminance: Tensor) -> Tensor:
    """Return the gamma-encoded 8-bit picture."""
    return torch.round(255.0 * luminance.clamp(0.0, 1.0) ** (1.0 / GAMMA))


def _code(policy: PolicyGraph, events: Tensor) -> Tensor:
    """Return the row of each event in a table: ((p > 0) * height + y) * width + x."""
    _, x, y, p = events.unbind(1)
    return ((p > 0) * policy.size[0] + y) * policy.size[1] + x
