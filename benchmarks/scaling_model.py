"""Model how training and sweeps scale with cores, from measurements of `benchmarks.scaling`, and plot it."""

from collections.abc import Mapping
from typing import NamedTuple, TypedDict

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from jobs.analysis.colours import AMBER, BLUE, GREEN, MUTED

STEPS = 2048  # steps of an iteration (appendix D.1.2)
BANDWIDTH = 1e9  # of the network between nodes [bytes/s]: 10 Gbit/s
CORES = (1, 2, 10, 100, 1000)


class Costs(NamedTuple):
    """The costs from which the model is computed.

    Attributes:
        step_s: Time of a core per simulated step [s].
        learn_s: Time of the learner per learned step, while all runners wait [s].
        step_bytes: Bytes through the object store per step.
        weight_bytes: Bytes sent to each runner per iteration.
        cell_s: Time of a core per condition of a sweep [s].
        trial_s: Time of the driver per trial of a sweep [s].
    """

    step_s: float
    learn_s: float
    step_bytes: float
    weight_bytes: float
    cell_s: float
    trial_s: float


class Measured(NamedTuple):
    """Measurements on one machine.

    Attributes:
        cores: Cores of the machine; simulated nodes share them.
        costs: Costs of the parts.
        rates: (Simulated nodes, env runners) -> environment steps per second of a training.
        sweeps: Number of cores that Ray counts -> conditions per second of a sweep.
    """

    cores: int
    costs: Costs
    rates: Mapping[tuple[int, int], float]
    sweeps: Mapping[int, float]


class TrainingRate(TypedDict):
    """Environment steps per second of a training."""

    nodes: int
    env_runners: int
    steps_per_s: float


class SweepRate(TypedDict):
    """Conditions per hour of a sweep."""

    cores: int
    conditions_per_h: float


class PlainMeasured(TypedDict):
    """`Measured` in plain containers, with its source."""

    source: str
    cores: int
    costs: dict[str, float]
    training: list[TrainingRate]
    sweep: list[SweepRate]


def as_plain(measured: Measured, source: str) -> PlainMeasured:
    """Return the measurements as plain containers for JSON; `source` says where the numbers come from."""
    return {
        "source": source,
        "cores": measured.cores,
        "costs": measured.costs._asdict(),
        "training": [
            {"nodes": nodes, "env_runners": runners, "steps_per_s": rate}
            for (nodes, runners), rate in measured.rates.items()
        ],
        "sweep": [
            {"cores": cores, "conditions_per_h": 3600 * rate} for cores, rate in measured.sweeps.items()
        ],
    }


def from_plain(values: PlainMeasured) -> Measured:
    """Return the measurements from the result of `as_plain`."""
    return Measured(
        values["cores"],
        Costs(**values["costs"]),
        {(one["nodes"], one["env_runners"]): one["steps_per_s"] for one in values["training"]},
        {one["cores"]: one["conditions_per_h"] / 3600 for one in values["sweep"]},
    )


def iteration_s(costs: Costs, cores: int) -> tuple[float, float, float]:
    """Return the seconds of one PPO iteration spent sampling, learning, and sending samples and weights.

    Each runner samples on a core; one process receives all samples and learns while the runners wait.
    """
    sent = STEPS * costs.step_bytes + cores * costs.weight_bytes
    return STEPS * costs.step_s / cores, STEPS * costs.learn_s, sent / BANDWIDTH


def conditions_per_s(costs: Costs, cores: int) -> float:
    """Return a sweep's conditions per second: proportional to the cores, until the driver is always busy."""
    return min(cores / costs.cell_s, 1 / costs.trial_s)


def plot_scaling(measured: Measured) -> Figure:
    """Draw rates over cores: the model as a line, the measurements on this machine as points.

    Beyond the machine's cores the model is extrapolated: its line is dashed, on grey. Points there are
    hollow, because their processes share the machine's cores.
    """
    figure = Figure(figsize=(9, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    costs, everywhere = measured.costs, range(1, max(CORES) + 1)
    training = {count: STEPS / sum(iteration_s(costs, count)) for count in everywhere}
    sweeping = {count: 3600 * conditions_per_s(costs, count) for count in everywhere}
    draw_model(left, training, measured.cores)
    left.axhline(1 / costs.learn_s, color=MUTED, lw=1, ls=":", label="the learner alone")
    for nodes, (colour, marker) in zip((1, 2), ((AMBER, "o"), (GREEN, "s")), strict=True):
        own = {runners: rate for (n, runners), rate in measured.rates.items() if n == nodes and runners}
        name = f"measured, {nodes} simulated node{'s' * (nodes > 1)}"
        draw_points(left, own, measured.cores, (colour, marker, name))
    left.set(xlabel="Cores that sample", ylabel="Environment steps per second", title="Training")
    draw_model(right, sweeping, measured.cores)
    right.axhline(3600 / costs.trial_s, color=MUTED, lw=1, ls=":", label="the driver alone")
    points = {cores: 3600 * rate for cores, rate in measured.sweeps.items()}
    draw_points(right, points, measured.cores, (AMBER, "o", "measured"))
    right.set(xlabel="Cores", ylabel="Conditions per hour", title="A sweep")
    for axes in (left, right):
        axes.set(xscale="log", yscale="log", xlim=(0.8, 1.25 * max(CORES)))
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter("{x:,g}")
            axis.set_minor_formatter(NullFormatter())
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.grid(alpha=0.3)
        axes.legend(frameon=False, fontsize=8, loc="lower right")
    return figure


def draw_model(axes: Axes, values: Mapping[int, float], cores: int) -> None:
    """Draw the model over the number of cores: solid up to `cores`, then dashed and on grey."""
    within = [count for count in values if count <= cores]
    beyond = [count for count in values if count >= cores]
    axes.axvspan(cores, 1.25 * max(values), color=MUTED, alpha=0.12, lw=0)
    axes.plot(within, [values[count] for count in within], color=BLUE, label="model")
    name = f"extrapolated beyond {cores} cores"
    axes.plot(beyond, [values[count] for count in beyond], color=BLUE, ls="--", label=name)


def draw_points(axes: Axes, values: Mapping[int, float], cores: int, look: tuple[str, str, str]) -> None:
    """Draw measured values over the number of processes, hollow if the processes share `cores` cores.

    Args:
        axes: Axes to draw on.
        values: Number of processes -> value.
        cores: Cores of the machine.
        look: Colour, marker and name.
    """
    colour, marker, name = look
    for shared in (False, True):
        own = {count: value for count, value in values.items() if (count > cores) == shared}
        fill, label = ("none", f"{name}, sharing {cores} cores") if shared else (colour, name)
        if own:
            axes.plot(
                list(own), list(own.values()), marker, color=colour, mfc=fill, ms=7, zorder=3, label=label
            )
