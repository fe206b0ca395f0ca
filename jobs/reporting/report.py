"""Copy finished studies into docs/ of this folder: results.md, trade.md, replay.html.

Run: python -m platform.launch +exp=report
Expect: seconds; docs/results.md and docs/images/results_*.png of the newest sweep, docs/trade.md and
docs/images/trade.png of the newest trade, docs/replay.html of the newest replay page; with `resume` of what
that run folder holds.
"""

import csv
import gzip
import io
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from jobs.analysis.coverage import coverage_text
from jobs.analysis.tables import estimate_text, markdown_table, save_plot
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
from jobs.reporting.breaks import Change, SweptEpisodes, changes_of, place
from jobs.reporting.learning_curves import mean_success, read_curves
from jobs.reporting.paper_claims import GAIN, Claim, Finding, judge_all
from jobs.reporting.replay_page import PAGE
from jobs.reporting.summary_plots import change_map, claims_plot
from jobs.rollout.episodes import EPISODE
from jobs.rollout.policies import PRETRAINED
from jobs.run.checkpoints import sha256
from jobs.run.files import RunError, read_json, replaced, write_atomic
from jobs.run.folder import COMPARED_STEPS
from jobs.run.progress import console
from jobs.run.templates import render

TEMPLATES = Path(__file__).parent / "templates"
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
    copy_plot(trade / "images" / "trade.png", docs / "images" / "trade.png")
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
    if "compared" not in about:
        raise ConfigError(f"resume: {sweep} is a sweep of an earlier version; give its command again")
    plots = [name for name in (*about["axes"], "contacts") if (sweep / f"{name}.png").is_file()]
    (docs / "images").mkdir(parents=True, exist_ok=True)
    for name in plots:
        copy_plot(sweep / f"{name}.png", docs / "images" / f"results_{name}.png")
    if about.get("episodes_sha256") not in (None, sha256(sweep / "episodes.csv")):
        raise RunError(f"{sweep / 'episodes.csv'}: damaged; give the command of the sweep again")
    episodes = read_sweep_episodes(sweep / "episodes.csv")
    write_data(docs / "data", sweep, episodes)
    values = page_values(about, episodes, docs, pretrained)
    shown = [(name, TITLES.get(name, name)) for name in plots]
    for name in ("results", "results_tables"):
        write_atomic(docs / f"{name}.md", render(TEMPLATES / f"{name}.md.j2", plots=shown, **values))
    return docs / "results.md"


def page_values(
    about: SweepFacts, episodes: SweptEpisodes, docs: Path, pretrained: Path
) -> dict[str, object]:
    """What the templates name, after the map and the plot of the claims have been drawn."""
    changes = changes_of(about, episodes)
    baselines = {place(one["condition"]): place(one["baseline"]) for one in about["compared"]}
    findings = judge_all(
        lambda condition, group: episodes.get((condition, group), {}), baselines, learning_success(pretrained)
    )
    labels = {at: condition_text(*at) for at in baselines}
    save_plot(docs / "images" / "results_map.png", change_map(changes, list(about["groups"]), labels))
    save_plot(docs / "images" / "results_claims.png", claims_plot(findings))
    success, every = estimate_tables(about, episodes)
    most = max(map(len, about["groups"].values()))
    return {
        "about": about,
        "commits": ", ".join(commit[:7] for commit in about["evaluated_at"]),
        "groups": ", ".join(f"{group} ({len(seeds)})" for group, seeds in about["groups"].items()),
        "short": in_short(about, episodes, changes, findings),
        "breaks": breaks_table(about, changes),
        "tests": len(changes),
        "claims": claims_table(findings),
        "family": sum(one.adjusted_p is not None for one in findings.values()),
        "gain": GAIN,
        "compared_steps": COMPARED_STEPS,
        "most": most,
        "coverage": coverage_text(most, about["trials"]),
        "shared": shared_encoders(about, pretrained),
        "trade": (docs / "trade.md").is_file(),
        "success": success,
        "details": every,
        "exactness": exactness_table(about.get("exactness", [])),
    }


def condition_text(axis: str, value: str) -> str:
    """A condition in words."""
    return f"{TITLES.get(axis, axis)}: {value}"


def write_data(folder: Path, sweep: Path, episodes: SweptEpisodes) -> None:
    """Write every episode, packed, and a table of each training under each condition."""
    folder.mkdir(parents=True, exist_ok=True)
    packed = gzip.compress((sweep / "episodes.csv").read_bytes(), mtime=0)
    write_atomic(folder / "robustness_episodes.csv.gz", packed)
    rows = [
        (axis, value, group, "" if seed is None else seed, len(own),
         f"{own['success'].mean():.4f}", f"{own['distance_m'].mean():.2f}")
        for ((axis, value), group), trainings in episodes.items()
        for seed, own in trainings.items()
    ]  # fmt: skip
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerows([(*LABELS, "episodes", "success_rate", "distance_m"), *rows])
    write_atomic(folder / "robustness_trainings.csv", text.getvalue())


