"""Check all results of the benchmark in a folder, and write its leaderboard: a table and a heat map.

Run: evade bench table FOLDER
Expect: seconds; FOLDER/leaderboard.md and FOLDER/leaderboard_PART.png. The command stops and names the file
if a result is inconsistent or does not follow the protocol.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from pydantic.dataclasses import dataclass

from envs.config import STRICT
from jobs.analysis.plots import INK
from jobs.analysis.tables import markdown_table
from jobs.bench.protocol import Protocol, read_protocol
from jobs.bench.result import RefusedResultError, Result, Submission, read_result
from jobs.bench.score import Scores, score
from jobs.config.config import Config
from jobs.config.schema import Name
from jobs.run.files import write_atomic
from jobs.run.progress import console

HEAD = (
    "policy", "met in training", "trainings", "mCE [%]", "clean [%]", "worst cell [%]", "kB",
    "operations an event", "ms a decision",
)  # fmt: skip
WORDS = 2


@dataclass(frozen=True, config=STRICT)
class Settings:
    """The folder with the results."""

    folder: Name


class Entry(NamedTuple):
    """One line of the leaderboard: all trainings of a policy."""

    results: tuple[Result, ...]
    scores: Scores

    @property
    def name(self) -> str:
        """Return the policy's name."""
        return self.results[0].policy


def run(config: Config) -> dict[str, float]:
    """Check the results, and write the leaderboard.

    Raises:
        RefusedResultError: A result is invalid, or there is none.
    """
    folder, protocol = Path(config.own.folder), read_protocol()
    board = entries(folder, protocol)
    write_atomic(folder / "leaderboard.md", page(board, protocol))
    for part, own in board.items():
        heat_map(own, protocol, part).savefig(folder / f"leaderboard_{part}.png", dpi=150)
    count = sum(len(entry.results) for own in board.values() for entry in own)
    console.print(f"{count} results agree with the protocol: {folder / 'leaderboard.md'}", markup=False)
    return {"results": float(count)}


def entries(folder: Path, protocol: Protocol) -> dict[str, list[Entry]]:
    """Return the entries of each part, best first.

    Raises:
        RefusedResultError: A result is invalid or its file has a wrong name, or there is none.
    """
    found: dict[tuple[str, str], list[Submission]] = defaultdict(list)
    for path in sorted(folder.glob("*.json")):
        submission = read_result(path, protocol)
        if path.stem != submission.result.name:
            raise RefusedResultError(f"{path}: must be called {submission.result.name}.json")
        found[submission.result.part, submission.result.policy].append(submission)
    if not found:
        raise RefusedResultError(f"{folder}: must hold results of `evade bench`, and holds no JSON file")
    board: dict[str, list[Entry]] = {part: [] for part in protocol.parts}
    for (part, _), several in found.items():
        scores = score([one.episodes for one in several], protocol.reference["failures"])
        board[part].append(Entry(tuple(one.result for one in several), scores))
    return {part: sorted(own, key=lambda entry: entry.scores.mce) for part, own in board.items() if own}


def page(board: Mapping[str, Sequence[Entry]], protocol: Protocol) -> str:
    """Return the leaderboard as Markdown."""
    text = [f"# Leaderboard of {protocol.title}", f"Protocol: SHA-256 `{protocol.sha256}`."]
    for part, own in board.items():
        text += [f"## Part {part}", table(own), f"![Failures by cell](leaderboard_{part}.png)"]
    return "\n\n".join(text) + "\n"


def table(own: Sequence[Entry]) -> str:
    """Return the table of one part as Markdown."""
    return markdown_table(HEAD, [_row(entry) for entry in own], WORDS)


def _row(entry: Entry) -> tuple[str, ...]:
    """Return the texts of an entry's line."""
    scores, first = entry.scores, entry.results[0]
    low, high = scores.interval or (np.nan, np.nan)
    several = len(entry.results)
    cost = first.cost
    interval = f"{100 * scores.mce:.1f} [{100 * low:.1f}, {100 * high:.1f}]" + ("" if several > 1 else "*")
    return (
        f"`{entry.name}`" + (f" ({first.source})" if first.source else ""),
        ", ".join(name.replace("_", " ") for name in first.met) or "-",
        str(several),
        interval.replace(" ", "\N{NO-BREAK SPACE}"),
        f"{100 * scores.clean:.0f}",
        f"{100 * scores.worst:.0f}: {scores.worst_cell[0].replace('_', ' ')} {scores.worst_cell[1]}",
        "-" if cost.bytes is None else f"{cost.bytes / 1e3:,.0f}",
        "-" if cost.operations_per_event is None else f"{cost.operations_per_event:,}",
        f"{cost.ms_per_decision:.2f}",
    )


def heat_map(own: Sequence[Entry], protocol: Protocol, part: str) -> Figure:
    """Draw the failure rate of each entry in each cell; a dot marks corruptions met in training."""
    corruptions = list(protocol.parts[part])
    rates = np.array(
        [[rate for name in corruptions for rate in entry.scores.failures[name]] for entry in own]
    )
    figure = Figure(figsize=(1.0 + 0.165 * rates.shape[1] + 1.6, 1.6 + 0.28 * len(own)), layout="constrained")
    axes = figure.add_subplot()
    image = axes.imshow(100.0 * rates, cmap="magma_r", vmin=0.0, vmax=100.0, aspect="auto")
    names = [f"{entry.name}  {100 * entry.scores.mce:.0f}" for entry in own]
    axes.set_yticks(range(len(own)), names, fontsize=8)
    width = rates.shape[1] // len(corruptions)
    words = [name.replace("_", " ") for name in corruptions]
    places = [width * k + (width - 1) / 2 for k in range(len(corruptions))]
    axes.set_xticks(places, words, rotation=35, ha="right", fontsize=8)
    for k in range(1, len(corruptions)):
        axes.axvline(width * k - 0.5, color="white", linewidth=2.0)
    for row, entry in enumerate(own):
        for name in entry.results[0].met:
            axes.plot(
                places[corruptions.index(name)], row, "o", color="white", markersize=3, markeredgecolor=INK
            )
    axes.set_title(f"{protocol.title}: failures at severities 1 to 5, and mCE [%]", fontsize=9, color=INK)
    figure.colorbar(image, ax=axes, label="failures [%]", pad=0.01)
    return figure
