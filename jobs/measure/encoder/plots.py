"""Plots of the event encoder: cost against error, codings of time, pictures side by side."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from jobs.analysis.plots import COLOURS, EVENT_COLOURS, GRID, INK, MUTED, tidy
from jobs.measure.encoder.costs import EncodingCost, repeats
from models.encoder.embedding import temporal_embedding

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


def plot_codings(spreads: Mapping[str, Mapping[str, tuple[float, float]]]) -> Figure:
    """Draw the explained share (mean, half interval) of each coding under each condition."""
    figure = Figure(figsize=(8.8, 4.2), layout="constrained")
    panel = figure.subplots()
    for shift, (coding, own) in zip((-0.16, 0.0, 0.16), spreads.items(), strict=False):
        means, halves = 100 * np.array(list(own.values())).T
        x = np.arange(len(means)) + shift
        panel.errorbar(
            x,
            means,
            yerr=np.nan_to_num(halves),
            label=coding,
            fmt="o",
            ms=6,
            capsize=4,
            color=COLOURS[coding],
        )
        panel.set_xticks(np.arange(len(means)), list(own))
    panel.axhline(0, color=MUTED, lw=0.8)
    panel.set_ylabel("Explained of held-out pictures [%]")
    tidy(panel, "y")
    panel.legend(frameon=False, title="coding of time")
    return figure


def plot_embedding(context: int = 1024, times: int = 400) -> Figure:
    """Draw the code of each time of a window, as the paper's figure 6, and a few features of it over time."""
    figure = Figure(figsize=(11.0, 4.0), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.6, 1))
    t = (np.arange(times) + 0.5) / times
    code = temporal_embedding(t, context)
    image = left.imshow(code, aspect="auto", extent=(0, context, 1, 0), cmap="RdBu_r", vmin=-1, vmax=1)
    figure.colorbar(image, ax=left)
    left.set(xlabel="Feature (sines, then cosines)", ylabel="Time in the window")
    left.set_title("Additive code", loc="left", fontsize=10)
    for place, colour in ((0, "#93c5fd"), (context // 4, "#3b82f6"), (context // 2 - 1, "#1e3a8a")):
        right.plot(t, code[:, place], color=colour, label=f"additive, feature {place}")
    right.plot(t, t - 1, color=COLOURS["eventnet"], lw=2, label="eventnet, all features")
    right.set(xlabel="Time in the window", ylim=(-1.1, 1.9))
    right.set_title("Added to a feature", loc="left", fontsize=10)
    right.legend(frameon=False, fontsize=8, loc="upper right")
    right.spines[["top", "right"]].set_visible(False)
    return figure


def plot_pictures(rows: Mapping[str, Sequence[np.ndarray]], heads: Sequence[str]) -> Figure:
    """Draw event pictures (H, W) in [-1, 1] in labelled rows, under the headings of their columns."""
    figure = Figure(figsize=(1.25 * len(heads) + 0.6, 1.3 * len(rows) + 0.3), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.02, h_pad=0.02)  # type: ignore[union-attr, call-arg]
    panels = figure.subplots(len(rows), len(heads), squeeze=False)
    for line, (name, pictures) in zip(panels, rows.items(), strict=True):
        line[0].set_ylabel(name, color=INK, fontsize=9)
        for panel, picture in zip(line, pictures, strict=True):
            panel.imshow(picture, cmap=EVENT_COLOURS, vmin=-1, vmax=1, interpolation="nearest")
    for panel, head in zip(panels[0], heads, strict=True):
        panel.set_title(head, color=INK, fontsize=9)
    for panel in panels.flat:
        panel.set(xticks=[], yticks=[])
        panel.spines[:].set_color(GRID)
    return figure
