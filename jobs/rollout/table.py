"""The table of episodes: one row per episode, with labels for policy and condition in the first columns.

If a file is older than a column, the column gets its default, so that older files stay readable.
"""

import gzip
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from jobs.rollout.episodes import ADDED, EPISODE
from jobs.run.files import RunError, write_atomic

COLUMNS: tuple[str, ...] = EPISODE.names or ()
LABELS = ("Axis", "Value", "Group", "Training")  # labels of a study's episodes
WORDS: dict[str, Any] = {"Axis": str, "Value": str, "Group": str, "Training": "Int64"}


def as_table(labels: Sequence[str], episodes: Mapping[Any, np.ndarray]) -> pd.DataFrame:
    """Return all episodes as one table.

    Args:
        labels: Headings of the labels.
        episodes: Labels, one per heading -> EPISODE (n,).
    """
    parts = [
        pd.DataFrame({**dict(zip(labels, label, strict=True)), **{name: rows[name] for name in COLUMNS}})
        for label, rows in episodes.items()
    ]
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=[*labels, *COLUMNS])


def write_episodes(path: Path, labels: Sequence[str], episodes: Mapping[Any, np.ndarray]) -> None:
    """Write all episodes as one table into a CSV file, gzipped for .gz; arguments as in `as_table`."""
    text = io.StringIO()
    as_table(labels, episodes).to_csv(text, index=False, lineterminator="\n")
    whole = text.getvalue().encode()
    write_atomic(path, gzip.compress(whole, mtime=0) if path.suffix == ".gz" else whole)


def read_table(path: Path) -> pd.DataFrame:
    """Read a table of a study's episodes, plain or gzipped (.gz); missing later columns get their defaults.

    Raises:
        RunError: The file lacks a column that has no default.
    """
    table = pd.read_csv(path, dtype=WORDS, keep_default_na=False, na_values={"Training": [""]})
    lacking = [name for name in COLUMNS if name not in table.columns]
    without = [name for name in lacking if name not in ADDED]
    if without:
        raise RunError(f"{path}: must have the columns {without}; evaluate again")
    return table.assign(**{name: ADDED[name] for name in lacking})


def episodes_of(rows: Sequence[Sequence[object]], columns: Sequence[str]) -> np.ndarray:
    """Convert rows of values of these columns to EPISODE (n,); missing later columns get their defaults.

    Raises:
        ValueError: A row has more or fewer values than there are columns.
    """
    if any(len(row) != len(columns) for row in rows):
        raise ValueError(f"rows must have {len(columns)} values, one for each column")
    found = np.zeros(len(rows), EPISODE)
    for name in COLUMNS:
        if name in columns:
            place = list(columns).index(name)
            found[name] = [row[place] for row in rows]
        else:
            found[name] = ADDED[name]
    return found
