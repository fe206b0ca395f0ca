"""Write docs/results.md from a flown sweep, and docs/trade.md from a trade; what a sweep says of the paper.

Run: python -m platform.launch +exp=report
Expect: seconds; docs/results.md and docs/images/results_*.png of the newest sweep, docs/trade.md and
docs/images/trade.png of the newest trade; with `resume` of what that run folder holds.
"""

import csv
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from jobs.analysis.statistics import two_stage_estimate
from jobs.analysis.tables import markdown_table
from jobs.config.config import Config, ConfigError
from jobs.evaluation.group_stats import (
    LABELS,
    Condition,
    TrainingEpisodes,
    details_table,
    episode_values,
    estimate_text,
    success_table,
    summarise_group,
)
from jobs.evaluation.sweep_plan import NOMINAL
from jobs.reporting.learning_curves import mean_success, read_curves
from jobs.reporting.paper_claims import CLAIMS, LEARNT, RULE, Claim, Finding, judge, judge_learning
from jobs.rollout.episodes import EPISODE
from jobs.rollout.policies import PRETRAINED
from jobs.run.files import write_atomic
from jobs.run.folder import COMPARED_STEPS
from jobs.run.progress import console
from jobs.run.provenance import REPOSITORY

Flown = dict[tuple[Condition, str], dict[int | None, np.ndarray]]
COLOURS = 128  # of a copied figure
PER_CENT = {"success": (100, "+.0f", " %"), "distance_m": (1, "+.1f", " m")}
TITLES = {
    "control_hz": "Control rate",
    "control_hz_dense": "Control rate among more poles",
    "contrast_threshold": "Contrast threshold",
    "sparsity": "Dead pixels",
    "background_activity": "Background activity",
    "sensor_noise": "Noise of a real sensor: none, by day, by night",
    "world": "Other worlds",
    "memory": "Memory of the pixels",
    "memory_400hz": "Memory of the pixels at 400 Hz",
    "speed": "Speed",
    "worst": "Several at once",
    "contacts": "Where flights end in contact",
}


def run(config: Config) -> dict[str, Any]:
    """Write what the newest sweep and the newest trade found, or those of the run in `resume`, into docs/.

    Raises:
        ConfigError: If there is neither.
    """
    # In this order: one shows the other's figure.
    writers: dict[str, Callable[[Path, Path], Path]] = {"trade": write_trade, "sweep": write_results}
    found = {name: find_study(config, name) for name in writers}
    if not any(found.values()):
        where = config.resume or config.runs_dir
        commands = " or ".join(f"python -m platform.launch +exp={exp}" for exp in ("robustness", "trade"))
        raise ConfigError(f"resume: no finished sweep or trade in {where!r}: run {commands}")
    for name, folder in found.items():
        if folder is not None:
            file = writers[name](folder, REPOSITORY / "docs")
            console.print(f"Written: {file.relative_to(REPOSITORY)}", markup=False)
    return {}


def find_study(config: Config, name: str) -> Path | None:
    """The folder `name` of the run folder in `resume`, else the newest of all runs; None: there is none.

    Args:
        config: The experiment.
        name: "sweep" or "trade".
    """
    where = Path(config.runs_dir).glob("*") if config.resume is None else [Path(config.resume)]
    found = [path for path in (run / name / "about.json" for run in where) if path.is_file()]
    newest = max(found, key=lambda path: path.stat().st_mtime_ns, default=None)
    return newest and newest.parent


def write_trade(trade: Path, docs: Path) -> Path:
    """Copy the page of a trade and its figure.

    Args:
        trade: The folder that the job has left in its run folder.
        docs: Where trade.md goes, its picture into `images`.

    Returns:
        The file.
    """
    (docs / "images").mkdir(parents=True, exist_ok=True)
    copy_small(trade / "images" / "trade.png", docs / "images" / "trade.png")
    write_atomic(docs / "trade.md", (trade / "trade.md").read_text())
    return docs / "trade.md"


