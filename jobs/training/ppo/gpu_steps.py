"""Gradient steps of a learner on a GPU, each a replay of one recorded step.

A step on 256 pictures takes 1.4 ms on an H200 and 70 ms on a CPU core (docs/performance.md). It consists of
many small kernels, and launching them takes longer than running them. So one step is recorded as a CUDA
graph, and all steps of an update replay it. Weights, Adam's moments and the rows of an iteration are copied
to the GPU once per update, the new weights and moments back. Arithmetic is float32 (the environment variable
TORCH_ALLOW_TF32_CUBLAS_OVERRIDE would make matrix products TF32), by algorithms that give the same digits
each time on the same GPU.
"""

import contextlib
import copy
from collections.abc import Callable, Hashable, Iterator, Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

Loss = Callable[[Any, dict[str, Tensor]], tuple[Tensor, dict[str, Tensor]]]
TOTAL, NORM = "total", "norm"  # names of a step's metrics, besides the parts of its loss
MOMENTS = ("step", "exp_avg", "exp_avg_sq")
ROOM = 256  # rows, unit of allocation: iterations differ by a few, and recorded steps read fixed addresses
WARM_UP = 3  # steps before the recording, in which libraries choose algorithms and allocate memory


class Recorded(NamedTuple):
    """One recorded gradient step.

    Attributes:
        key: Number of rows, gradient limit and variant of the loss for which it was recorded.
        graph: The step.
        picked: int64 (B,), the rows from which the next replay learns.
    """

    key: Hashable
    graph: torch.cuda.CUDAGraph
    picked: Tensor


class GpuSteps:
    """Takes the gradient steps of an update on a device, with copies of a module and its optimiser.

    With `device="cpu"`, for tests, no step is recorded; each is computed.
    """

    def __init__(self, module: nn.Module, optimizer: torch.optim.Optimizer, loss: Loss, device: str) -> None:
        """Copy the module and its optimiser to the device.

        Args:
            module: An RLlib module with `compute_values`.
            optimizer: Adam over all trainable parameters of the module.
            loss: (module, rows of a minibatch) -> the loss and its named parts.
            device: Name of a torch device.
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
        """Compute `module.compute_values` on the device; return the values on the CPU, float32 (B,)."""
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
            module: A module with the same layers as the one in the constructor.
            optimizer: Adam over the module's parameters.
            rows: Columns to learn from, each (N, ...).
            orders: int64 (epochs, N), the order of the rows in each epoch.
            minibatch_size: Rows of a step; the last step of an epoch may have fewer.
            grad_clip: Largest norm of a gradient.
            variant: Other values on which the loss depends; if they change, the step is recorded again.

        Returns:
            Means over the minibatches of the last epoch: parts of the loss, the loss itself (`TOTAL`), and
            the norm of its gradient before clipping (`NORM`).

        Raises:
            RuntimeError: A gradient is not finite; module and optimiser are unchanged.
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
        """Copy the rows to the memory of recorded steps; if it is too small, enlarge it and drop the step."""
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
        """Copy Adam's state (zeros before its first step) and its current step size to the device."""
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
        """Copy weights and moments back to the CPU."""
        for given, own in zip(_tensors(module), _tensors(self._module), strict=True):
            given.copy_(own)
        (group,) = optimizer.param_groups
        for given, own in zip(group["params"], self._parameters, strict=True):
            kept = optimizer.state[given]
            for name, value in self._state(own).items():
                kept[name] = value.cpu().clone() if name not in kept else kept[name].copy_(value)

    def _record(self, part: Tensor, grad_clip: float, variant: Hashable) -> Recorded | None:
        """Return a recorded step for this number of rows; None without a GPU.

        Recording changes weights and moments: load them afterwards.
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
        """Take one gradient step on the picked rows, and add its metrics to the sums."""
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
    """Return the parameters and buffers of a module."""
    return [value.detach() for value in (*module.parameters(), *module.buffers())]


@contextlib.contextmanager
def exact() -> Iterator[None]:
    """Make torch give the same digits each time, in full float32."""
    with torch.backends.cudnn.flags(enabled=True, benchmark=False, deterministic=True, allow_tf32=False):
        yield
