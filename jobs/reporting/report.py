"""Copy finished studies into docs/ of this folder: results.md, dose_response.md, trade.md, replay.html.

Run: python -m platform.launch +exp=report
Expect: seconds; docs/results.md and docs/images/results_*.png of the newest sweep, docs/trade.md and
docs/images/trade.png of the newest trade, docs/replay.html of the newest replay page, the results in
docs/dose_response.md, docs/dose_response_taught.md, docs/taught_claims.md, docs/ppo_claims.md,
docs/ppo_event_set.md, docs/ppo_paper.md, docs/encoder_seeds.md and docs/camera_rates.md of the newest
studies of these names; with `resume` of what that run folder holds.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from jobs.analysis.coverage import coverage_text
from jobs.analysis.tables import estimate_text, markdown_table, save_plot, write_csv
from jobs.config.conditions import NOMINAL
from jobs.config.config import Config, ConfigError
from jobs.evaluation.group_stats import success_table
from jobs.evaluation.sweep_report import Exactness, SweepFacts
from jobs.reporting.breaks import (
    Change,
    SweptEpisodes,
    changes_of,
    compared_pairs,
    drop_text,
    loses,
    place,
    replicated,
)
from jobs.reporting.claims_study import (
    BY_PPO,
    HEAD,
    SHORT,
    TAUGHT,
    WHAT,
    claim_line,
    published_studies,
    write_claims_study,
)
from jobs.reporting.dose_response import DOSES, write_dose_response
from jobs.reporting.dose_taught import DOSES_TAUGHT, write_dose_taught
from jobs.reporting.figures import group_results, judge_claims, results_figures
from jobs.reporting.headline import headline_table, with_headline
from jobs.reporting.in_short import WEAK, in_short, weak_groups
from jobs.reporting.paper_claims import CLAIMS, GAIN, Claim, Finding
from jobs.reporting.planned_page import coarse_text
from jobs.reporting.sweep_data import (
    SWEEP,
    TRAININGS,
    copy_plot,
    read_sweep,
    replaced_text,
    write_changes,
    write_data,
    write_estimates,
)
from jobs.reporting.training_studies import STUDIES, write_training_study
from jobs.reporting.words import condition_text
from jobs.rollout.policies import PRETRAINED
from jobs.run.checkpoints import sha256
from jobs.run.files import read_json, write_atomic
from jobs.run.folder import COMPARED_STEPS
from jobs.run.progress import console
from jobs.run.templates import render
from jobs.tools.curves import PublishedTraining, published_trainings
from jobs.tools.replay_page import PAGE

TEMPLATES = Path(__file__).parent / "templates"


def run(config: Config) -> dict[str, Any]:
    """Write the newest sweep, trade and replay page, or those in the run folder `resume`, into docs/.

    Raises:
        ConfigError: If there is neither.
    """
    # In this order: the page of a sweep shows the plot of the trade.
    writers: dict[str, Callable[[Path, Path], Path]] = {
        "trade": write_trade,
        "sweep": write_results,
        "replay": write_replay,
        DOSES: partial(write_dose_response, env=config.env),
        DOSES_TAUGHT: partial(write_dose_taught, env=config.env),
        BY_PPO: partial(write_claims_study, name=BY_PPO),
        TAUGHT: partial(write_claims_study, name=TAUGHT),
        **{name: partial(write_training_study, name=name) for name in STUDIES},
    }
    found = {name: find_study(config, name) for name in writers}
    if not any(found.values()):
        where = config.resume or config.runs_dir
        commands = " or ".join(f"python -m platform.launch +exp={exp}" for exp in ("robustness", "trade"))
        raise ConfigError(f"resume: no finished sweep or trade in {where!r}: run {commands}")
    for name, folder in found.items():
        if folder is not None:
            console.print(f"Written: {writers[name](folder, Path('docs'))}", markup=False)
    return {}


def find_study(config: Config, name: str) -> Path | None:
    """The folder of a study in the run folder `resume`, else the newest of all; None: there is none.

    Args:
        config: The experiment.
        name: "sweep", "trade" or "replay", as its folder is called; `DOSES` is the sweep of that experiment,
            "sweep" that of any other in the corridors of evaluation, `DOSES_TAUGHT`, `TAUGHT`, `BY_PPO` and
            `STUDIES` the ablations of these experiments.
    """
    where = Path(config.runs_dir).glob("*") if config.resume is None else [Path(config.resume)]
    ablations = dict.fromkeys((DOSES_TAUGHT, TAUGHT, BY_PPO, *STUDIES), "ablation")
    folder = {DOSES: "sweep", **ablations}.get(name, name)
    found = [path for path in (run / folder / "about.json" for run in where) if path.is_file()]
    if folder == "sweep":
        facts = {path: read_json(path) for path in found}
        found = [path for path, one in facts.items() if (one.get("exp") == DOSES) == (name == DOSES)]
    if folder == "ablation":
        found = [path for path in found if read_json(path).get("exp") == name]
    if folder in ("sweep", "ablation"):
        found = [path for path in found if read_json(path).get("split", "eval") == "eval"]
    newest = max(found, key=lambda path: path.stat().st_mtime_ns, default=None)
    return newest and newest.parent


def write_trade(trade: Path, docs: Path) -> Path:
    """Copy the page of a trade, its plot and its settings.

    Args:
        trade: The folder that the job has left in its run folder.
        docs: Where trade.md goes, its plot into `images`, its settings into `data`.

    Returns:
        The file.
    """
    (docs / "images").mkdir(parents=True, exist_ok=True)
    copy_plot(trade / "images" / "trade.png", docs / "images" / "trade.png")
    if (trade / "settings.csv").is_file():  # trades of earlier versions have none
        (docs / "data").mkdir(exist_ok=True)
        write_atomic(docs / "data" / "trade_settings.csv", (trade / "settings.csv").read_text())
    write_atomic(docs / "trade.md", (trade / "trade.md").read_text())
    return docs / "trade.md"


def write_replay(replay: Path, docs: Path) -> Path:
    """Copy a replay page from the folder that the job has left in its run folder; return the file."""
    write_atomic(docs / PAGE, (replay / PAGE).read_bytes())
    return docs / PAGE


def write_results(sweep: Path, docs: Path, pretrained: Path = PRETRAINED) -> Path:
    """Write results.md with its tables, figures and data.

    Args:
        sweep: The folder that a sweep has left in its run folder.
        docs: Where results.md goes, its plots into `images`.
        pretrained: Where the learning curves of published policies are.

    Returns:
        The file.

    Raises:
        ConfigError: If an earlier version wrote the sweep.
        RunError: If a file of the sweep is damaged.
    """
    about, episodes = read_sweep(sweep)
    trainings = published_trainings(pretrained)
    # All of it before anything is replaced: what cannot be drawn must leave data, figures and pages in step.
    figures = results_figures(about, episodes, trainings)
    pages = results_pages(about, episodes, trainings, list(figures), docs, pretrained)
    write_data(docs / "data", SWEEP, sweep, episodes)
    write_estimates(docs / "data", SWEEP, group_results(about, episodes))
    write_changes(docs / "data", SWEEP, changes_of(about, episodes))
    write_csv(docs / "data" / TRAININGS, PublishedTraining._fields, trainings)
    write_figures(docs / "images", figures)
    for name, text in pages.items():
        write_atomic(docs / name, text)
    return docs / "results.md"


def write_figures(images: Path, figures: Mapping[str, Figure]) -> None:
    """Save figures by their names, packed."""
    for name, figure in figures.items():
        picture = images / f"{name}.png"
        save_plot(picture, figure)
        copy_plot(picture, picture)


def results_pages(
    about: SweepFacts,
    episodes: SweptEpisodes,
    trainings: Sequence[PublishedTraining],
    figures: Sequence[str],
    docs: Path,
    pretrained: Path,
) -> dict[str, str]:
    """Name of each page of the results -> its text.

    Args:
        about: What made the sweep.
        episodes: All of its episodes.
        trainings: The published trainings, for the claims about learning.
        figures: Names of those of the results.
        docs: Where pages are: results.md links to trade.md, and robustness.md gets its table, if it is there.
        pretrained: Where the published policies are, of which some share an encoder.

    Raises:
        RunError: If robustness.md has no marks around its table.
    """
    values = page_values(about, episodes, trainings, docs, pretrained)
    pages = {
        f"{name}.md": render(TEMPLATES / f"{name}.md.j2", figures=figures, **values)
        for name in ("results", "results_tables")
    }
    headline = docs / "robustness.md"
    if headline.is_file():
        table = headline_table(about["groups"], episodes, met_places(about))
        pages[headline.name] = with_headline(headline, table)
    return pages


def page_values(
    about: SweepFacts,
    episodes: SweptEpisodes,
    trainings: Sequence[PublishedTraining],
    docs: Path,
    pretrained: Path,
) -> dict[str, object]:
    """What the templates name."""
    changes, findings = changes_of(about, episodes), judge_claims(about, episodes, trainings)
    studies = published_studies(docs / "data")
    sizes = sorted({len(seeds) for seeds in about["groups"].values()} - {1})
    return {
        "about": about,
        "commits": ", ".join(commit[:7] for commit in about["evaluated_at"]),
        "groups": ", ".join(f"{group} ({len(seeds)})" for group, seeds in about["groups"].items()),
        "replaced": replaced_text(about["commit"]),
        "short": in_short(about, episodes, changes, findings, studies),
        "coarse": coarse_text(about.get("exactness", [])),
        "breaks": breaks_table(about, changes),
        "tests": len(replicated(changes)),
        "claims": claims_table(findings, studies),
        "studies": [(name, SHORT[name], WHAT[name]) for name in studies],
        "family": sum(one.adjusted_p is not None for one in findings.values()),
        "gain": GAIN,
        "compared_steps": COMPARED_STEPS,
        "coverage": {size: coverage_text(size, about["trials"]) for size in sizes},
        "several": several_at_once(about),
        "values": paper_values(),
        "weak": ", ".join(
            f"`{group}` {100 * rate:.0f} %" for group, rate in weak_groups(about, episodes).items()
        ),
        "weakest": round(100 * WEAK),
        "shared": shared_encoders(about, pretrained),
        "doses": (docs / "dose_response.md").is_file(),
        "trade": (docs / "trade.md").is_file(),
        "success": estimates_table(about, episodes),
        "exactness": exactness_table(about.get("exactness", [])),
    }


def several_at_once(about: SweepFacts) -> dict[str, str]:
    """Condition in words -> its settings, of those that change several and have no words of their own."""
    found = {}
    for at, baseline in compared_pairs(about):
        settings, usual = (about["axes"][axis][value] for axis, value in (at, baseline))
        changed = [f"`{key}={value}`" for key, value in settings.items() if usual.get(key) != value]
        if len(settings) > 2 and at[0] != "sensor_noise":  # whose levels are named
            found[condition_text(*at)] = ", ".join(changed)
    return found


def paper_values() -> str:
    """The values of each axis by which the paper's claims are tested."""
    values: dict[str, list[str]] = {}
    for claim in CLAIMS:
        for axis, value in claim.conditions:
            if axis != NOMINAL and value not in values.setdefault(axis, []):
                values[axis].append(value)
    return "; ".join(f"`{axis}` {', '.join(own)}" for axis, own in values.items())


