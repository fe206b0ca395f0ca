"""From what trainings by PPO differ: from their encoder, or from the seed of PPO.

Run: python -m jobs.reporting.encoder_seeds
Prints, for each condition of the study `+exp=encoder_seeds`, whose episodes are in docs/data, and for their
mean, by how much success differs between encoders, between seeds of PPO, and by neither (standard
deviations), with the p of the F tests.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from jobs.analysis.statistics import crossed_spread
from jobs.analysis.tables import show_table
from jobs.evaluation.group_stats import Condition, episode_values
from jobs.reporting.breaks import SweptEpisodes
from jobs.reporting.sweep_data import read_sweep_episodes
from jobs.run.provenance import REPOSITORY

EPISODES = REPOSITORY / "docs" / "data" / "encoder_seeds_episodes.csv.gz"
OWN, OTHER = "own", "encoder_"  # groups: encoder and PPO of one seed; by the encoder of the seed in the name
HEAD = ("Success [%]", "Mean", "SD of encoders", "p", "SD of seeds of PPO", "p", "SD of the rest")


def by_encoder(episodes: SweptEpisodes) -> dict[Condition, np.ndarray]:
    """Success rate of each training, 0..1, (encoders, seeds of PPO), under each condition.

    Args:
        episodes: Of the study.

    Raises:
        ValueError: A training is missing.
    """
    cells: dict[Condition, dict[tuple[int, int], float]] = {}
    for (condition, group), trainings in episodes.items():
        for seed, success in zip(trainings, episode_values(trainings, "success").mean(axis=1), strict=True):
            if seed is not None:
                encoder = seed if group == OWN else int(group.removeprefix(OTHER))
                cells.setdefault(condition, {})[encoder, seed] = float(success)
    return {condition: _table(own) for condition, own in cells.items()}


def _table(cells: Mapping[tuple[int, int], float]) -> np.ndarray:
    seeds = sorted({seed for place in cells for seed in place})
    missing = [(encoder, seed) for encoder in seeds for seed in seeds if (encoder, seed) not in cells]
    if missing:
        raise ValueError(f"every encoder must be met by every seed of PPO; missing: {missing}; train these")
    return np.array([[cells[encoder, seed] for seed in seeds] for encoder in seeds])


def spread_rows(tables: Mapping[Condition, np.ndarray]) -> list[tuple[str, ...]]:
    """A row under `HEAD` for each condition, and one for the mean of all."""
    every = {" ".join(condition): table for condition, table in tables.items()}
    every["mean"] = np.mean(list(tables.values()), axis=0)
    return [_row(name, table) for name, table in every.items()]


def _row(name: str, table: np.ndarray) -> tuple[str, ...]:
    found = crossed_spread(100 * table)
    ps = ["-" if p is None else f"{p:.2g}" for p in (found.rows_p, found.columns_p)]
    mean = f"{100 * table.mean():.0f}"
    return name, mean, f"{found.rows:.0f}", ps[0], f"{found.columns:.0f}", ps[1], f"{found.rest:.0f}"


def main(episodes: Path = EPISODES) -> None:
    """Print the table; without the study's episodes the program ends with the rule."""
    if not episodes.is_file():
        raise SystemExit(f"{episodes}: must hold the episodes of +exp=encoder_seeds, packed; it is not there")
    rows = spread_rows(by_encoder(read_sweep_episodes(episodes)))
    show_table("From what trainings by PPO differ", HEAD, rows, 1, None)


if __name__ == "__main__":
    main()
