"""The table that readers see first: success of each policy when one thing changes."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np

from jobs.analysis.tables import markdown_table
from jobs.config.conditions import NOMINAL
from jobs.evaluation.group_stats import MET, Condition, episode_values
from jobs.reporting.breaks import SweptEpisodes
from jobs.reporting.words import condition_text
from jobs.run.files import RunError

SHOWN: tuple[Condition, ...] = (
    (NOMINAL, "poles_eval"),
    ("control_hz", "45"),
    ("contrast_threshold", "0.05"),
    ("sparsity", "0.5"),
    ("background_activity", "0.1"),
    ("sensor_noise", "5"),
    ("world", "shape_change"),
    ("world", "texture_change"),
    ("action_delay", "100"),
)
COLUMNS = {condition_text(*at): at for at in SHOWN}  # heading -> condition
BEGIN, END = "<!-- headline: +exp=report writes this table -->\n", "<!-- end of the headline -->\n"


def headline_table(
    groups: Mapping[str, Sequence[int | None]],
    episodes: SweptEpisodes,
    met: Collection[tuple[str, str, str]],
) -> str:
    """Success [%] of each group under `COLUMNS`, best mean of the row first; "-" where nothing was evaluated.

    Args:
        groups: Group -> its training seeds.
        episodes: Every episode of a sweep.
        met: Axis, value and group of what lies within what the group's training drew.
    """
    lines: list[tuple[float, tuple[str, ...]]] = []
    for group, seeds in groups.items():
        rates = {
            at: float(episode_values(episodes[at, group], "success").mean())
            for at in COLUMNS.values()
            if (at, group) in episodes
        }
        cells = [
            f"{100 * rates[at]:.0f}{MET if (*at, group) in met else ''}" if at in rates else "-"
            for at in COLUMNS.values()
        ]
        count = "" if None in seeds else f" ({len(seeds)})"
        lines.append((float(np.mean(list(rates.values()) or [0.0])), (f"`{group}`{count}", *cells)))
    lines.sort(key=lambda line: -line[0])
    return markdown_table(("policy (trainings)", *COLUMNS), [cells for _, cells in lines], 1)


def with_headline(page: Path, table: str) -> str:
    """The text of a page with the table between its marks.

    Raises:
        RunError: The page has no such marks.
    """
    before, begin, rest = page.read_text().partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise RunError(f"{page}: the lines {BEGIN.strip()!r} and {END.strip()!r} must enclose its table")
    return "".join((before, BEGIN, "\n", table, "\n", END, after))
