"""A learner's gradient steps on a GPU, each a replay of one recorded step.

A step on 256 pictures takes 1.4 ms of an H200, and 70 ms of a core (docs/performance.md). It consists of
many small kernels, which take longer to start one after the other than to run. So a step is recorded once as
a CUDA graph, and all of an update are replays of it: weights, Adam's moments and the rows of an iteration
travel to the GPU once an update, and what was learnt travels back. Arithmetic is float32 (the variable
TORCH_ALLOW_TF32_CUBLAS_OVERRIDE would make products of matrices TF32), by algorithms that give the same
digits each time on the same GPU.
"""

import contextlib
import copy
from collections.abc import Callable, Hashable, Iterator, Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

Loss = Callable[[Any, dict[str, Tensor]], tuple[Tensor, dict[str, Tensor]]]
TOTAL, NORM = "total", "norm"  # of what is reported of a step, beside the parts of its loss
MOMENTS = ("step", "exp_avg", "exp_avg_sq")
ROOM = 256  # rows: iterations differ by a few, and a recorded step reads from where the rows lay
WARM_UP = 3  # steps before one is recorded, in which libraries choose algorithms and allocate


class Recorded(NamedTuple):
    """One gradient step.

    Attributes:
        key: What it was recorded for.
        graph: The step.
        picked: int64 (B,), which rows the next replay learns from.
    """

    key: Hashable
    graph: torch.cuda.CUDAGraph
    picked: Tensor