def shared_encoders(about: SweepFacts, pretrained: Path) -> str:
    """Names of the published trainings that share an encoder; "" if none do."""
    names: dict[str, list[str]] = {}
    for group, seeds in about["groups"].items():
        for seed in seeds:
            file = pretrained / f"{group}-s{seed}" / "encoder.safetensors"
            if file.is_file():
                names.setdefault(sha256(file), []).append(f"{group} s{seed}")
    return "; ".join(" and ".join(same) for same in names.values() if len(same) > 1)


def breaks_table(about: SweepFacts, changes: Sequence[Change]) -> str:
    """The conditions that take success from published trainings, of each group the worst first."""
    (nominal,) = about["axes"][NOMINAL]
    lines = []
    for group, seeds in about["groups"].items():
        own = [change for change in changes if change.group == group]
        lost = [change for change in own if change.broken.any() or (change.certain and loses(change))]
        lost.sort(key=lambda change: (-change.broken.mean(), change.difference.value))
        if own:
            before = next((one.before for one in own if one.baseline == (NOMINAL, nominal)), None)
            name = f"`{group}`" + (" (1 training)" if len(seeds) == 1 else "")
            texts = [_loss_text(change) for change in lost]
            unchanged = "-" if before is None else f"{100 * before.mean():.0f}"
            worst = min(own, key=lambda change: change.difference.value)
            largest = drop_text(worst) if loses(worst) else "-"
            lines.append((name, unchanged, largest, "; ".join(texts) or "none is certain"))
    head = ("Group", "Nothing changed [%]", "Loses most with", "Certain for some of its trainings")
    return markdown_table(head, lines, len(head))


