"""Every figure of the results, drawn from what is published in docs/data alone."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from envs.scene import make_scene
from jobs.config.conditions import NOMINAL, axis_numbers
from jobs.evaluation.group_stats import Condition, GroupResult, summarise_group
from jobs.evaluation.sweep_plots import collision_figure
from jobs.evaluation.sweep_report import SweepFacts
from jobs.reporting.breaks import Change, SweptEpisodes, changes_of, content, place
from jobs.reporting.paper_claims import Claim, Finding, judge_all
from jobs.reporting.summary_plots import Survival, axes_map, change_map, claims_plot, survival_plot
from jobs.reporting.words import TITLES, condition_text
from jobs.rollout.episodes import EPISODE
from jobs.tools.curves import PublishedTraining


def results_figures(
    about: SweepFacts, episodes: SweptEpisodes, trainings: Sequence[PublishedTraining]
) -> dict[str, Figure]:
    """Name of each figure of the results -> the figure.

    Args:
        about: What made the sweep.
        episodes: All of its episodes.
        trainings: The published trainings, for the claims about learning.
    """
    changes, results = changes_of(about, episodes), group_results(about, episodes)
    scene = make_scene(about["scene"], np.random.default_rng(0))
    labels = {place(one["condition"]): condition_text(*one["condition"]) for one in about["compared"]}
    findings = judge_claims(about, episodes, trainings)
    numbers = {TITLES.get(axis, axis): own for axis, own in numeric_axes(about, results).items()}
    figures = {
        "map": change_map(changes, list(about["groups"]), labels),
        "claims": claims_plot(findings),
        "survival": survival_plot(survivals(about, episodes, changes), scene.length_m),
        **({"axes": axes_map(numbers, list(about["groups"]))} if numbers else {}),
        "contacts": collision_figure(contacts(about, episodes), scene.length_m, scene.width_m / 2),
    }
    return {f"results_{name}": figure for name, figure in figures.items()}


def judge_claims(
    about: SweepFacts, episodes: SweptEpisodes, trainings: Sequence[PublishedTraining]
) -> dict[Claim, Finding]:
    """What the sweep and the published trainings say of the paper's claims."""
    baselines = {place(one["condition"]): place(one["baseline"]) for one in about["compared"]}
    learning: dict[str, list[float]] = {}
    for one in trainings:
        if one.mean_success_with_encoder is not None:
            learning.setdefault(one.group, []).append(one.mean_success_with_encoder)
    return judge_all(lambda condition, group: episodes.get((condition, group), {}), baselines, learning)


def group_results(about: SweepFacts, episodes: SweptEpisodes) -> list[GroupResult]:
    """The results of all conditions and groups of which something was evaluated."""
    reference = about["reference"]
    return [
        summarise_group(
            at, group, episodes[at, group], episodes.get((at, reference)) if group != reference else None
        )
        for at in ((axis, value) for axis, points in about["axes"].items() for value in points)
        for group in about["groups"]
        if (at, group) in episodes
    ]


def numeric_axes(about: SweepFacts, results: Sequence[GroupResult]) -> dict[str, list[GroupResult]]:
    """Axis -> its results, in the order of its values, where one number alone changes along it."""
    found = {}
    for axis, points in about["axes"].items():
        own = [one for one in results if one.condition[0] == axis]
        if axis != NOMINAL and len(points) > 1 and axis_numbers(points) and own:
            found[axis] = own
    return found


def contacts(about: SweepFacts, episodes: SweptEpisodes) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Group -> EPISODE without any change, and under all changes in the same scene, no simulation twice.

    What is the same simulation depends on the group: one that sees no events is not changed by sensor faults.
    """
    every = [place(one["condition"]) for one in about["compared"]]
    here = sorted(
        (at for at in every if _scene(about, at) == about["scene"]), key=lambda at: at[0] != NOMINAL
    )
    found = {}
    for group in about["groups"]:
        first: dict[bytes, Condition] = {}
        for at in here:
            first.setdefault(content(episodes.get((at, group), {})), at)
        usual = [at for at in first.values() if at[0] == NOMINAL]
        others = [at for at in first.values() if at[0] != NOMINAL]
        found[group] = _all_episodes(episodes, usual, group), _all_episodes(episodes, others, group)
    return found


def _scene(about: SweepFacts, condition: Sequence[str]) -> object:
    axis, value = condition
    return about["axes"][axis][value].get("env.scene", about["scene"])


def _all_episodes(episodes: SweptEpisodes, conditions: Sequence[Condition], group: str) -> np.ndarray:
    every = [own for at in conditions for own in episodes.get((at, group), {}).values()]
    return np.concatenate([np.empty(0, EPISODE), *every])


def survivals(
    about: SweepFacts, episodes: SweptEpisodes, changes: Sequence[Change]
) -> Mapping[str, Survival]:
    """Group -> its episodes with nothing changed, and under the condition in which it succeeds least.

    A group of which nothing was evaluated unchanged, as its task failed, is left out.
    """
    (value,) = about["axes"][NOMINAL]
    found = {}
    for group in dict.fromkeys(change.group for change in changes):
        if ((NOMINAL, value), group) not in episodes:
            continue
        own = (change for change in changes if change.group == group)
        worst = min(own, key=lambda one: one.success.mean()).condition
        found[group] = Survival(
            list(episodes[(NOMINAL, value), group].values()),
            condition_text(*worst),
            list(episodes[worst, group].values()),
        )
    return found
