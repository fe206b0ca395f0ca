"""List the shipped policies: training, size and success rate of each.

Run: evade models
Expect: tables in seconds; docs/models.md has the same, written by python -m docs.tables.
"""

import itertools
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jobs.analysis.tables import markdown_table, show_table
from jobs.config.conditions import NOMINAL
from jobs.config.config import Config
from jobs.rollout.policies import PRETRAINED
from jobs.run.files import read_json
from jobs.run.progress import console
from jobs.run.provenance import REPOSITORY
from jobs.study.changes import content
from jobs.study.results import Condition, read_cells, values_of
from jobs.study.words import condition_text

DATA = REPOSITORY / "docs" / "data"
MANIFEST = "policy.json"
HEAD = (
    "policy", "seeds", "method", "input", "trained in", "steps", "MB",
    "nominal [%]", "mean [%]", "worst [%]", "under",
)  # fmt: skip
WORDS = 5  # leading columns with text
INPUTS = {
    "bytestream": "latent of events (t, x, y, p)",
    "bytestream_xy": "latent of events (x, y)",
    "event_columns": "counts per column",
    "event_set": "set of 256 events",
    "event_image": "event image",
    "event_image_vae": "latent of event images",
    "rgb": "grey camera image",
}
TAUGHT = "taught_"  # prefix of the policies of the study `taught`
# File of a study -> prefix of its groups' names.
EPISODES = {"robustness": "", "taught": TAUGHT, "body_conditions": ""}
LOAD = 'load_policy(PRETRAINED / "bytestream_hold-s0")'


class Success(NamedTuple):
    """Success of a group over the conditions of one study, averaged over seeds and corridors.

    Attributes:
        nominal, mean, worst: Share of episodes that reach the goal, 0..1: in the nominal condition, averaged
            over all conditions, and in the worst one.
        condition: The worst condition.
        conditions: Number of different conditions.
    """

    nominal: float
    mean: float
    worst: float
    condition: Condition
    conditions: int


class Group(NamedTuple):
    """The shipped policies of one experiment.

    Attributes:
        name: Name of the group; a policy is called `name-sSEED`.
        kind: Name of the model.
        method: "imitation" or "PPO".
        seeds: Training seeds of its policies.
        conditions: Number of conditions that a training episode draws from; 1: no randomization.
        env_steps: Environment steps of its training.
        megabytes: Size of one policy on disk [MB].
    """

    name: str
    kind: str
    method: str
    seeds: tuple[int, ...]
    conditions: int
    env_steps: int
    megabytes: float


def run(_config: Config) -> None:
    """Print the tables of shipped policies."""
    for study in EPISODES:
        rows = model_rows(study, PRETRAINED, DATA)
        show_table(f"Shipped policies by their success in the study {study}", HEAD, rows, WORDS)
    console.print(f"from models.policy import PRETRAINED, load_policy; policy = {LOAD}", highlight=False)


def shipped_groups(folder: Path) -> list[Group]:
    """Return the groups of shipped policies in a folder, by name.

    Args:
        folder: Holds policy folders `NAME-sSEED`, each with its manifest.
    """
    found: dict[str, list[Path]] = defaultdict(list)
    for manifest in sorted(folder.glob(f"*/{MANIFEST}")):
        found[manifest.parent.name.rpartition("-s")[0]].append(manifest)
    return [_group(name, files) for name, files in found.items()]


def _group(name: str, files: Sequence[Path]) -> Group:
    about: Mapping[str, Any] = read_json(files[0])
    size = sum(file.stat().st_size for file in files[0].parent.iterdir())
    return Group(
        name,
        about["name"],
        "imitation" if "imitation" in about.get("algo", {}) else "PPO",
        tuple(int(file.parent.name.rpartition("-s")[2]) for file in files),
        len(about.get("conditions") or about["train"].get("conditions") or [{}]),
        about["train"]["env_steps"],
        size / 1e6,
    )


def success_rates(episodes: Path) -> dict[str, Success]:
    """Return the success of each group of a study; empty if the file does not exist.

    Conditions with the same episodes in every group are the same simulation and count once.

    Args:
        episodes: A file of docs/data with a row for each episode.
    """
    if not episodes.is_file():
        return {}
    bytes_at: dict[Condition, dict[str, bytes]] = defaultdict(dict)
    rates: dict[str, dict[Condition, float]] = defaultdict(dict)
    for (at, group), trainings in read_cells(episodes).items():
        bytes_at[at][group] = content(trainings)
        rates[group][at] = float(values_of(trainings, "success").mean())
    first = {tuple(own.items()): at for at, own in reversed(bytes_at.items())}
    kept = set(first.values())
    return {
        group: _success({at: rate for at, rate in own.items() if at in kept}) for group, own in rates.items()
    }


def _success(rates: Mapping[Condition, float]) -> Success:
    (nominal,) = (rate for (axis, _), rate in rates.items() if axis == NOMINAL)
    worst = min(rates, key=lambda at: rates[at])
    return Success(nominal, sum(rates.values()) / len(rates), rates[worst], worst, len(rates))


def model_rows(study: str, folder: Path, data: Path) -> list[tuple[str, ...]]:
    """Return a row of texts under `HEAD` for each group that a study evaluated, the best mean first.

    Args:
        study: A key of `EPISODES`.
        folder: Holds the policy folders.
        data: Holds the published episodes.
    """
    prefix = EPISODES[study]
    rates = success_rates(data / f"{study}_episodes.csv.gz")
    ours = [group for group in shipped_groups(folder) if group.name.startswith(TAUGHT) == bool(prefix)]
    found = [(group, rates[name]) for group in ours if (name := group.name.removeprefix(prefix)) in rates]
    return [_row(group, own) for group, own in sorted(found, key=lambda one: -one[1].mean)]


def _row(group: Group, success: Success) -> tuple[str, ...]:
    return (
        group.name,
        _ranges(group.seeds),
        group.method,
        INPUTS.get(group.kind, group.kind),
        f"poles, randomized ({group.conditions})" if group.conditions > 1 else "poles",
        f"{group.env_steps / 1e3:,.0f}k",
        f"{group.megabytes:.1f}",
        *(f"{100 * rate:.0f}" for rate in (success.nominal, success.mean, success.worst)),
        condition_text(success.condition),
    )


def _ranges(seeds: Sequence[int]) -> str:
    """Return seeds as text, consecutive ones as a range: "0-2"."""
    runs = [
        [seed for _, seed in own]
        for _, own in itertools.groupby(enumerate(seeds), lambda one: one[1] - one[0])
    ]
    return ", ".join(f"{own[0]}-{own[-1]}" if len(own) > 1 else str(own[0]) for own in runs)


def models_tables() -> dict[str, str]:
    """Return the tables of docs/models.md: name of the study -> Markdown."""
    named = {study: model_rows(study, PRETRAINED, DATA) for study in EPISODES}
    return {
        study: markdown_table(HEAD, [(f"`{name}`", *cells) for name, *cells in rows], WORDS)
        for study, rows in named.items()
    }
