"""Plots of what accuracy costs: cost against error, events against control rate."""

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure

from jobs.analysis.colours import BLUE, COLOURS, MUTED
from jobs.analysis.plots import tidy
from jobs.measure.measured import Measured, name_of

MIN_ERROR = 1e-3  # that is drawn on a logarithmic axis


def plot_costs(scene: str, settings: Sequence[Measured], front: Sequence[int], tolerance: float) -> Figure:
    """Draw a row for each setting: its cost and its event error; those of the front are named by a star."""
    figure = Figure(figsize=(9.6, 0.22 * len(settings) + 1.0), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    rows = range(len(settings))
    values = [one.cost_us for one in settings], [max(one.error, MIN_ERROR) for one in settings]
    for panel, own in zip(panels, values, strict=True):
        for row, value in zip(rows, own, strict=True):
            marker = "s" if settings[row].knob == "default" else "o"
            panel.plot(value, row, marker, ms=6, color=BLUE, mfc=BLUE if row in front else "none")
        panel.axvline(own[0], color=MUTED, lw=0.8)
        panel.set(xscale="log", ylim=(len(settings) - 0.5, -0.5))
        tidy(panel)
    names = [name_of(one.knob, one.setting) for one in settings]
    panels[0].set_yticks(rows, [f"{name} *" if row in front else name for row, name in enumerate(names)])
    panels[0].set_xlabel(f"Process time of a step in {scene} [us]")
    panels[1].axvline(tolerance, color=MUTED, lw=0.8, ls=":")
    panels[1].set_xlabel("Event error: share of events that differ")
    return figure


def plot_memory_modes(rates_hz: Sequence[float], events_hz: Mapping[str, Sequence[float]]) -> Figure:
    """Draw events per second of flight against the control rate, one line per memory mode."""
    figure = Figure(figsize=(7.2, 4.2), layout="constrained")
    panel = figure.subplots()
    for memory, values in events_hz.items():
        panel.plot(rates_hz, values, marker="o", color=COLOURS[memory], label=f"memory: {memory}")
    panel.set(xscale="log", xlabel="Control rate [Hz]", ylabel="Events per second of flight", ylim=(0, None))
    panel.set_xticks(rates_hz, [f"{rate:g}" for rate in rates_hz])
    panel.set_xticks([], minor=True)
    tidy(panel, "y")
    panel.legend(frameon=False)
    return figure
