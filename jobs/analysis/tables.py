"""Numbers with their intervals, as tables; no number stands without one."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from rich.markup import escape
from rich.table import Table

from jobs.analysis.statistics import Interval, bootstrap_interval, wilson_interval
from jobs.run.files import write_atomic
from jobs.run.folder import Run
from jobs.run.progress import console

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from jobs.tracking.tracker import Tracker

FILE_WIDTH = 140


@dataclass(frozen=True)
class Summary:
    """What an agent achieved over the episodes of one condition.

    Attributes:
        label: What was flown, one word per heading of the table.
        episodes: Number of episodes [-].
        success: Fraction that reached the goal line, with its Wilson interval.
        distance_m: Mean forward distance without collision [m], with its bootstrap interval
            (None for a single episode).
        events_per_step: Mean events of a control step [-]; 0 for an agent that sees none.
        dropped: Events that did not fit into a window or a pixel, all episodes [-].
    """

    label: tuple[str, ...]
    episodes: int
    success: float
    success_interval: Interval
    distance_m: float
    distance_interval: Interval | None
    events_per_step: float
    dropped: int


def summarise(label: Sequence[str], episodes: np.ndarray) -> Summary:
    """Rates, means and intervals of the episodes (dtype `jobs.rollout.episodes.EPISODE`) of one condition.

    The resamples are drawn from a fixed seed: the same episodes give the same interval.
    """
    distance_m = episodes["distance_m"].astype(np.float64)
    interval = bootstrap_interval(distance_m, np.random.default_rng(0))
    return Summary(
        label=tuple(label),
        episodes=len(episodes),
        success=float(episodes["success"].mean()),
        success_interval=wilson_interval(int(episodes["success"].sum()), len(episodes)),
        distance_m=float(distance_m.mean()),
        distance_interval=interval,
        events_per_step=float(episodes["events_per_step"].mean()),
        dropped=int(episodes["dropped"].sum()),
    )


def cells(row: Summary) -> tuple[str, ...]:
    """A row of the table as text."""
    low, high = row.success_interval
    near, far = row.distance_interval or (None, None)
    distance = f"{row.distance_m:.1f}" + ("" if near is None else f" [{near:.1f}, {far:.1f}]")
    success = f"{100 * row.success:.0f} [{100 * low:.0f}, {100 * high:.0f}]"
    return (*row.label, str(row.episodes), success, distance, *events_texts(row.events_per_step, row.dropped))


def events_texts(events_per_step: float, dropped: int) -> tuple[str, str]:
    """Both as text; no events at all were not counted but not made, for an agent that sees none."""
    return (f"{events_per_step:.0f}", str(dropped)) if events_per_step > 0 else ("-", "-")


def headings(names: Sequence[str]) -> tuple[str, ...]:
    """The table's headings after those of the labels; intervals are 95 %."""
    return (*names, "Episodes", "Success [%]", "Distance [m]", "Events/step", "Dropped")


def table(title: str, names: Sequence[str], rows: Sequence[Summary]) -> Table:
    """The rows as a table for a terminal."""
    caption = "In brackets 95 % intervals: Wilson for success, bootstrap for distance"
    result = Table(title=title, caption=caption, title_justify="left")
    for place, name in enumerate(headings(names)):
        result.add_column(escape(name), justify="left" if place < len(names) else "right", overflow="fold")
    for row in rows:
        result.add_row(*map(escape, cells(row)))
    return result


def show(results: Table) -> None:
    """Print a table; whole, where there is no terminal to fit into."""
    console.print(results, width=None if console.is_terminal else FILE_WIDTH, soft_wrap=False)


def markdown(names: Sequence[str], rows: Sequence[Summary]) -> str:
    """The rows as a Markdown table."""
    return markdown_table(headings(names), [cells(row) for row in rows], len(names))


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]], words: int) -> str:
    """Rows of text as a Markdown table; all but the first `words` columns are numbers."""
    rules = ["---" if place < words else "---:" for place in range(len(head))]
    return "\n".join("| " + " | ".join(line) + " |" for line in (head, rules, *rows)) + "\n"


def columns(names: Sequence[str], rows: Sequence[Summary]) -> dict[str, list[str | float]]:
    """The rows as columns for a tracker; the first, all labels joined, is unique."""
    low_high = [row.distance_interval or (row.distance_m, row.distance_m) for row in rows]
    return {
        " · ".join(names): [" · ".join(row.label) for row in rows],
        "success_rate": [row.success for row in rows],
        "success_low": [row.success_interval[0] for row in rows],
        "success_high": [row.success_interval[1] for row in rows],
        "distance_m": [row.distance_m for row in rows],
        "distance_low_m": [low for low, _ in low_high],
        "distance_high_m": [high for _, high in low_high],
        "episodes": [row.episodes for row in rows],
    }


def metrics(row: Summary) -> dict[str, float]:
    """The figures of a row under the names that trackers and tables share."""
    low, high = row.distance_interval or (float("nan"), float("nan"))
    return {
        "eval/success_rate": row.success,
        "eval/success_rate_low": row.success_interval[0],
        "eval/success_rate_high": row.success_interval[1],
        "eval/distance_m": row.distance_m,
        "eval/distance_m_low": low,
        "eval/distance_m_high": high,
        "sim/events_per_step": row.events_per_step or float("nan"),
        "sim/dropped_events": float(row.dropped),
    }


def publish_table(
    folder: Run,
    tracker: "Tracker",
    name: str,
    title: str,
    head: Sequence[str],
    lines: Sequence[Sequence[str]],
) -> None:
    """Print a table, and write it as Markdown, `name`.md, into the run folder and the tracker."""
    table = Table(title=title, title_justify="left")
    for place, heading in enumerate(head):
        table.add_column(heading, justify="right" if place else "left")
    for line in lines:
        table.add_row(*line)
    show(table)
    rule = ["---:" if place else "---" for place in range(len(head))]
    text = "\n".join("| " + " | ".join(line) + " |" for line in (head, rule, *lines)) + "\n"
    write_atomic(folder.path / f"{name}.md", text)
    tracker.text(f"{name}.md", text)


def draw_figure(folder: Run, tracker: "Tracker", name: str, figure: "Figure") -> None:
    """Write a figure as `name`.png into the run folder and the tracker."""
    figure.savefig(folder.path / f"{name}.png", dpi=120)
    tracker.figure(f"{name}.png", figure)
