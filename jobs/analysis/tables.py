"""Numbers with intervals, as text and as tables: Markdown for files, rich for a terminal."""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.table import Table

from core.files import replaced
from jobs.analysis.statistics import Difference, Estimate, bootstrap_interval, wilson_interval
from jobs.run.files import write_atomic
from jobs.run.folder import Run
from jobs.run.progress import console

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from jobs.tracking.tracker import Tracker

FILE_WIDTH = 180
CAPTION = "In brackets 95 % intervals: Wilson for success, bootstrap for distance"
SUMMARY_HEADINGS = ("Episodes", "Success [%]", "Distance [m]", "Events/step", "Dropped")


@dataclass(frozen=True)
class Summary:
    """Results of an agent over the episodes of one condition.

    Attributes:
        label: What was evaluated, one word per heading of the table.
        episodes: Number of episodes [-].
        success: Fraction that reached the goal line, with its Wilson interval.
        distance_m: Mean forward distance without collision [m], with its bootstrap interval.
        events_per_step: Mean number of events per control step [-]; 0 for an agent that sees none.
        dropped: Number of events in all episodes that did not fit into a window or a pixel [-].
    """

    label: tuple[str, ...]
    episodes: int
    success: Estimate
    distance_m: Estimate
    events_per_step: float
    dropped: int


def summarise(label: Sequence[str], episodes: np.ndarray) -> Summary:
    """Summarise the episodes (dtype `jobs.rollout.episodes.EPISODE`) of one condition.

    The seed of the resamples is fixed: the same episodes give the same interval.
    """
    success, distance_m = episodes["success"], episodes["distance_m"].astype(np.float64)
    return Summary(
        label=tuple(label),
        episodes=len(episodes),
        success=Estimate(float(success.mean()), wilson_interval(int(success.sum()), len(episodes))),
        distance_m=Estimate(
            float(distance_m.mean()), bootstrap_interval(distance_m, np.random.default_rng(0))
        ),
        events_per_step=float(episodes["events_per_step"].mean()),
        dropped=int(episodes["dropped"].sum()),
    )


def estimate_text(estimate: Estimate | Difference | None, scale: float = 1, form: str = ".1f") -> str:
    """Format a value with its interval, such as "84 [76, 90]"; "-" for None."""
    if estimate is None:
        return "-"
    form = form.replace("+", "+z") if form.startswith("+") else f"z{form}"  # no minus before a rounded 0
    ends = ", ".join(format(scale * end, form) for end in estimate.interval or ())
    return f"{scale * estimate.value:{form}}" + (f" [{ends}]" if ends else "")


def percent_text(estimate: Estimate) -> str:
    """Format a fraction and its interval in whole per cent."""
    return estimate_text(estimate, 100, ".0f")


def short(value: float) -> str:
    """Format a number with two significant digits, from 10 on as a whole number."""
    return f"{value:,.0f}" if abs(value) >= 10 else f"{value:.2g}"


def events_texts(events_per_step: float, dropped: int) -> tuple[str, str]:
    """Format both counts; "-" for an agent that sees no events, because none are simulated."""
    return (f"{events_per_step:.0f}", str(dropped)) if events_per_step > 0 else ("-", "-")


def summary_cells(row: Summary) -> tuple[str, ...]:
    """Return the label of a summary, then a text for each of `SUMMARY_HEADINGS`."""
    events = events_texts(row.events_per_step, row.dropped)
    return (*row.label, str(row.episodes), percent_text(row.success), estimate_text(row.distance_m), *events)


def summary_columns(names: Sequence[str], rows: Sequence[Summary]) -> dict[str, list[str | float]]:
    """Return the columns of a tracker's table; the first has the joined labels, which are unique."""
    ends = [row.distance_m.interval or (row.distance_m.value,) * 2 for row in rows]
    return {
        " · ".join(names): [" · ".join(row.label) for row in rows],
        "success_rate": [row.success.value for row in rows],
        "success_low": [(row.success.interval or (row.success.value,))[0] for row in rows],
        "success_high": [(row.success.interval or (row.success.value,))[-1] for row in rows],
        "distance_m": [row.distance_m.value for row in rows],
        "distance_low_m": [low for low, _ in ends],
        "distance_high_m": [high for _, high in ends],
        "episodes": [row.episodes for row in rows],
    }


def estimate_metrics(name: str, estimate: Estimate | Difference | None) -> dict[str, float]:
    """Return an estimate as metrics: its value, and the ends of any interval as name_low and name_high."""
    if estimate is None:
        return {}
    ends = zip((f"{name}_low", f"{name}_high"), estimate.interval or (), strict=False)
    return {name: estimate.value, **dict(ends)}


def summary_metrics(row: Summary) -> dict[str, float]:
    """Return the metrics of a summary under the names that trackers and tables share; NaN: not measured."""
    return {
        **estimate_metrics("eval/success_rate", row.success),
        "eval/distance_m_low": float("nan"),
        "eval/distance_m_high": float("nan"),
        **estimate_metrics("eval/distance_m", row.distance_m),
        "sim/events_per_step": row.events_per_step or float("nan"),
        "sim/dropped_events": float(row.dropped),
    }


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]], words: int = 1) -> str:
    """Format rows of text as a Markdown table; all but the first `words` columns are numbers."""
    rules = ["---" if place < words else "---:" for place in range(len(head))]
    return "\n".join("| " + " | ".join(line) + " |" for line in (head, rules, *rows)) + "\n"


def show_table(
    title: str,
    head: Sequence[str],
    rows: Sequence[Sequence[str]],
    words: int = 1,
    caption: str | None = None,
) -> None:
    """Print rows of text as a table, `FILE_WIDTH` characters wide if there is no terminal.

    Args:
        title: Text above the table.
        head: Headings.
        rows: One text per heading.
        words: Number of columns with words, which are aligned to the left; the others have numbers.
        caption: Text below the table.
    """
    table = Table(title=title, caption=caption, title_justify="left")
    for place, name in enumerate(head):
        table.add_column(name, justify="left" if place < words else "right", overflow="fold")
    for row in rows:
        table.add_row(*row)
    console.print(table, width=None if console.is_terminal else FILE_WIDTH, soft_wrap=False)


def publish_table(
    folder: Run,
    tracker: "Tracker",
    name: str,
    title: str,
    head: Sequence[str],
    rows: Sequence[Sequence[str]],
    words: int = 1,
    caption: str | None = None,
) -> None:
    """Print a table, and write it as Markdown, `name`.md, into the run folder and the tracker."""
    show_table(title, head, rows, words, caption)
    text = markdown_table(head, rows, words)
    write_atomic(folder.path / f"{name}.md", text)
    tracker.text(f"{name}.md", text)


def write_csv(file: Path, head: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """Write rows below their headings as a CSV file; None is an empty cell."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([head, *rows])
    write_atomic(file, text.getvalue())


def publish_plot(folder: Run, tracker: "Tracker", name: str, plot: "Figure") -> None:
    """Write a plot as `name`.png into the run folder and the tracker."""
    save_plot(folder.path / f"{name}.png", plot)
    tracker.figure(f"{name}.png", plot)


def save_plot(path: Path, plot: "Figure") -> None:
    """Write a plot as a PNG file, whole or not at all."""
    with replaced(path) as part:
        plot.savefig(part, format="png", dpi=120)
