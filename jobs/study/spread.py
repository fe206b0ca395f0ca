"""Split the spread between trainings into two crossed random factors, such as encoder and PPO seed."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from jobs.analysis.statistics import CONFIDENCE, CrossedSpread, crossed_spread, holm
from jobs.study.results import Condition, Results, values_of
from jobs.study.spec import tags_of

SEED = "seed"  # value of the tag that stands for the training's own seed


class Factors(NamedTuple):
    """Spread of the trainings in a table by row and by column.

    Attributes:
        mean: Mean success of all trainings [%].
        spread: Standard deviations [points].
        rows_p, columns_p: p values (Holm) of the tests that the row or column deviation is 0; None: not
            tested.
    """

    mean: float
    spread: CrossedSpread
    rows_p: float | None
    columns_p: float | None

    def certain(self, names: tuple[str, str]) -> list[str]:
        """Return the names of the factors by which trainings certainly differ."""
        p_values = self.rows_p, self.columns_p
        return [name for name, p in zip(names, p_values, strict=True) if p is not None and p < 1 - CONFIDENCE]


def crossed_tables(study: Mapping[str, Any], results: Results) -> dict[Condition, np.ndarray]:
    """Return condition -> success rate of each training, 0..1, (rows, columns).

    Args:
        study: Section `study` of its file. `spread.tag` names the tag that gives the row; the column is the
            seed.
        results: The results of the study.

    Raises:
        ValueError: A training is missing.
    """
    tag, tags = study["spread"]["tag"], tags_of(study, results)
    cells: dict[Condition, dict[tuple[int, int], float]] = {}
    for (at, group), trainings in results.cells.items():
        for seed, success in zip(trainings, values_of(trainings, "success").mean(axis=1), strict=True):
            if seed is not None:
                row = seed if tags[group][tag] == SEED else int(tags[group][tag])
                cells.setdefault(at, {})[row, seed] = float(success)
    return {at: _table(own) for at, own in cells.items()}


def _table(cells: Mapping[tuple[int, int], float]) -> np.ndarray:
    seeds = sorted({seed for place in cells for seed in place})
    missing = [(row, seed) for row in seeds for seed in seeds if (row, seed) not in cells]
    if missing:
        raise ValueError(f"every row must be crossed with every seed; missing: {missing}; train these")
    return np.array([[cells[row, seed] for seed in seeds] for row in seeds])


def factors(tables: Mapping[Condition, np.ndarray]) -> tuple[Factors, dict[Condition, Factors]]:
    """Return the factors of the mean over all conditions, and of each condition: two families of tests."""
    mean: Condition = ("", "")
    overall = _family({mean: np.mean(list(tables.values()), axis=0)})[mean]
    return overall, _family(tables)


def _family(tables: Mapping[Condition, np.ndarray]) -> dict[Condition, Factors]:
    spreads = {at: crossed_spread(100 * table) for at, table in tables.items()}
    tested = [p for one in spreads.values() for p in (one.rows_p, one.columns_p) if p is not None]
    adjusted = iter(holm(tested))
    found = {}
    for at, one in spreads.items():
        p_values = [None if p is None else next(adjusted) for p in (one.rows_p, one.columns_p)]
        found[at] = Factors(100 * float(tables[at].mean()), one, *p_values)
    return found
