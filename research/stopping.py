"""Measure how many episodes a sweep could save by stopping early: python -m research.stopping.

Two groups are compared after each batch of corridors, and evaluation stops at a significant difference. The
table has how often a difference is reported, and the share of episodes used, for three plans: one look;
several looks, each tested as if it were the only one; several looks that share the 5 % (Bonferroni). The
studies are simulated as in `research.coverage`.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jobs.analysis.statistics import CONFIDENCE, crossed_difference
from jobs.analysis.tables import show_table
from research.coverage import CORRIDORS, RATE, STUDIES

MEAN = 1.5  # logit of the better group: a rate of 80 % if its trainings agree
LOOKS = (5, 10, 14)  # corridors
DESIGNS = ((3, LOOKS), (3, (25, 50, 100)), (10, LOOKS))
SPREADS = (0.0, 1.0, 2.0)  # of the trainings' logits
EFFECTS = (0.0, 2.0)  # between the groups [logits]


class Plan(NamedTuple):
    """Over many studies, how often a plan reports a difference, and the share of episodes it uses."""

    decided: float
    episodes: float


def look_p_values(
    rng: np.random.Generator, trainings: int, looks: Sequence[int], spread: float, effect: float
) -> np.ndarray:
    """Return p of the difference of two groups at each look of simulated studies, float64 (studies, looks).

    Args:
        rng: Draws the studies.
        trainings: Trainings per group.
        looks: Numbers of corridors after which the groups are compared, rising.
        spread: Standard deviation of the trainings' logits.
        effect: Difference between the groups [logits].
    """
    found = np.ones((STUDIES, len(looks)))
    for study in range(STUDIES):
        hard = rng.normal(0.0, CORRIDORS, (1, 1, looks[-1]))
        logits = MEAN + rng.normal(0.0, spread, (2, trainings, 1)) + hard
        logits[1] -= effect
        first, second = (rng.random(logits.shape) < 1 / (1 + np.exp(-logits))).astype(np.float64)
        for place, corridors in enumerate(looks):
            p = crossed_difference(first[:, :corridors], second[:, :corridors], RATE).p
            found[study, place] = 1.0 if p is None else p
    return found


def stopped(p_values: np.ndarray, looks: Sequence[int], level: float) -> Plan:
    """Return the result of a plan that stops at the first look with p below `level`.

    Args:
        p_values: As returned by `look_p_values`.
        looks: Numbers of corridors after which the groups are compared.
        level: Significance level of each look.
    """
    below = p_values < level
    decided = below.any(axis=1)
    last = np.where(decided, below.argmax(axis=1), len(looks) - 1)
    return Plan(float(decided.mean()), float(np.take(looks, last).mean() / looks[-1]))


def plans(trainings: int, looks: Sequence[int], spread: float, effect: float) -> tuple[Plan, Plan, Plan]:
    """Return three plans: one look, several looks without correction, several looks that share the level."""
    p_values = look_p_values(np.random.default_rng(0), trainings, looks, spread, effect)
    level = 1 - CONFIDENCE
    once = stopped(p_values[:, -1:], looks[-1:], level)
    return once, stopped(p_values, looks, level), stopped(p_values, looks, level / len(looks))


def main() -> None:
    """Print the table."""
    rows = []
    for trainings, looks in DESIGNS:
        for effect in EFFECTS:
            for spread in SPREADS:
                once, naive, shared = plans(trainings, looks, spread, effect)
                rates = (once.decided, naive.decided, shared.decided, naive.episodes, shared.episodes)
                design = f"{trainings} x {', '.join(map(str, looks))}"
                rows.append((design, f"{effect:g}", f"{spread:g}", *(f"{100 * rate:.0f}" for rate in rates)))
    said = ("looks once", "each look for itself", "shared", "episodes", "episodes, shared")
    head = ("Trainings x corridors", "Effect", "Spread", *(f"{name} [%]" for name in said))
    show_table("Groups said to differ", head, rows, 1, None)


if __name__ == "__main__":
    main()
