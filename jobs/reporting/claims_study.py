"""The pages of the two studies of the paper's claims: on policies that a planner teaches, and by PPO.

The plan stands on the page and is left as it is; what is below it is written from the study's episodes alone.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from jobs.analysis.tables import estimate_text, markdown_table, save_plot
from jobs.config.conditions import NOMINAL
from jobs.config.errors import ConfigError
from jobs.evaluation.group_stats import episode_values, success_table
from jobs.evaluation.sweep_report import SweepFacts
from jobs.reporting.breaks import SweptEpisodes
from jobs.reporting.figures import group_results, judge_claims
from jobs.reporting.paper_claims import GAIN, UNITS, Claim, Finding
from jobs.reporting.planned_page import made_text, write_below_plan
from jobs.reporting.summary_plots import claims_plot
from jobs.reporting.sweep_data import SWEEP, TRAININGS, read_data, read_sweep, write_data
from jobs.run.templates import render
from jobs.tools.curves import PublishedTraining, published_trainings, read_trainings

TAUGHT, BY_PPO = "taught_claims", "ppo_claims"  # names of the experiments, and of what is published of them
SHORT = {TAUGHT: "Taught", BY_PPO: "By PPO"}  # as heads of columns
WHAT = {TAUGHT: "policies that a planner taught", BY_PPO: "other policies by PPO"}  # they are of
TEMPLATE = Path(__file__).parent / "templates" / "claims_study.md.j2"
HEAD = ("The paper says of", "Against", "Finding", "Difference", "p (Holm)", "Trainings needed")


def study_findings(
    about: SweepFacts, episodes: SweptEpisodes, trainings: Sequence[PublishedTraining]
) -> dict[Claim, Finding]:
    """What a study says of the claims between groups that it has trained; they are one family of tests.

    Args:
        about: What made it.
        episodes: All of them.
        trainings: How its trainings learnt; empty: the claims about that are not tested.
    """
    found = judge_claims(about, episodes, trainings)
    return {claim: one for claim, one in found.items() if one.verdict != "not tested"}


def read_findings(data: Path, name: str) -> dict[Claim, Finding]:
    """What a published study of that name says of the claims; empty if there is none in the folder."""
    if not (data / f"{name}_about.json").is_file():
        return {}
    return study_findings(*read_data(data, name), study_trainings(data, name))


def study_trainings(data: Path, name: str) -> list[PublishedTraining]:
    """How the trainings of a study learnt, from the learning curves beside its policies; empty without.

    There a group has the study's name before its own.
    """
    every = published_trainings(data / f"{name}_policies")
    return [one._replace(group=one.group.removeprefix(f"{name}_")) for one in every]


def draw_study(data: Path, name: str) -> Figure:
    """The plot of a published study: the difference of each claim."""
    return claims_plot(read_findings(data, name))


def write_claims_study(study: Path, docs: Path, name: str) -> Path:
    """Write the results below the plan, the plot and the data.

    Args:
        study: The folder that the study has left in its run folder.
        docs: Where the page is, or goes; plot and data into `images` and `data`, where the findings of the
            other study are found, too, if it is published.
        name: `TAUGHT` or `BY_PPO`.

    Returns:
        The page.

    Raises:
        ConfigError: If an earlier version wrote the study, or it has groups of no claim.
        RunError: If a file of the study is damaged.
    """
    about, episodes = read_sweep(study)
    data = docs / "data"
    findings = study_findings(about, episodes, study_trainings(data, name))
    if not findings:
        raise ConfigError(f"resume: {study} has no two groups that a claim compares; train them all")
    text = results_text(name, about, episodes, findings, *other_findings(data, name))
    figure = claims_plot(findings)
    write_data(data, name, study, episodes)
    save_plot(docs / "images" / f"{name}.png", figure)
    return write_below_plan(docs / f"{name}.md", text)


def published_text(data: Path, name: str) -> str:
    """What stands below the plan of a published study."""
    about, episodes = read_data(data, name)
    return results_text(name, about, episodes, read_findings(data, name), *other_findings(data, name))


def other_findings(data: Path, name: str) -> tuple[str, dict[Claim, Finding]]:
    """The name of the study that another is shown beside, and what it says; empty if none is published.

    That is the study of the other way to learn; the published sweep in place of that of PPO.
    """
    other = BY_PPO if name == TAUGHT else TAUGHT
    findings = read_findings(data, other)
    if other == BY_PPO and not findings and (data / TRAININGS).is_file():
        return SWEEP, judge_claims(*read_data(data, SWEEP), read_trainings(data / TRAININGS))
    return other, findings


def results_text(
    name: str,
    about: SweepFacts,
    episodes: SweptEpisodes,
    findings: Mapping[Claim, Finding],
    other: str,
    beside: Mapping[Claim, Finding],
) -> str:
    """What stands below the plan of a study; `beside` is what the `other` says of the claims."""
    conditions = [(axis, value) for axis, points in about["axes"].items() for value in points]
    head, lines = success_table(group_results(about, episodes), conditions, list(about["groups"]), {}, set())
    (scene,) = about["axes"][NOMINAL]
    each = {
        group: episode_values(episodes[(NOMINAL, scene), group], "success").mean(axis=1)
        for group in about["groups"]
    }
    return render(
        TEMPLATE,
        name=name,
        taught=name == TAUGHT,
        other="results.md#the-papers-claims" if other == SWEEP else f"{other}.md#results",
        made=made_text(about, episodes),
        tests=len(findings),
        verdicts=counted(findings.values()),
        verdicts_other=counted(beside[claim] for claim in beside if claim in findings),
        claims=markdown_table(
            (*HEAD, SHORT[BY_PPO if name == TAUGHT else TAUGHT]),
            [claim_line(at, one, beside.get(at)) for at, one in findings.items()],
            3,
        ),
        gain=GAIN,
        each={group: ", ".join(f"{100 * rate:.0f}" for rate in rates) for group, rates in each.items()},
        success=markdown_table(head, lines, 2),
    )


def published_studies(data: Path) -> dict[str, dict[Claim, Finding]]:
    """Name of each study of the claims that is published in a folder -> what it says of them."""
    found = {name: read_findings(data, name) for name in (BY_PPO, TAUGHT)}
    return {name: findings for name, findings in found.items() if findings}


def counted(findings: Iterable[Finding]) -> str:
    """How many findings have each verdict, the most frequent first."""
    verdicts = Counter(one.verdict for one in findings)
    return ", ".join(
        f"{count} {'do not hold' if verdict == 'does not hold' and count > 1 else verdict}"
        for verdict, count in verdicts.most_common()
    )


def claim_line(claim: Claim, finding: Finding, *others: Finding | None) -> tuple[str, ...]:
    """One claim as a row under `HEAD` and the verdicts of other studies."""
    scale, form, unit = UNITS[claim.measure]
    difference = f"{estimate_text(finding.overall, scale, form)}{unit}"
    asked = finding.verdict == "undecided" and finding.adjusted_p is not None
    needed = "-" if not asked else "corridors" if finding.needed is None else str(finding.needed)
    return (
        f"`{claim.ours}`: {claim.text}",
        f"`{claim.theirs}`",
        finding.verdict,
        difference if finding.overall else "one of them is missing",
        "-" if finding.adjusted_p is None else f"{finding.adjusted_p:.2g}",
        needed,
        *("-" if other is None else other.verdict for other in others),
    )
