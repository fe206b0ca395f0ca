"""The paper's own recipe beside ours, and the paper's claims on it.

The study `+exp=ppo_paper` trains by both; docs/ppo_paper.md has its plan.
"""

from collections.abc import Mapping
from pathlib import Path

from jobs.analysis.tables import markdown_table
from jobs.evaluation.sweep_report import SweepFacts
from jobs.reporting import two_groups
from jobs.reporting.breaks import SweptEpisodes
from jobs.reporting.claims_study import (
    BY_PPO,
    HEAD,
    SHORT,
    claim_line,
    counted,
    read_findings,
    study_findings,
)
from jobs.reporting.paper_claims import Claim, Finding
from jobs.tools.curves import PublishedTraining, published_trainings

PAPER = "ppo_paper"  # name of the experiment, and of what is published of it
RECIPES = two_groups.Groups("bytestream_paper", "bytestream")
PICTURES = "event_image"  # what the claims compare with


def recipe_findings(data: Path, about: SweepFacts, episodes: SweptEpisodes) -> dict[Claim, Finding]:
    """What the study says of the paper's claims on the paper's recipe; they are one family of tests.

    Args:
        data: Where learning curves are; without them the claim about learning is not tested.
        about: What made the study.
        episodes: All of them.
    """
    name = {RECIPES.tried: RECIPES.usual, PICTURES: PICTURES}  # as the claims call them
    renamed: SweptEpisodes = {
        (at, name[group]): own for (at, group), own in episodes.items() if group in name
    }
    return study_findings(about, renamed, _trainings(data))


def _trainings(data: Path) -> list[PublishedTraining]:
    """How the trainings learnt that the claims compare, by the names of the claims."""
    name = {f"{PAPER}_{RECIPES.tried}": RECIPES.usual, f"{BY_PPO}_{PICTURES}": PICTURES}
    every = published_trainings(data / f"{BY_PPO}_policies")
    return [one._replace(group=name[one.group]) for one in every if one.group in name]


def results_text(about: SweepFacts, episodes: SweptEpisodes, data: Path) -> str:
    """What the results say, as Markdown: the test of the recipes, and the claims.

    Args:
        about: What made the study.
        episodes: All of them.
        data: Where learning curves are, and what our recipe says of the claims.
    """
    recipes = two_groups.results_text(RECIPES, about, episodes)
    claims = claims_text(recipe_findings(data, about, episodes), read_findings(data, BY_PPO))
    return f"{recipes}\n\n### The paper's claims on its recipe\n\n{claims}"


def claims_text(findings: Mapping[Claim, Finding], ours: Mapping[Claim, Finding]) -> str:
    """What is found of the claims on the paper's recipe, beside what is on ours, as Markdown."""
    rows = [
        claim_line(claim._replace(ours=RECIPES.tried), one, ours.get(claim))
        for claim, one in findings.items()
    ]
    same = counted(ours[claim] for claim in findings if claim in ours)
    our_recipe = f"{BY_PPO}.md#results"
    parts = (
        f"Of {len(findings)} claims: {counted(findings.values())}. "
        f"The same claims on [our recipe]({our_recipe}): {same}.",
        markdown_table((*HEAD, SHORT[BY_PPO]), rows, 3).rstrip("\n"),
        f"The verdicts mean what they do [there]({our_recipe}). *By PPO*: the verdict on our recipe.",
    )
    return "\n\n".join(parts)
