"""Pages of planned studies: the plan stands above and is left as it is, what is below it is written anew."""

from pathlib import Path

from jobs.evaluation.sweep_report import SweepFacts
from jobs.reporting.breaks import SweptEpisodes
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
    """The sentences on what made the results of a study."""
    groups = ", ".join(f"`{group}` ({len(seeds)})" for group, seeds in about["groups"].items())
    count = sum(len(own) for trainings in episodes.values() for own in trainings.values())
    return (
        f"Made on {about['date']} by `{about['command']}`, then `python -m platform.launch +exp=report`; run "
        f"`{about['run']}`, evaluated at commit {', '.join(commit[:7] for commit in about['evaluated_at'])}. "
        f"Groups, with their number of trainings: {groups}; {about['trials']} corridors, {count:,} episodes, "
        f"actions {about['action']}."
    )
