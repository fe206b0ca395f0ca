"""The data of a sweep: read from its folder, and published as CSV with its plots."""

import csv
import gzip
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from core.files import replaced
from jobs.analysis.tables import write_csv
from jobs.config.errors import ConfigError
from jobs.evaluation.group_stats import LABELS, Condition, GroupResult
from jobs.evaluation.sweep_report import SweepFacts
from jobs.reporting.breaks import Change, SweptEpisodes
from jobs.rollout.episodes import EPISODE
from jobs.run.checkpoints import sha256
from jobs.run.files import RunError, read_json, write_atomic, write_json

SWEEP = "robustness"  # name of the published data of the sweep that docs/results.md is about
ESTIMATES = (
    *(*LABELS[:3], "trainings", "episodes"),
    *("success_rate", "success_low", "success_high"),
    *("distance_m", "distance_low_m", "distance_high_m"),
    *("events_per_step", "dropped"),
)
CHANGES = (
    *(*LABELS[:3], "baseline_axis", "baseline_value", "trainings"),
    *("success_rate", "baseline_success_rate", "difference", "difference_low", "difference_high"),
    *("p", "certain", "broken"),
)
TRAININGS = "trainings.csv"  # of every published training, how it learnt
# Commit of a published study -> groups whose trainings in models/pretrained have been replaced since, and the
# commit that shipped those which were evaluated.
REPLACED = {
    "81ef066": {"bytestream_hold": "2991870"},  # docs/dose_response.md
}
EARLIER = (
    "[Results](results.md) were evaluated at a later commit, so that success with nothing changed is not the "
    "same."
)
# Commit of a published study -> what has changed since of what it measured.
SINCE = {
    "81ef066": "The simulator was rewritten since: event errors are of the one before.",
}


def read_sweep(sweep: Path) -> tuple[SweepFacts, SweptEpisodes]:
    """What made a sweep, and all of its episodes, from the folder that it has left in its run folder.

    Raises:
        ConfigError: If an earlier version wrote the sweep.
        RunError: If a file of the sweep is damaged.
    """
    about: SweepFacts = read_json(sweep / "about.json")
    if "met" not in about:
        raise ConfigError(f"resume: {sweep} is a sweep of an earlier version; give its command again")
    if about.get("episodes_sha256") not in (None, sha256(sweep / "episodes.csv")):
        raise RunError(f"{sweep / 'episodes.csv'}: damaged; give the command of the sweep again")
    return about, read_sweep_episodes(sweep / "episodes.csv")


def read_sweep_episodes(file: Path) -> SweptEpisodes:
    """EPISODE by condition, group and training seed, from a sweep's episodes.csv, plain or packed (.gz)."""
    rows: dict[tuple[Condition, str], dict[int | None, list[tuple[object, ...]]]] = {}
    packed = file.suffix == ".gz"
    with gzip.open(file, "rt") if packed else file.open() as stream:
        for row in csv.DictReader(stream):
            axis, value, group, training = (row[name] for name in LABELS)
            place = rows.setdefault(((axis, value), group), {})
            place.setdefault(int(training) if training else None, []).append(_episode(row))
    return {key: {seed: np.array(own, EPISODE) for seed, own in parts.items()} for key, parts in rows.items()}


def _episode(row: Mapping[str, str]) -> tuple[object, ...]:
    kinds: dict[str, Callable[[str], object]] = {"b": "True".__eq__, "i": int, "f": float}
    return tuple(kinds[EPISODE[name].kind](row[name]) for name in EPISODE.names or ())


def write_data(folder: Path, name: str, sweep: Path, episodes: SweptEpisodes) -> None:
    """Write every episode, packed, what made them, and a table of each training under each condition.

    Args:
        folder: Where `<name>_episodes.csv.gz`, `<name>_about.json` and `<name>_trainings.csv` go.
        name: Of the sweep.
        sweep: The folder that it has left.
        episodes: All of them.
    """
    folder.mkdir(parents=True, exist_ok=True)
    packed = gzip.compress((sweep / "episodes.csv").read_bytes(), mtime=0)
    write_atomic(folder / f"{name}_episodes.csv.gz", packed)
    about = read_json(sweep / "about.json")
    about.pop("host", None)  # whose name says nothing to others
    write_json(folder / f"{name}_about.json", about)
    rows = [
        (axis, value, group, "" if seed is None else seed, len(own),
         f"{own['success'].mean():.4f}", f"{own['distance_m'].mean():.2f}")
        for ((axis, value), group), trainings in episodes.items()
        for seed, own in trainings.items()
    ]  # fmt: skip
    write_csv(folder / f"{name}_trainings.csv", (*LABELS, "episodes", "success_rate", "distance_m"), rows)


def write_estimates(folder: Path, name: str, results: Sequence[GroupResult]) -> None:
    """Write what was estimated of each group under each condition into `<name>_estimates.csv`."""
    rows = [
        (
            *(*one.condition, one.group, len(one.trainings), one.episodes),
            *_numbers(one.success.value, one.success.interval, ".4f"),
            *_numbers(one.distance_m.value, one.distance_m.interval, ".2f"),
            *(f"{one.events_per_step:.1f}", one.dropped),
        )
        for one in results
    ]
    write_csv(folder / f"{name}_estimates.csv", ESTIMATES, rows)


def write_changes(folder: Path, name: str, changes: Sequence[Change]) -> None:
    """Write each change against its baseline into `<name>_changes.csv`: those that the tests are about."""
    rows = [
        (
            *(*one.condition, one.group, *one.baseline, len(one.success)),
            *(f"{one.success.mean():.4f}", f"{one.before.mean():.4f}"),
            *_numbers(one.difference.value, one.difference.interval, ".4f"),
            *(_text(one.difference.p, ".3g"), int(one.certain), int(one.broken.sum())),
        )
        for one in changes
    ]
    write_csv(folder / f"{name}_changes.csv", CHANGES, rows)


def _numbers(value: float, interval: tuple[float, float] | None, form: str) -> tuple[str, str, str]:
    """A value and the ends of its interval as text."""
    low, high = interval or (None, None)
    return _text(value, form), _text(low, form), _text(high, form)


def _text(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)


def read_data(folder: Path, name: str) -> tuple[SweepFacts, SweptEpisodes]:
    """What `write_data` has written: what made a sweep, and its episodes."""
    about: SweepFacts = read_json(folder / f"{name}_about.json")
    return about, read_sweep_episodes(folder / f"{name}_episodes.csv.gz")


def replaced_text(commit: str) -> str:
    """What a page says of an earlier study: groups of other trainings, another simulator; "" of a later one.

    Args:
        commit: Of the study that the page is about.
    """
    sentences = [
        f"`{group}` stands for trainings shipped at commit {shipped}, of an earlier recipe than those in "
        "`models/pretrained` today."
        for group, shipped in REPLACED.get(commit[:7], {}).items()
    ]
    since = SINCE.get(commit[:7], "")
    return " ".join(filter(None, (*sentences, EARLIER if sentences else "", since)))


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
