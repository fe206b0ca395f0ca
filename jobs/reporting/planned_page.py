"""Pages of planned studies, and what pages of results say of how they were made.

The plan of a study stands above and is left as it is, what is below it is written anew.
"""

from collections.abc import Sequence
from pathlib import Path

from jobs.config.conditions import NOMINAL
from jobs.evaluation.sweep_report import Exactness, SweepFacts
from jobs.reporting.breaks import SweptEpisodes, content, place
from jobs.reporting.words import condition_text
from jobs.run.files import write_atomic

RESULTS = "## Results\n"  # what stands above it is the plan


def below_plan(page: Path, text: str) -> str:
    """The text of a page with results below its plan, in place of earlier ones."""
    above = page.read_text().split(RESULTS)[0] if page.is_file() else ""
    return above.rstrip("\n") + f"\n\n{RESULTS}" + text


def write_below_plan(page: Path, text: str) -> Path:
    """Write results below the plan of a page, in place of earlier ones; return the page."""
    write_atomic(page, below_plan(page, text))
    return page


def made_text(about: SweepFacts, episodes: SweptEpisodes) -> str:
    """The sentences on what made the results of a study; what several conditions share is counted once."""
    groups = ", ".join(f"`{group}` ({len(seeds)})" for group, seeds in about["groups"].items())
    different = {(group, content(trainings)): trainings for (_, group), trainings in episodes.items()}
    count = sum(len(own) for trainings in different.values() for own in trainings.values())
    return (
        f"Made on {about['date']} by `{about['command']}`, then `python -m platform.launch +exp=report`; run "
        f"`{about['run']}`, evaluated at commit {', '.join(commit[:7] for commit in about['evaluated_at'])}. "
        f"Groups, with their number of trainings: {groups}; {about['trials']} corridors, {count:,} episodes, "
        f"actions {about['action']}. {coarse_text(about.get('exactness', []))}".rstrip()
    )


def coarse_text(found: Sequence[Exactness]) -> str:
    """The conditions that were simulated more coarsely than the rest, and how exactly; "" if none was.

    Args:
        found: How exact the events of each condition were.
    """
    finest = min((one["asked"] for one in found), default=0.0)
    coarse = [one for one in found if one["asked"] > finest]
    if not coarse:
        return ""
    errors = [
        f"{condition_text(*place(one['condition']))} {100 * one['event_error']:.1f} %" for one in coarse
    ]
    usual = [one["event_error"] for one in found if place(one["condition"])[0] == NOMINAL]
    beside = f"; with nothing changed {100 * usual[0]:.1f} %" if usual else ""
    return (
        "Simulated more coarsely than the rest, by the share of events that differ from the converged "
        f"simulation: {', '.join(errors)}{beside}."
    )
