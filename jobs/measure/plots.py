"""Plot the cost of accuracy: of the simulator, of the event encoder, and of both end to end."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from jobs.analysis.colours import BLUE, COLOURS, INK, MUTED
from jobs.analysis.plots import tidy
from jobs.measure.encodings import repeats
from jobs.measure.measured import Measured, name_of
from jobs.measure.trade_page import ALL, ENCODER_KNOBS, MARGIN

MIN_ERROR = 1e-3  # smallest error on a logarithmic axis
# Offset of a knob's labels from their points [points], so that labels do not overlap.
LABELS = {
    "torch": ((0, 8), "center"),
    "precision": ((-5, 6), "right"),
    "newest events": ((-6, -3), "right"),
    "chunks": ((0, -13), "center"),
}
STYLES = (("o", "#2563eb"), ("^", "#d97706"), ("s", "#111827"))  # of scenes; markers differ too
APART = 0.3  # distance of the scenes within a row of a trade
# Panels of a trade: heading, columns with a value and the ends of its interval, and their scale.
TRADED = (
    ("Speed, times the default's", ("speed", "speed_low", "speed_high"), 1),
    ("Events that differ [%]", ("event_error",) * 3, 100),
    ("Success minus the default's [points]", ("difference", "difference_low", "difference_high"), 100),
)


def plot_costs(scene: str, settings: Sequence[Measured], front: Sequence[int], tolerance: float) -> Figure:
    """Draw a row for each setting with its cost and event error; a star marks settings on the front."""
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


def plot_encoding_costs(rows: Sequence[Measured]) -> Figure:
    """Draw cost of 2,000 events against latent error, and explained variance by context size, if measured.

    A band spans the costs of rows that compute the same: smaller differences may be noise. The plot has no
    front, because noise would choose its points, and no line between context sizes, which have a single
    training each.
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


def draw_settings(settings: Sequence[Mapping[str, str]]) -> Figure:
    """Draw speed, event error and change of success of settings from `trade_page.setting_values`.

    A row is a setting; each scene has its own marker.
    """
    shown = [one for one in settings if one["policies"] == ALL]
    names = list(dict.fromkeys(map(_label, shown)))
    scenes = list(dict.fromkeys(one["scene"] for one in shown))
    figure = Figure(figsize=(10.0, 1.3 + 0.27 * len(names)), layout="constrained")
    panels = figure.subplots(1, 3, sharey=True)
    for number, scene in enumerate(scenes):
        own = [one for one in shown if one["scene"] == scene]
        rows = np.array([names.index(_label(one)) for one in own]) + APART * (number - (len(scenes) - 1) / 2)
        marker, colour = STYLES[number % len(STYLES)]
        for panel, (_, columns, scale) in zip(panels, TRADED, strict=True):
            values = [[scale * float(one[name] or "nan") for name in columns] for one in own]
            middle, low, high = np.array(values).T  # NaN leaves a row empty
            panel.hlines(rows, low, high, color=colour, lw=1.2, alpha=0.6)
            panel.scatter(middle, rows, marker=marker, s=26, color=colour, label=scene, zorder=3)
    _dress(panels, names, {_label(one) for one in shown if one["front"] == "yes"})
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper right", ncols=3, frameon=False)
    return figure


def _label(one: Mapping[str, str]) -> str:
    """Return a setting in words; a bare value gets its knob as a prefix."""
    knob, setting = one["knob"], one["setting"]
    if knob in ENCODER_KNOBS and setting and " " not in setting:
        return f"{knob} {setting}"
    return setting or knob


def _dress(panels: Sequence[Axes], names: Sequence[str], front: set[str]) -> None:
    """Label rows and axes of a trade, and mark the default's values and the acceptable loss of success."""
    for panel, (heading, *_) in zip(panels, TRADED, strict=True):
        panel.set_xlabel(heading)
        panel.grid(axis="y", color="#e5e7eb", lw=0.6)
        tidy(panel)
    panels[0].axvline(1.0, color=MUTED, lw=0.8)
    panels[0].set_xscale("log")
    panels[0].set_xticks([0.05, 0.1, 0.2, 0.5, 1, 2], ["0.05", "0.1", "0.2", "0.5", "1", "2"])
    panels[0].set_xticks([], minor=True)
    panels[1].set_xscale("symlog", linthresh=1.0)
    panels[1].set_xticks([0, 1, 3, 10, 30, 100], ["0", "1", "3", "10", "30", "100"])
    panels[2].axvline(0.0, color=MUTED, lw=0.8)
    panels[2].axvline(-100 * MARGIN, color=MUTED, lw=0.8, ls=":")
    panels[0].set_yticks(range(len(names)), [f"{name} *" if name in front else name for name in names])
    panels[0].tick_params(axis="y", labelcolor=INK, length=0)
    panels[0].set_ylim(len(names) - 0.4, -0.6)
