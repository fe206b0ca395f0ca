"""Make the result pages and their figures again from docs/data alone: no run folder and no store is needed.

Run from the repository root: python -m docs.from_data [FOLDER]
Writes results.md, results_tables.md, the table of robustness.md, what stands below the plan of each planned
study, and each figure whose data are there, as `+exp=report` and the studies' commands do, into FOLDER and
FOLDER/images; by default docs. docs/data.md explains the data.
"""

import csv
import sys
from collections.abc import Callable, Collection, Mapping
from functools import partial
from pathlib import Path

from matplotlib.figure import Figure

from benchmarks.scaling_model import from_plain, plot_scaling
from jobs.evaluation.group_stats import TrainingEpisodes, episode_values
from jobs.measure.encoding_plots import plot_encoding_costs
from jobs.measure.encodings import read_costs
from jobs.measure.trade_page import draw_settings
from jobs.reporting.breaks import changes_of
from jobs.reporting.claims_study import BY_PPO, TAUGHT, draw_study
from jobs.reporting.claims_study import published_text as claims_text
from jobs.reporting.dose_response import DOSES, draw, read_doses
from jobs.reporting.dose_response import published_text as dose_response_text
from jobs.reporting.dose_taught import DOSES_TAUGHT, draw_published
from jobs.reporting.dose_taught import published_text as dose_taught_text
from jobs.reporting.figures import group_results, results_figures
from jobs.reporting.planned_page import below_plan
from jobs.reporting.report import results_pages, write_figures
from jobs.reporting.sweep_data import (
    SWEEP,
    TRAININGS,
    read_data,
    read_sweep_episodes,
    write_changes,
    write_estimates,
)
from jobs.reporting.training_studies import STUDIES as TRAINING_STUDIES
from jobs.reporting.training_studies import draw_study as draw_training_study
from jobs.reporting.training_studies import published_text as study_text
from jobs.reporting.words import condition_text
from jobs.rollout.policies import PRETRAINED
from jobs.run.files import read_json, write_atomic
from jobs.studies.ablation.page import VariantResult, plot_variants, variant_result
from jobs.tools.curves import read_trainings

DOCS = Path(__file__).resolve().parent
ABLATIONS = "ablation", "ablation_more", "taught", "memory_seconds"  # each with a recipe of its own
ENCODER_COSTS = "encoder_costs.csv"  # as `+exp=trade_encoder` writes trade/inference.csv
# Of an ablation whose variants are not all compared with the first: variant -> the one it is compared with.
PAIRS = {"memory_seconds": {"taught_seconds": "taught_stack", "ppo_seconds": "ppo_stack"}}


def results(data: Path) -> dict[str, Figure]:
    """Those of results.md and results_tables.md."""
    return results_figures(*read_data(data, SWEEP), read_trainings(data / TRAININGS))


def dose_response(data: Path) -> dict[str, Figure]:
    """That of dose_response.md."""
    return {
        DOSES: draw(read_doses(data / f"{DOSES}_doses.csv"), changes_of(*read_data(data, DOSES), every=True))
    }


def dose_taught(data: Path) -> dict[str, Figure]:
    """That of dose_response_taught.md."""
    return {DOSES_TAUGHT: draw_published(data)}


def taught_claims(data: Path) -> dict[str, Figure]:
    """That of taught_claims.md."""
    return {TAUGHT: draw_study(data, TAUGHT)}


def ppo_claims(data: Path) -> dict[str, Figure]:
    """That of ppo_claims.md."""
    return {BY_PPO: draw_study(data, BY_PPO)}


def training_studies(data: Path, name: str) -> dict[str, Figure]:
    """That of another planned study of trainings."""
    return {name: draw_training_study(data, name)}


def ablation(data: Path) -> dict[str, Figure]:
    """Those of ablation.md and policies.md; others are compared with the first variant of each."""
    every = {name: data / f"{name}_episodes.csv.gz" for name in ABLATIONS}
    return {name: plot_variants(variant_results(own, PAIRS.get(name))) for name, own in every.items()}


def variant_results(episodes: Path, pairs: Mapping[str, str] | None = None) -> list[VariantResult]:
    """Success of each variant of one ablation, and what it changes; the minutes are not known.

    Args:
        episodes: Of the ablation.
        pairs: Variant -> the one that it is compared with, by pairs of seeds; None: all with the first.
    """
    found: dict[str, dict[str, TrainingEpisodes]] = {}
    for ((axis, value), name), trainings in read_sweep_episodes(episodes).items():
        found.setdefault(name, {})[condition_text(axis, value)] = trainings
    first, *others = found
    rivals = dict.fromkeys(others, first) if pairs is None else pairs
    results = []
    for name, conditions in found.items():
        own = {at: episode_values(trainings, "success") for at, trainings in conditions.items()}
        theirs = None
        if rival := found.get(rivals.get(name, "")):
            same = {at: {seed: rival[at][seed] for seed in one} for at, one in conditions.items()}
            theirs = {at: episode_values(trainings, "success") for at, trainings in same.items()}
        results.append(variant_result(name, own, theirs, ()))
    return results