def write_results(sweep: Path, docs: Path, pretrained: Path = PRETRAINED) -> Path:
    """Write results.md and copy the figures.

    Args:
        sweep: The folder that a sweep has left in its run folder.
        docs: Where results.md goes, its pictures into `images`.
        pretrained: Where the learning curves of shipped policies are.

    Returns:
        The file.
    """
    about = json.loads((sweep / "about.json").read_text())
    flown = read_flights(sweep / "episodes.csv")
    pictures = {path.stem: path for path in sorted(sweep.glob("*.png"))}
    shown = [name for name in (*about["axes"], "contacts") if name in pictures]
    (docs / "images").mkdir(parents=True, exist_ok=True)
    for name in shown:
        copy_small(pictures[name], docs / "images" / f"results_{name}.png")
    parts = [
        *opening(about),
        *breaks(about, flown),
        *claims(flown, learnt(pretrained)),
        *figures(about, shown),
        *cost(docs),
        *tables(about, flown),
        *exactness(about),
    ]
    text = "\n".join(parts)
    write_atomic(docs / "results.md", text)
    return docs / "results.md"


def copy_small(picture: Path, target: Path) -> None:
    """A figure in `COLOURS` colours, a third of the size: enough for lines and print."""
    with Image.open(picture) as whole:
        small = whole.convert("RGB").quantize(COLOURS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    small.save(target, optimize=True)


def read_flights(file: Path) -> Flown:
    """EPISODE by condition, group and training seed, from the sweep's episodes.csv."""
    rows: dict[tuple[Condition, str], dict[int | None, list[tuple[Any, ...]]]] = {}
    with file.open() as stream:
        for row in csv.DictReader(stream):
            axis, value, group, training = (row[name] for name in LABELS)
            place = rows.setdefault(((axis, value), group), {})
            place.setdefault(int(training) if training else None, []).append(_episode(row))
    return {key: {seed: np.array(own, EPISODE) for seed, own in parts.items()} for key, parts in rows.items()}


def _episode(row: Mapping[str, str]) -> tuple[Any, ...]:
    kinds: dict[str, Callable[[str], Any]] = {"b": "True".__eq__, "i": int, "f": float}
    return tuple(kinds[EPISODE[name].kind](row[name]) for name in EPISODE.names or ())


def opening(about: Mapping[str, Any]) -> list[str]:
    """What was flown, by which command, at which commit."""
    groups = ", ".join(f"{group} ({len(seeds)})" for group, seeds in about["groups"].items())
    return [
        "# Results",
        "",
        f"Made on {about['date']} by `{about['command']}`, then `python -m platform.launch +exp=report`; "
        f"run `{about['run']}`, sweep `{about['identity']}`, flown at commit {commits(about)}. Films of "
        "typical contacts, at most two of each group, are in the sweep's run in MLflow, under "
        "`sweep/crashes`.",
        "",
        f"Groups, with their number of trainings: {groups}. Each training flies the same {about['trials']} "
        f"held-out corridors of `{about['scene']}` under each condition; actions are {about['action']}. "
        "Intervals are 95 %. Those of distances and differences come from a two-stage bootstrap (trainings, "
        "then corridors); those of success also hold Wilson's interval of all flights. With few trainings "
        "they are rather too narrow. The middle half is the interquartile mean.",
        "",
    ]


def commits(about: Mapping[str, Any]) -> str:
    """Where the code stood that flew, shortened as git does."""
    return ", ".join(commit[:7] for commit in about["evaluated_at"])


def breaks(about: Mapping[str, Any], flown: Flown) -> list[str]:
    """What takes success from each trained group, against itself where nothing is changed."""
    (usual,) = [(NOMINAL, value) for value in about["axes"][NOMINAL]]
    lines = []
    for group in about["groups"]:
        own = flown.get((usual, group), {None: np.empty(0, EPISODE)})
        if None in own:  # a bound, or not flown
            continue
        before = episode_values(own, "success")
        lost = {}
        for (condition, other), trainings in flown.items():
            if other == group and condition != usual and trainings.keys() == own.keys():
                change = episode_values(trainings, "success") - before
                found = two_stage_estimate(change, np.random.default_rng(0))
                if found.interval is not None and found.interval[1] < 0:
                    lost[condition] = found
        worst = sorted(lost, key=lambda condition: lost[condition].value)
        texts = [f"{axis} {value}: {estimate_text(lost[axis, value], 100, '+.0f')}" for axis, value in worst]
        lines.append((f"`{group}`", f"{100 * before.mean():.0f}", "; ".join(texts) or "none is certain"))
    note = (
        "Conditions under which a group succeeds less often than the same trainings on the same corridors "
        "with nothing changed, by a difference whose 95 % interval lies below 0, in points, worst first. "
        "What is missing here may break a policy too: few flights show only large losses. Of all these "
        "tests one in forty would say so by chance."
    )
    head = ("Group", "Nothing changed [%]", "Breaks under")
    return ["## What breaks each policy", "", note, "", markdown_table(head, lines, len(head)), ""]


def cost(docs: Path) -> list[str]:
    """The figure of the trade, where one was made."""
    if not (docs / "images" / "trade.png").is_file():
        return []
    title = "Success against cost"
    made = "(`python -m platform.launch +exp=trade`; every setting, run and commit: [trade.md](trade.md))"
    return [f"## {title}", "", f"![{title}](images/trade.png)", "", made, ""]


def learnt(pretrained: Path) -> dict[str, list[float]]:
    """Group -> success averaged over the compared steps, of each shipped training that took so many."""
    found: dict[str, list[float]] = {}
    for curve in read_curves(pretrained).values():
        if curve.env_steps[-1] >= COMPARED_STEPS:
            found.setdefault(curve.exp, []).append(mean_success(curve, COMPARED_STEPS))
    return found


def claims(flown: Flown, trainings: Mapping[str, Sequence[float]]) -> list[str]:
    """The paper's claims with our findings."""

    def find(condition: Condition, group: str) -> TrainingEpisodes:
        return flown.get((condition, group), {})

    lines = [_claim_line(claim, judge(claim, find)) for claim in CLAIMS]
    lines += [_claim_line(claim, judge_learning(claim, trainings)) for claim in LEARNT]
    head = ("The paper says of", "Source", "Against", "Finding", "Difference, all conditions", "By condition")
    return ["## The paper's claims", "", RULE, "", markdown_table(head, lines, len(head))]


def _claim_line(claim: Claim, finding: Finding) -> tuple[str, ...]:
    scale, form, unit = PER_CENT[claim.measure]
    each = [
        f"{axis} {value}: {estimate_text(found, scale, form)}"
        for (axis, value), found in finding.conditions.items()
    ]
    overall = (
        f"{estimate_text(finding.overall, scale, form)}{unit}"
        if finding.overall
        else "one of them is missing"
    )
    return (
        f"`{claim.ours}`: {claim.text}",
        claim.source,
        f"`{claim.theirs}`",
        finding.verdict,
        overall,
        "; ".join(each),
    )


def tables(about: Mapping[str, Any], flown: Flown) -> list[str]:
    """Success of all groups under all conditions, and every estimate."""
    conditions = [(axis, value) for axis, points in about["axes"].items() for value in points]
    groups, reference = list(about["groups"]), about["reference"]
    rows = [
        summarise_group(
            at, group, flown[at, group], flown.get((at, reference)) if group != reference else None
        )
        for at in conditions
        for group in groups
        if (at, group) in flown
    ]
    head, lines = success_table(rows, conditions, groups, {})
    success = ["## Success [%]", "", markdown_table(head, lines, 2)]
    note = (
        f"Differences are taken against `{reference}` on the same corridors (success in points of per cent)."
    )
    return [*success, "## Every estimate", "", note, "", details_table(rows, reference)]


def exactness(about: Mapping[str, Any]) -> list[str]:
    """How exact the events of each condition were: asked, achieved, and what it took."""
    lines = [
        (
            *found["condition"],
            f"{100 * found['asked']:g}",
            f"{100 * found['event_error']:.1f}",
            f"{found['renders_per_step']:.0f}",
        )
        for found in about.get("exactness", [])
    ]
    note = (
        "Share of events without a partner in the converged simulation (same pixel, same polarity, within a "
        "twentieth of a control step), of a sensor without faults. The paper's cameras, `frame` and "
        "`legacy`, see one frame a step: their error is the model's."
    )
    head = ("Axis", "Value", "Event error asked [%]", "achieved [%]", "Renders a step")
    return ["## How exact", "", note, "", markdown_table(head, lines, 2)] if lines else []


def figures(about: Mapping[str, Any], names: list[str]) -> list[str]:
    """Each picture with what made it."""
    made = f"`{about['command']}`, run `{about['run']}`, commit {commits(about)}, {about['date']}"
    lines = []
    for name in names:
        title = TITLES.get(name, name)
        lines += [f"## {title}", "", f"![{title}](images/results_{name}.png)", "", f"({made})", ""]
    return lines
