"""Plots of the event encoder: cost against error, codings of time, pictures side by side."""

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from jobs.analysis.plots import COLOURS, MUTED, tidy
from jobs.measure.encodings import EncodingCost, repeats

# Where the labels of a knob stand from their points [points], so that near ones stay apart.
LABELS = {
    "torch": ((0, 8), "center"),
    "precision": ((-5, 6), "right"),
    "newest events": ((-6, -3), "right"),
    "chunks": ((0, -13), "center"),
}


def plot_encoding_costs(rows: Sequence[EncodingCost]) -> Figure:
    """Draw the cost of 2,000 events against the latent's error, and against what context sizes explain.

    A band spans the costs of the rows that compute the same: what differs by less may be noise. No front is
    drawn, because noise would choose its points; and no line through context sizes, of one training each.
    """
    figure = Figure(figsize=(11.5, 5.2), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.7, 1))
    times = [row.dense_us for row in repeats(rows)]
    name = f"the default, timed {len(times)} times"
    left.axvspan(min(times), max(times), color=MUTED, alpha=0.25, lw=0, label=name)
    draw_rows(left, [row for row in rows if row.knob != "context"], lambda row: 100 * row.error_mean)
    left.set(xscale="log", yscale="log", ylabel="Mean error of the latent [% of its deviation]")
    left.set_title("The run's encoder, read in other ways", loc="left", fontsize=10)
    left.legend(frameon=False, fontsize=8)
    draw_rows(right, [row for row in rows if row.knob == "context"], lambda row: 100 * row.explained)
    right.set(xscale="log", ylabel="Explained of held-out pictures [%]")
    right.axhline(0, color=MUTED, lw=0.8)  # so that the axis begins at nothing explained
    right.set_title("Context sizes, one brief training each", loc="left", fontsize=10)
    for panel in (left, right):
        panel.margins(x=0.15)
        panel.set_xlabel("Process time for 2,000 events [us]")
        panel.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        panel.xaxis.set_major_formatter(StrMethodFormatter("{x:,g}"))
        panel.xaxis.set_minor_formatter(NullFormatter())
        tidy(panel)
    return figure


def draw_rows(panel: Axes, rows: Sequence[EncodingCost], height: Callable[[EncodingCost], float]) -> None:
    """Draw a point per row, labelled with its setting."""
    for knob in dict.fromkeys(row.knob for row in rows):
        own = [row for row in rows if row.knob == knob]
        marker, size, order = ("*", 16, 4) if knob == "default" else ("o", 6, 3)
        spots = [(row.dense_us, height(row)) for row in own]
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
