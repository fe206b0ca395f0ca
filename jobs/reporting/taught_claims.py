"""The page of the taught policies: the paper's claims about representations, learned from by imitation.

The plan stands on the page and is left as it is; what is below it is written from the study's episodes alone.
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path

from matplotlib.figure import Figure

from jobs.analysis.tables import estimate_text, markdown_table, save_plot
from jobs.config.errors import ConfigError
from jobs.evaluation.group_stats import episode_values, success_table
from jobs.evaluation.sweep_plan import NOMINAL
from jobs.evaluation.sweep_report import SweepFacts
from jobs.reporting.breaks import SweptEpisodes
from jobs.reporting.figures import group_results, judge_claims
from jobs.reporting.learning_curves import read_trainings
from jobs.reporting.paper_claims import GAIN, UNITS, Claim, Finding
from jobs.reporting.planned_page import write_below_plan
from jobs.reporting.summary_plots import claims_plot
from jobs.reporting.sweep_data import SWEEP, TRAININGS, read_data, read_sweep, write_data
from jobs.run.templates import render

TAUGHT = "taught_claims"  # name of the experiment, and of what is published of it
TEMPLATE = Path(__file__).parent / "templates" / f"{TAUGHT}.md.j2"
HEAD = ("The paper says of", "Against", "Taught", "Difference", "p (Holm)", "Trainings needed", "By PPO")


def taught_findings(about: SweepFacts, episodes: SweptEpisodes) -> dict[Claim, Finding]:
    """What the study says of the claims between groups that it has trained; they are one family of tests."""
    found = judge_claims(about, episodes, ())
    return {claim: one for claim, one in found.items() if one.verdict != "not tested"}


def draw_taught(about: SweepFacts, episodes: SweptEpisodes) -> Figure:
    """The plot of the study: the difference of each claim."""
    return claims_plot(taught_findings(about, episodes))


def write_taught_claims(study: Path, docs: Path) -> Path:
    """Write the results below the plan, the plot and the data.

    Args:
        study: The folder that the study has left in its run folder.
        docs: Where the page is, or goes; plot and data into `images` and `data`. The findings by PPO are
            those of the sweep that is published there, if one is.

    Returns:
        The page.

    Raises:
        ConfigError: If an earlier version wrote the study, or it has groups of no claim.
        RunError: If a file of the study is damaged.
    """
    about, episodes = read_sweep(study)
    findings = taught_findings(about, episodes)
    if not findings:
        raise ConfigError(f"resume: {study} has no two groups that a claim compares; train them all")
    text = results_text(about, episodes, findings, published_findings(docs / "data"))
    figure = claims_plot(findings)
    write_data(docs / "data", TAUGHT, study, episodes)
    save_plot(docs / "images" / f"{TAUGHT}.png", figure)
    return write_below_plan(docs / f"{TAUGHT}.md", text)


def published_findings(data: Path) -> dict[Claim, Finding]:
    """What the published sweep of policies that learnt by PPO says of the claims; empty if there is none."""
    if not (data / TRAININGS).is_file():
        return {}
    return judge_claims(*read_data(data, SWEEP), read_trainings(data / TRAININGS))


def results_text(
    about: SweepFacts,
    episodes: SweptEpisodes,
    findings: Mapping[Claim, Finding],
    by_ppo: Mapping[Claim, Finding],
) -> str:
    """What stands below the plan."""
    conditions = [(axis, value) for axis, points in about["axes"].items() for value in points]
    head, lines = success_table(group_results(about, episodes), conditions, list(about["groups"]), {}, set())
    (scene,) = about["axes"][NOMINAL]
    each = {
        group: episode_values(episodes[(NOMINAL, scene), group], "success").mean(axis=1)
        for group in about["groups"]
    }
    return render(
        TEMPLATE,
        about=about,
        commits=", ".join(commit[:7] for commit in about["evaluated_at"]),
        groups=", ".join(f"`{group}` ({len(seeds)})" for group, seeds in about["groups"].items()),
        count=sum(len(own) for trainings in episodes.values() for own in trainings.values()),
        tests=len(findings),
        verdicts=counted(findings.values()),
        verdicts_ppo=counted(by_ppo[claim] for claim in by_ppo if claim in findings),
        claims=markdown_table(HEAD, [claim_line(at, one, by_ppo) for at, one in findings.items()], 3),
        gain=GAIN,
        each={group: ", ".join(f"{100 * rate:.0f}" for rate in rates) for group, rates in each.items()},
        success=markdown_table(head, lines, 2),
    )


def counted(findings: Iterable[Finding]) -> str:
    """How many findings have each verdict, the most frequent first."""
    verdicts = Counter(one.verdict for one in findings)
    return ", ".join(f"{count} {verdict}" for verdict, count in verdicts.most_common())


def claim_line(claim: Claim, finding: Finding, by_ppo: Mapping[Claim, Finding]) -> tuple[str, ...]:
    """One claim as a row under `HEAD`."""
    scale, form, unit = UNITS[claim.measure]
    needed = finding.needed if finding.verdict == "undecided" else None
    ppo = by_ppo.get(claim)
    return (
        f"`{claim.ours}`: {claim.text}",
        f"`{claim.theirs}`",
        finding.verdict,
        f"{estimate_text(finding.overall, scale, form)}{unit}",
        "-" if finding.adjusted_p is None else f"{finding.adjusted_p:.2g}",
        "-" if needed is None else str(needed),
        "-" if ppo is None else ppo.verdict,
    )
