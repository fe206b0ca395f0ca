"""Copy finished studies into docs/ of this folder: results.md, trade.md, replay.html.

Run: python -m platform.launch +exp=report
Expect: seconds; docs/results.md and docs/images/results_*.png of the newest sweep, docs/trade.md and
docs/images/trade.png of the newest trade, docs/replay.html of the newest replay page; with `resume` of what
that run folder holds.
"""

import csv
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from jobs.analysis.statistics import two_stage_estimate
from jobs.analysis.tables import estimate_text, markdown_table
from jobs.config.config import Config, ConfigError
from jobs.evaluation.group_stats import (
    LABELS,
    Condition,
    details_table,
    episode_values,
    success_table,
    summarise_group,
)
from jobs.evaluation.sweep_plan import NOMINAL
from jobs.evaluation.sweep_report import Exactness, SweepFacts
from jobs.reporting.learning_curves import mean_success, read_curves
from jobs.reporting.paper_claims import CLAIMS, GAIN, LEARNT, Claim, Finding, judge, judge_learning
from jobs.reporting.replay_page import PAGE
from jobs.rollout.episodes import EPISODE
from jobs.rollout.policies import PRETRAINED
from jobs.run.checkpoints import sha256
from jobs.run.files import RunError, read_json, replaced, write_atomic
from jobs.run.folder import COMPARED_STEPS
from jobs.run.progress import console
from jobs.run.templates import render

TEMPLATE = Path(__file__).parent / "templates" / "results.md.j2"
MAX_COLOURS = 128  # of a copied plot
UNITS = {"success": (100, "+.0f", " %"), "distance_m": (1, "+.1f", " m")}
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
    "contacts": "Where episodes end in contact",
}
SweptEpisodes = dict[
    tuple[Condition, str], dict[int | None, np.ndarray]
]  # of each group under each condition


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
    """The folder `name` in the run folder `resume`, else the newest of all run folders; None: there is none.

    Args:
        config: The experiment.
        name: "sweep", "trade" or "replay".
    """
    where = Path(config.runs_dir).glob("*") if config.resume is None else [Path(config.resume)]
    found = [path for path in (run / name / "about.json" for run in where) if path.is_file()]
    newest = max(found, key=lambda path: path.stat().st_mtime_ns, default=None)
    return newest and newest.parent


def write_trade(trade: Path, docs: Path) -> Path:
    """Copy the page of a trade and its plot.

    Args:
        trade: The folder that the job has left in its run folder.
        docs: Where trade.md goes, its plot into `images`.

    Returns:
        The file.
    """
    (docs / "images").mkdir(parents=True, exist_ok=True)
    copy_small(trade / "images" / "trade.png", docs / "images" / "trade.png")
    write_atomic(docs / "trade.md", (trade / "trade.md").read_text())
    return docs / "trade.md"


def write_replay(replay: Path, docs: Path) -> Path:
    """Copy a replay page from the folder that the job has left in its run folder; return the file."""
    write_atomic(docs / PAGE, (replay / PAGE).read_bytes())
    return docs / PAGE


def write_results(sweep: Path, docs: Path, pretrained: Path = PRETRAINED) -> Path:
    """Write results.md and copy the plots.

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
    about: SweepFacts = read_json(sweep / "about.json")
    if "evaluated_at" not in about:
        raise ConfigError(f"resume: {sweep} is a sweep of an earlier version; give its command again")
    plots = [name for name in (*about["axes"], "contacts") if (sweep / f"{name}.png").is_file()]
    (docs / "images").mkdir(parents=True, exist_ok=True)
    for name in plots:
        copy_small(sweep / f"{name}.png", docs / "images" / f"results_{name}.png")
    if about.get("episodes_sha256") not in (None, sha256(sweep / "episodes.csv")):
        raise RunError(f"{sweep / 'episodes.csv'}: damaged; give the command of the sweep again")
    episodes = read_sweep_episodes(sweep / "episodes.csv")
    success, every = estimate_tables(about, episodes)
    text = render(
        TEMPLATE,
        about=about,
        commits=", ".join(commit[:7] for commit in about["evaluated_at"]),
        groups=", ".join(f"{group} ({len(seeds)})" for group, seeds in about["groups"].items()),
        breaks=breaks_table(about, episodes),
        claims=claims_table(episodes, learning_success(pretrained)),
        gain=GAIN,
        compared_steps=COMPARED_STEPS,
        plots=[(name, TITLES.get(name, name)) for name in plots],
        trade=(docs / "images" / "trade.png").is_file(),
        success=success,
        details=every,
        exactness=exactness_table(about.get("exactness", [])),
    )
    write_atomic(docs / "results.md", text)
    return docs / "results.md"


def copy_small(picture: Path, target: Path) -> None:
    """Copy a plot in `MAX_COLOURS` colours, at a third of the size: enough for lines and print."""
    try:
        with Image.open(picture) as whole:
            colours = Image.Quantize.MAXCOVERAGE
            small = whole.convert("RGB").quantize(MAX_COLOURS, colours, dither=Image.Dither.NONE)
    except (OSError, SyntaxError, ValueError) as error:
        raise RunError(f"{picture}: damaged ({error}); give the command that drew it again") from None
    with replaced(target) as part:
        small.save(part, "png", optimize=True)


def read_sweep_episodes(file: Path) -> SweptEpisodes:
    """EPISODE by condition, group and training seed, from the sweep's episodes.csv."""
    rows: dict[tuple[Condition, str], dict[int | None, list[tuple[object, ...]]]] = {}
    with file.open() as stream:
        for row in csv.DictReader(stream):
            axis, value, group, training = (row[name] for name in LABELS)
            place = rows.setdefault(((axis, value), group), {})
            place.setdefault(int(training) if training else None, []).append(_episode(row))
    return {key: {seed: np.array(own, EPISODE) for seed, own in parts.items()} for key, parts in rows.items()}