def in_short(
    about: SweepFacts,
    episodes: SweptEpisodes,
    changes: Sequence[Change],
    findings: Mapping[Claim, Finding],
) -> list[str]:
    """What a reader wants to know first: which policy to take, what breaks most, what the paper had right."""
    (nominal,) = [(NOMINAL, value) for value in about["axes"][NOMINAL]]
    trained = [group for group in about["groups"] if any(change.group == group for change in changes)]
    mean = {
        group: np.mean([change.success.mean() for change in changes if change.group == group])
        for group in trained
    }
    least = {
        group: min(
            (change for change in changes if change.group == group), key=lambda one: one.success.mean()
        )
        for group in trained
    }
    sentences = []
    if trained:
        best = max(mean, key=lambda group: mean[group])
        at, worst_of_best = condition_text(*least[best].condition), 100 * least[best].success.mean()
        unchanged = 100 * episode_values(episodes[nominal, best], "success").mean()
        sentences.append(
            f"Take `{best}`: {unchanged:.0f} % with nothing changed, {100 * mean[best]:.0f} % as the mean "
            f'of all conditions, least in "{at}" with {worst_of_best:.0f} %.'
        )
    losses = [change for change in changes if change.certain and change.difference.value < 0]
    breakers = Counter(change.condition for change in losses)
    worst = [
        f'"{condition_text(*at)}" ({count} of {len(trained)} groups)' for at, count in breakers.most_common(3)
    ]
    sentences.append(f"What breaks most groups for certain: {', '.join(worst) or 'nothing'}.")
    verdicts = Counter(one.verdict for one in findings.values())
    counted = ", ".join(f"{count} {verdict}" for verdict, count in verdicts.most_common())
    return [*sentences, f"Of the paper's {len(findings)} claims: {counted}."]


def shared_encoders(about: SweepFacts, pretrained: Path) -> str:
    """Names of the published trainings that share an encoder; "" if none do."""
    names: dict[str, list[str]] = {}
    for group, seeds in about["groups"].items():
        for seed in seeds:
            file = pretrained / f"{group}-s{seed}" / "encoder.safetensors"
            if file.is_file():
                names.setdefault(sha256(file), []).append(f"{group} s{seed}")
    return "; ".join(" and ".join(same) for same in names.values() if len(same) > 1)


def copy_plot(picture: Path, target: Path) -> None:
    """Copy a plot, packed as small as it can be without changing a colour.

    Raises:
        RunError: The plot is damaged.
    """
    try:
        with Image.open(picture) as whole:
            colours = whole.convert("RGB")
    except (OSError, SyntaxError, ValueError) as error:
        raise RunError(f"{picture}: damaged ({error}); give the command that drew it again") from None
    with replaced(target) as part:
        colours.save(part, "png", optimize=True)


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


def breaks_table(about: SweepFacts, changes: Sequence[Change]) -> str:
    """The conditions that certainly take success from each trained group."""
    (nominal,) = about["axes"][NOMINAL]
    lines = []
    for group, seeds in about["groups"].items():
        own = [change for change in changes if change.group == group]
        lost = sorted(
            (change for change in own if change.certain and change.difference.value < 0),
            key=lambda change: change.difference.value,
        )
        texts = [
            f"{' '.join(change.condition)}: {estimate_text(change.difference, 100, '+.0f')}"
            for change in lost
        ]
        if own:
            before = next((one.before for one in own if one.baseline == (NOMINAL, nominal)), own[0].before)
            name = f"`{group}`" + (" (1 training)" if len(seeds) == 1 else "")
            lines.append((name, f"{100 * before.mean():.0f}", "; ".join(texts) or "none is certain"))
    head = ("Group", "Nothing changed [%]", "Breaks under")
    return markdown_table(head, lines, len(head))


def learning_success(pretrained: Path) -> dict[str, list[float]]:
    """Group -> success averaged over the compared steps, of each published training that took so many."""
    found: dict[str, list[float]] = {}
    for curve in read_curves(pretrained).values():
        if curve.env_steps[-1] >= COMPARED_STEPS:
            found.setdefault(curve.exp, []).append(mean_success(curve, COMPARED_STEPS))
    return found


def claims_table(findings: Mapping[Claim, Finding]) -> str:
    """The paper's claims with our findings."""
    lines = [_claim_line(claim, one) for claim, one in findings.items()]
    head = ("The paper says of", "Source", "Against", "Finding", "Difference", "p (Holm)", "Trainings needed")
    return markdown_table(head, lines, 4)


def _claim_line(claim: Claim, finding: Finding) -> tuple[str, ...]:
    scale, form, unit = UNITS[claim.measure]
    overall = f"{estimate_text(finding.overall, scale, form)}{unit}"
    undecided = finding.verdict == "undecided" and finding.needed is not None
    return (
        f"`{claim.ours}`: {claim.text}",
        claim.source,
        f"`{claim.theirs}`",
        finding.verdict,
        overall if finding.overall else "one of them is missing",
        "-" if finding.adjusted_p is None else f"{finding.adjusted_p:.2g}",
        str(finding.needed) if undecided else "-",
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
