"""Plots of what accuracy costs: cost against error, events against control rate."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from jobs.analysis.colours import COLOURS, INK, MUTED
from jobs.analysis.plots import tidy
from jobs.measure.measured import Measured

MIN_ERROR = 1e-3  # that is drawn on a logarithmic axis


def plot_costs(scene: str, settings: Sequence[Measured], front: Sequence[int], tolerance: float) -> Figure:
    """Draw the cost of settings against their event error; those of the front are ringed."""
    figure = Figure(figsize=(9.6, 5.6), layout="constrained")
    panel = figure.subplots()
    places = np.array([(setting.cost_us, max(setting.error, MIN_ERROR)) for setting in settings])
    x, y = places[list(front)].T
    panel.scatter(x, y, s=130, facecolors="none", edgecolors=INK, zorder=5, label="no other is better")
    for knob in dict.fromkeys(setting.knob for setting in settings):
        own = [place for place, setting in enumerate(settings) if setting.knob == knob]
        marker, size, order = ("*", 260, 4) if knob == "default" else ("o", 34, 3)
        x, y = places[own].T
        panel.scatter(x, y, marker=marker, s=size, zorder=order, color=COLOURS[knob], label=knob)
        for place in own if knob != "default" else []:
            text = settings[place].setting.rpartition(" ")[2]
            panel.annotate(text, places[place], (5, 4), textcoords="offset points", fontsize=7, color=INK)
    panel.axhline(tolerance, color=MUTED, lw=0.8, ls=":", label="tolerance asked")
    panel.set(xscale="log", yscale="log", xlabel="Process time of an environment step [us]")
    panel.set_ylabel("Event error: share of events that differ")
    panel.set_title(f"Scene {scene}", loc="left", fontsize=10)
    tidy(panel)
    panel.legend(frameon=False, fontsize=8)
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