def _episode(row: Mapping[str, str]) -> tuple[object, ...]:
    kinds: dict[str, Callable[[str], object]] = {"b": "True".__eq__, "i": int, "f": float}
    return tuple(kinds[EPISODE[name].kind](row[name]) for name in EPISODE.names or ())


def breaks_table(about: SweepFacts, episodes: SweptEpisodes) -> str:
    """The conditions that take success from each trained group, against itself with nothing changed."""
    (nominal,) = [(NOMINAL, value) for value in about["axes"][NOMINAL]]
    lines = []
    for group in about["groups"]:
        own = episodes.get((nominal, group), {None: np.empty(0, EPISODE)})
        if None in own:  # a baseline, or not evaluated
            continue
        before = episode_values(own, "success")
        lost = {}
        for (condition, other), trainings in episodes.items():
            if other == group and condition != nominal and trainings.keys() == own.keys():
                change = episode_values(trainings, "success") - before
                found = two_stage_estimate(change, np.random.default_rng(0))
                if found.interval is not None and found.interval[1] < 0:
                    lost[condition] = found
        worst = sorted(lost, key=lambda condition: lost[condition].value)
        texts = [f"{axis} {value}: {estimate_text(lost[axis, value], 100, '+.0f')}" for axis, value in worst]
        lines.append((f"`{group}`", f"{100 * before.mean():.0f}", "; ".join(texts) or "none is certain"))
    head = ("Group", "Nothing changed [%]", "Breaks under")
    return markdown_table(head, lines, len(head))


def learning_success(pretrained: Path) -> dict[str, list[float]]:
    """Group -> success averaged over the compared steps, of each published training that took so many."""
    found: dict[str, list[float]] = {}
    for curve in read_curves(pretrained).values():
        if curve.env_steps[-1] >= COMPARED_STEPS:
            found.setdefault(curve.exp, []).append(mean_success(curve, COMPARED_STEPS))
    return found


def claims_table(episodes: SweptEpisodes, trainings: Mapping[str, Sequence[float]]) -> str:
    """The paper's claims with our findings."""
    lines = [
        _claim_line(claim, judge(claim, lambda condition, group: episodes.get((condition, group), {})))
        for claim in CLAIMS
    ]
    lines += [_claim_line(claim, judge_learning(claim, trainings)) for claim in LEARNT]
    head = ("The paper says of", "Source", "Against", "Finding", "Difference, all conditions", "By condition")
    return markdown_table(head, lines, len(head))


def _claim_line(claim: Claim, finding: Finding) -> tuple[str, ...]:
    scale, form, unit = UNITS[claim.measure]
    overall = f"{estimate_text(finding.overall, scale, form)}{unit}"
    each = [
        f"{axis} {value}: {estimate_text(found, scale, form)}"
        for (axis, value), found in finding.conditions.items()
    ]
    return (
        f"`{claim.ours}`: {claim.text}",
        claim.source,
        f"`{claim.theirs}`",
        finding.verdict,
        overall if finding.overall else "one of them is missing",
        "; ".join(each),
    )


def estimate_tables(about: SweepFacts, episodes: SweptEpisodes) -> tuple[str, str]:
    """Success of all groups under all conditions, and every estimate."""
    conditions = [(axis, value) for axis, points in about["axes"].items() for value in points]
    groups, reference = list(about["groups"]), about["reference"]
    rows = [
        summarise_group(
            at, group, episodes[at, group], episodes.get((at, reference)) if group != reference else None
        )
        for at in conditions
        for group in groups
        if (at, group) in episodes
    ]
    head, lines = success_table(rows, conditions, groups, {})
    return markdown_table(head, lines, 2), details_table(rows, reference)


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
