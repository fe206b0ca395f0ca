"""Plots of the event encoder: cost against error."""

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from jobs.analysis.colours import COLOURS, MUTED
from jobs.analysis.plots import tidy
from jobs.measure.encodings import repeats
from jobs.measure.measured import Measured

# Where the labels of a knob stand from their points [points], so that near ones stay apart.
LABELS = {
    "torch": ((0, 8), "center"),
    "precision": ((-5, 6), "right"),
    "newest events": ((-6, -3), "right"),
    "chunks": ((0, -13), "center"),
}


def plot_encoding_costs(rows: Sequence[Measured]) -> Figure:
    """Draw cost of 2,000 events against error of the latent, and what context sizes explain, if any.

    A band spans the costs of the rows that compute the same: smaller differences may be noise. No front is
    drawn, because noise would choose its points; no line joins context sizes, which have one training each.
    """
    contexts = [row for row in rows if row.knob == "context"]
    ratios = (1.7, 1.0) if contexts else (1.0,)
    figure = Figure(figsize=(11.5 if contexts else 7.2, 5.2), layout="constrained")
    panels = figure.subplots(1, len(ratios), width_ratios=ratios, squeeze=False)[0]
    times = [row.cost_us for row in repeats(rows)]
    name = f"the default, timed {len(times)} times"
    panels[0].axvspan(min(times), max(times), color=MUTED, alpha=0.25, lw=0, label=name)
    draw_rows(panels[0], [row for row in rows if row.knob != "context"], lambda row: 100 * row.error)
    panels[0].set(xscale="log", yscale="log", ylabel="Mean error of the latent [% of its deviation]")
    panels[0].set_title("The run's encoder, read in other ways", loc="left", fontsize=10)
    panels[0].legend(frameon=False, fontsize=8)
    for panel in panels[1:]:
        draw_rows(panel, contexts, lambda row: 100 * row.outcome["explained"])
        panel.set(xscale="log", ylabel="Explained of held-out pictures [%]")
        panel.axhline(0, color=MUTED, lw=0.8)  # so that the axis starts at nothing explained
        panel.set_title("Context sizes, one brief training each", loc="left", fontsize=10)
    for panel in panels:
        panel.margins(x=0.15)
        panel.set_xlabel("Process time for 2,000 events [us]")
        panel.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        panel.xaxis.set_major_formatter(StrMethodFormatter("{x:,g}"))
        panel.xaxis.set_minor_formatter(NullFormatter())
        tidy(panel)
    return figure


def draw_rows(panel: Axes, rows: Sequence[Measured], height: Callable[[Measured], float]) -> None:
    """Draw a point per row, labelled with its setting."""
    for knob in dict.fromkeys(row.knob for row in rows):
        own = [row for row in rows if row.knob == knob]
        marker, size, order = ("*", 16, 4) if knob == "default" else ("o", 6, 3)
        spots = [(row.cost_us, height(row)) for row in own]
        panel.plot(
            *np.transpose(spots), marker, ms=size, mew=0, zorder=order, color=COLOURS[knob], label=knob
        )
        (right, up), side = LABELS.get(knob, ((6, 3), "left"))
        for step, (row, spot) in enumerate(zip(own, spots, strict=True)):
            offset = (right, up - 9 * (step % 3)) if knob == "chunks" else (right, up)
            panel.annotate(
                row.setting, spot, offset, color=COLOURS[knob],
                textcoords="offset points", ha=side, fontsize=7,
            )  # fmt: skip