class GpuSteps:
    """Copies of a module and its optimiser on a device, which take the steps of an update there.

    Without a GPU (`device="cpu"`) no step is recorded, each is computed: for tests.
    """

    def __init__(self, module: nn.Module, optimizer: torch.optim.Optimizer, loss: Loss, device: str) -> None:
        """Make the copies.

        Args:
            module: An RLlib module with `compute_values`; its parameters are those that the optimiser has.
            optimizer: Adam of its parameters.
            loss: The loss of a minibatch and its named parts, computed by the module that it is given.
            device: As torch names it.
        """
        self._device = torch.device(device)
        self._recording = self._device.type == "cuda"
        self._module = copy.deepcopy(module).to(self._device)
        self._parameters = [value for value in self._module.parameters() if value.requires_grad]
        (group,) = optimizer.param_groups
        self._lr = torch.zeros((), device=self._device)
        self._adam = torch.optim.Adam(
            self._parameters,
            lr=self._lr,
            betas=group["betas"],
            eps=group["eps"],
            fused=True,
            capturable=self._recording,
        )
        self._loss = loss
        self._rows: dict[str, Tensor] = {}
        self._sums: dict[str, Tensor] = {}
        self._recorded: Recorded | None = None

    def values(self, module: nn.Module, told: Mapping[str, Tensor]) -> Tensor:
        """Compute `module.compute_values` on the device; return it on the processor, float32 (B,)."""
        self._load_weights(module)
        with exact():
            return self._module.compute_values({name: self._there(part) for name, part in told.items()}).cpu()

    def take(
        self,
        module: nn.Module,
        optimizer: torch.optim.Optimizer,
        rows: Mapping[str, Tensor],
        orders: Tensor,
        minibatch_size: int,
        grad_clip: float,
        variant: Hashable = (),
    ) -> dict[str, Tensor]:
        """Take all steps of an update; module and optimiser change in place.

        Args:
            module: As the one that this was made from.
            optimizer: Adam of its parameters.
            rows: What to learn from, each (N, ...).
            orders: int64 (epochs, N), the order of the rows in each epoch.
            minibatch_size: Rows of a step; the last of an epoch may have fewer.
            grad_clip: Largest norm of a gradient.
            variant: What the loss depends on beside its arguments: another one is recorded again.

        Returns:
            Means over the minibatches of the last epoch: parts of the loss, the loss itself (`TOTAL`), and
            the norm of its gradient before the clip (`NORM`).

        Raises:
            RuntimeError: A gradient is not finite; module and optimiser are those before the update.
        """
        count = len(next(iter(rows.values())))
        self._load_rows(rows)
        orders = self._there(orders)
        with exact():
            recorded = self._record(orders[0, :minibatch_size], grad_clip, variant)
            self._load_weights(module)
            self._load_moments(optimizer)
            norms = torch.zeros((), device=self._device)
            for order in orders:
                for value in self._sums.values():
                    value.zero_()
                for part in order.split(minibatch_size):
                    if recorded is not None and len(part) == len(recorded.picked):
                        recorded.picked.copy_(part)
                        recorded.graph.replay()
                    else:
                        self._step(part, grad_clip)
                norms += self._sums[NORM]
        if not torch.isfinite(norms):
            raise RuntimeError(f"gradients must be finite, got a sum of norms of {float(norms)}")
        self._give_back(module, optimizer)
        steps = -(-count // minibatch_size)
        return {name: value.cpu() / steps for name, value in self._sums.items()}

    def _there(self, part: Tensor) -> Tensor:
        return part.to(self._device)

    def _load_rows(self, rows: Mapping[str, Tensor]) -> None:
        """Put the rows where recorded steps read them, which changes only if they have more room there."""
        count = len(next(iter(rows.values())))
        if not self._rows or len(next(iter(self._rows.values()))) < count:
            room = -(-count // ROOM) * ROOM
            self._rows = {
                name: torch.zeros((room, *part.shape[1:]), dtype=part.dtype, device=self._device)
                for name, part in rows.items()
            }
            self._recorded = None
        for name, part in rows.items():
            self._rows[name][:count].copy_(part)

    def _load_weights(self, module: nn.Module) -> None:
        for own, given in zip(_tensors(self._module), _tensors(module), strict=True):
            own.copy_(given)

    def _load_moments(self, optimizer: torch.optim.Optimizer) -> None:
        """Return Adam's state, zeros before its first step, and its step size of this moment."""
        (group,) = optimizer.param_groups
        self._lr.fill_(float(group["lr"]))
        for own, given in zip(self._parameters, group["params"], strict=True):
            for name in MOMENTS:
                state = optimizer.state.get(given, {}).get(name)
                self._state(own)[name].copy_(torch.zeros(()) if state is None else state)

    def _state(self, parameter: Tensor) -> dict[str, Tensor]:
        state = self._adam.state[parameter]
        if not state:
            state["step"] = torch.zeros((), device=self._device if self._recording else None)
            state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
        return state

    def _give_back(self, module: nn.Module, optimizer: torch.optim.Optimizer) -> None:
        """Copy weights and moments back to the processor."""
        for given, own in zip(_tensors(module), _tensors(self._module), strict=True):
            given.copy_(own)
        (group,) = optimizer.param_groups
        for given, own in zip(group["params"], self._parameters, strict=True):
            kept = optimizer.state[given]
            for name, value in self._state(own).items():
                kept[name] = value.cpu().clone() if name not in kept else kept[name].copy_(value)

    def _record(self, part: Tensor, grad_clip: float, variant: Hashable) -> Recorded | None:
        """Return a recorded step of as many rows; None without a GPU.

        Where it has to be recorded first, that moves weights and moments: they are to be loaded afterwards.
        """
        key = (len(part), grad_clip, variant)
        if self._recorded is not None and self._recorded.key == key:
            return self._recorded
        self._recorded = None
        self._step(part, grad_clip)
        if not self._recording:
            return None
        picked = part.clone()
        beside = torch.cuda.Stream()
        beside.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(beside):
            for _ in range(WARM_UP):
                self._step(picked, grad_clip)
        torch.cuda.current_stream().wait_stream(beside)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            self._step(picked, grad_clip)
        self._recorded = Recorded(key, graph, picked)
        return self._recorded

    def _step(self, picked: Tensor, grad_clip: float) -> None:
        """Take one gradient step on the picked rows, and add its figures to the sums."""
        total, figures = self._loss(self._module, {name: part[picked] for name, part in self._rows.items()})
        self._adam.zero_grad(set_to_none=True)
        total.backward()
        norm = nn.utils.clip_grad_norm_(self._parameters, grad_clip)
        self._adam.step()
        told = {**figures, TOTAL: total.detach(), NORM: norm}
        if not self._sums:
            self._sums = {name: torch.zeros_like(value) for name, value in told.items()}
        for name, value in told.items():
            self._sums[name] += value


def _tensors(module: nn.Module) -> list[Tensor]:
    """Return all that a module learns or counts."""
    return [value.detach() for value in (*module.parameters(), *module.buffers())]


@contextlib.contextmanager
def exact() -> Iterator[None]:
    """Make torch give the same digits each time, in full float32."""
    with torch.backends.cudnn.flags(enabled=True, benchmark=False, deterministic=True, allow_tf32=False):
        yield