def _loss_text(change: Change) -> str:
    """A loss with its interval, and how many trainings break; bold where it is certain for others too."""
    text = (
        f"{condition_text(*change.condition)}: {estimate_text(change.difference, 100, '+.0f')}, "
        f"{change.broken.sum()} of {len(change.broken)}"
    )
    return f"**{text}**" if change.certain else text


def claims_table(findings: Mapping[Claim, Finding], studies: Mapping[str, Mapping[Claim, Finding]]) -> str:
    """The paper's claims with our findings, and the verdicts of the studies that are published beside."""
    lines = []
    for claim, one in findings.items():
        text, *rest = claim_line(claim, one, *(own.get(claim) for own in studies.values()))
        lines.append((text, claim.source, *rest))
    first, *head = HEAD
    return markdown_table((first, "Source", *head, *(SHORT[name] for name in studies)), lines, 4)


def estimates_table(about: SweepFacts, episodes: SweptEpisodes) -> str:
    """Success of all groups under all conditions, no simulation twice."""
    conditions = [place(one["condition"]) for one in about["compared"] if one["same_as"] == one["condition"]]
    results = group_results(about, episodes)
    head, lines = success_table(results, conditions, list(about["groups"]), {}, met_places(about))
    return markdown_table(head, lines, 2)


def met_places(about: SweepFacts) -> set[tuple[str, str, str]]:
    """Axis, value and group of what lies within what the group's training drew."""
    return {(axis, value, group) for axis, value, group in about["met"]}


def exactness_table(found: Sequence[Exactness]) -> str:
    """How exact the events of each condition were: asked, achieved, and what it took; "" if none is known."""
    lines = [
        (
            *one["condition"],
            f"{100 * one['asked']:g}",
            f"{100 * one['event_error']:.1f}",
            f"{one['renders_per_step']:.1f}",
        )
        for one in found
    ]
    head = ("Axis", "Value", "Event error asked [%]", "achieved [%]", "Renders a step")
    return markdown_table(head, lines, 2) if lines else ""
