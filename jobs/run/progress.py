"""Show progress: a bar in a terminal, elsewhere a plain line every few seconds."""

import contextlib
import sys
import time
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

PLAIN_LINE_EVERY_S = 10.0

# Without markup, because names of files and names that users choose may contain brackets.
console = Console(markup=False, highlight=False, soft_wrap=True, width=None if sys.stdout.isatty() else 140)


@contextlib.contextmanager
def progress(title: str, total: int, unit: str, done: int = 0) -> Iterator[Callable[..., None]]:
    """Show a job's progress, speed and remaining time.

    Args:
        title: What is being done.
        total: Number of units.
        unit: Name of the units, in the plural.
        done: Number of units done by an earlier run that this one continues.

    Yields:
        `advance(count, note="")`: report that `count` more units are done; the note (such as
        the current loss) is shown after them.
    """
    if console.is_terminal:
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.completed:,.0f}/{task.total:,.0f} " + unit),
            TimeRemainingColumn(),
            TextColumn("{task.fields[note]}"),
        )
        with Progress(*columns, console=console) as bar:
            task = bar.add_task(title, total=total, completed=done, note="")

            def advance(count: int, note: str = "") -> None:
                bar.advance(task, count)
                if note:
                    bar.update(task, note=note)

            yield advance
    else:
        lines = _PlainLines(title, total, unit, done)
        lines.show()
        yield lines.advance
        lines.show(final=True)


class _PlainLines:
    """Progress for a log file: one line every few seconds, and one at the end."""

    def __init__(self, title: str, total: int, unit: str, done: int) -> None:
        self.title, self.total, self.unit = title, total, unit
        self.done = done
        self.started = self.shown = time.monotonic()
        self.counted: tuple[float, int] | None = None  # time and count of the first report
        self.note = ""

    def advance(self, count: int, note: str = "") -> None:
        self.done += count
        # The speed excludes the time before the first report, such as the start of a cluster.
        self.counted = self.counted or (time.monotonic(), self.done)
        self.note = note or self.note
        if time.monotonic() - self.shown >= PLAIN_LINE_EVERY_S and self.done < self.total:
            self.show()

    def show(self, final: bool = False) -> None:
        self.shown = time.monotonic()
        since, first = self.counted or (self.shown, self.done)
        rate = (self.done - first) / (self.shown - since) if self.done > first else 0.0
        parts = [f"{self.title}: {self.done:,}/{self.total:,} {self.unit}"]
        if final:
            parts.append(f"in {clock(self.shown - self.started)}")
        elif rate > 0:
            parts.append(f"{rate:,.0f}/s, {clock((self.total - self.done) / rate)} left")
        parts.append(self.note)
        console.print(" · ".join(part for part in parts if part))


def clock(seconds: float) -> str:
    """Return a duration as text: 45 s, 3 min 20 s, 2 h 05 min."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