def trade(data: Path) -> dict[str, Figure]:
    """That of trade.md."""
    with (data / "trade_settings.csv").open() as file:
        return {"trade": draw_settings(list(csv.DictReader(file)))}


def encoder_costs(data: Path) -> dict[str, Figure]:
    """The first of encoder_accuracy.md; the data are the numbers of its table."""
    return {"encoder_inference": plot_encoding_costs(read_costs(data / ENCODER_COSTS))}


def scaling(data: Path) -> dict[str, Figure]:
    """That of cluster.md."""
    return {"scaling": plot_scaling(from_plain(read_json(data / "scaling.json")))}


# What draws the figures of a study -> the files that it needs.
STUDIES: dict[Callable[[Path], Mapping[str, Figure]], tuple[str, ...]] = {
    results: (f"{SWEEP}_episodes.csv.gz", f"{SWEEP}_about.json", TRAININGS),
    dose_response: (f"{DOSES}_episodes.csv.gz", f"{DOSES}_about.json", f"{DOSES}_doses.csv"),
    dose_taught: tuple(f"{DOSES_TAUGHT}_{part}" for part in ("episodes.csv.gz", "about.json", "doses.csv")),
    taught_claims: (f"{TAUGHT}_episodes.csv.gz", f"{TAUGHT}_about.json"),
    ppo_claims: (f"{BY_PPO}_episodes.csv.gz", f"{BY_PPO}_about.json"),
    **{
        partial(training_studies, name=name): (f"{name}_episodes.csv.gz", f"{name}_about.json")
        for name in TRAINING_STUDIES
    },
    ablation: tuple(f"{name}_episodes.csv.gz" for name in ABLATIONS),
    trade: ("trade_settings.csv",),
    encoder_costs: (ENCODER_COSTS,),
    scaling: ("scaling.json",),
}


def figures(data: Path) -> Mapping[str, Figure]:
    """Name of each figure whose data are in a folder -> the figure."""
    found: dict[str, Figure] = {}
    for study, files in STUDIES.items():
        if all((data / name).is_file() for name in files):
            found |= study(data)
    return found


def pages(docs: Path, drawn: Collection[str]) -> dict[str, str]:
    """Name of each page of the results -> its text; none without their data.

    Args:
        docs: Where the data and the pages are.
        drawn: Names of the figures that there are.
    """
    data, found = docs / "data", dict[str, str]()
    names = [name for name in drawn if name.startswith("results_")]
    if names:
        found = results_pages(
            *read_data(data, SWEEP), read_trainings(data / TRAININGS), names, docs, PRETRAINED
        )
    if DOSES in drawn:
        found[f"{DOSES}.md"] = below_plan(docs / f"{DOSES}.md", dose_response_text(data))
    if DOSES_TAUGHT in drawn:
        found[f"{DOSES_TAUGHT}.md"] = below_plan(docs / f"{DOSES_TAUGHT}.md", dose_taught_text(data))
    for name in (TAUGHT, BY_PPO):
        if name in drawn:
            found[f"{name}.md"] = below_plan(docs / f"{name}.md", claims_text(data, name))
    for name in TRAINING_STUDIES:
        if name in drawn:
            found[f"{name}.md"] = below_plan(docs / f"{name}.md", study_text(data, name))
    return found


def main(docs: Path, target: Path) -> None:
    """Write pages, figures, and what is estimated from the sweep's episodes.

    Args:
        docs: Where the data and the pages are.
        target: Where pages go, figures into `images`, estimates into `data`.
    """
    drawn = figures(docs / "data")
    texts = pages(docs, drawn)
    (target / "images").mkdir(parents=True, exist_ok=True)
    write_figures(target / "images", drawn)
    for name, text in texts.items():
        write_atomic(target / name, text)
    if "results.md" in texts:
        (target / "data").mkdir(exist_ok=True)
        about, episodes = read_data(docs / "data", SWEEP)
        write_estimates(target / "data", SWEEP, group_results(about, episodes))
        write_changes(target / "data", SWEEP, changes_of(about, episodes))
    for name in (*texts, *(f"images/{name}.png" for name in drawn)):
        sys.stdout.write(f"{target / name}\n")


if __name__ == "__main__":
    main(DOCS, Path(sys.argv[1]) if len(sys.argv) > 1 else DOCS)
