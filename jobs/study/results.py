"""Results of a study: provenance, and episodes by condition, group and training."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from jobs.analysis.tables import write_csv
from jobs.config.conditions import NOMINAL
from jobs.config.errors import ConfigError
from jobs.rollout.episodes import EPISODE
from jobs.rollout.table import LABELS, read_table, write_episodes
from jobs.rollout.tasks import text_of
from jobs.run.checkpoints import sha256
from jobs.run.files import RunError, read_json, write_json

Value = float | str
Condition = tuple[str, Value]  # axis and value, a number or a word
Trainings = Mapping[int | None, np.ndarray]  # training seed -> EPISODE of the same corridors
Cells = Mapping[tuple[Condition, str], Trainings]  # by condition and group
FOLDERS = ("study", "sweep", "ablation")  # in a run folder; the last two from earlier versions
RATE = (0.0, 1.0)  # bounds of a rate
# Facts that must agree before two runs are joined into one study, and the provenance of each run.
EVALUATION = ("exp", "axes", "scene", "split", "trials", "action", "reference", "budget", "env_steps")
MADE = ("run", "identity", "command", "commit", "date")


@dataclass(frozen=True)
class Results:
    """All results of a study.

    Attributes:
        facts: Provenance, the content of about.json (`jobs.study.record.facts_of`).
        cells: The episodes.
    """

    facts: Mapping[str, Any]
    cells: Cells

    @cached_property
    def axes(self) -> dict[str, dict[Value, Mapping[str, Any]]]:
        """Return axis -> value -> the settings that it changes; the first axis changes nothing."""
        return {
            axis: {value_of(text): changes for text, changes in points.items()}
            for axis, points in self.facts["axes"].items()
        }

    @cached_property
    def conditions(self) -> list[Condition]:
        """Return all conditions, axis by axis."""
        return [(axis, value) for axis, points in self.axes.items() for value in points]

    @property
    def nominal(self) -> Condition:
        """Return the condition that changes nothing."""
        return next(at for at in self.conditions if at[0] == NOMINAL)

    @property
    def groups(self) -> dict[str, list[int | None]]:
        """Return group -> its training seeds."""
        return dict(self.facts["groups"])

    @property
    def trained(self) -> list[str]:
        """Return the groups that are not baselines."""
        return [group for group, seeds in self.groups.items() if None not in seeds]

    @cached_property
    def same_as(self) -> dict[Condition, Condition]:
        """Return condition -> the first condition that is the same simulation for every group."""
        return {place(one["condition"]): place(one["same_as"]) for one in self._compared}

    def baselines(self, group: str | None = None) -> dict[Condition, Condition]:
        """Return condition -> the baseline of a group there; None: the baseline of most groups."""
        return {
            place(one["condition"]): place(one.get("own_baseline", {}).get(group or "", one["baseline"]))
            for one in self._compared
        }

    @cached_property
    def different(self) -> list[Condition]:
        """Return the first condition of each different simulation, including the nominal condition."""
        return [at for at in self.conditions if self.same_as.get(at, at) == at]

    def is_baseline(self, at: Condition, group: str) -> bool:
        """Whether a condition is the same simulation as the group's baseline there."""
        usual = self.baselines(group).get(at, at)
        return self.same_as.get(at, at) == self.same_as.get(usual, usual)

    @property
    def met(self) -> set[tuple[Condition, str]]:
        """Return the conditions within a group's training distribution, each with that group."""
        return {(place((axis, value)), group) for axis, value, group in self.facts.get("met", ())}

    def trainings(self, at: Condition, group: str) -> Trainings:
        """Return training seed -> its episodes; empty if nothing was evaluated."""
        return self.cells.get((at, group), {})

    def values(self, at: Condition, group: str) -> np.ndarray:
        """Return the success of a group's trainings under a condition, float64 (trainings, corridors)."""
        return values_of(self.cells[at, group], "success")

    @property
    def _compared(self) -> Sequence[Mapping[str, Any]]:
        usual = [NOMINAL, text_of(self.nominal[1])]
        own = [[axis, text] for axis, points in self.facts["axes"].items() for text in points]
        alone = [{"condition": at, "baseline": usual, "same_as": at} for at in own]
        return list(self.facts.get("compared", alone))


def place(names: Sequence[str]) -> Condition:
    """Return the condition of an axis and a value given as text, as files store them."""
    axis, text = names
    return axis, value_of(text)


def value_of(text: str) -> Value:
    """Parse a value: a finite number, or else the text itself."""
    try:
        number = float(text)
    except ValueError:
        return text
    return number if math.isfinite(number) else text


def values_of(trainings: Trainings, measure: str) -> np.ndarray:
    """Return a column of EPISODE as float64 (trainings, corridors).

    Raises:
        ValueError: Two trainings were evaluated in different corridors.
    """
    every = list(trainings.values())
    if any(not np.array_equal(episodes["seed"], every[0]["seed"]) for episodes in every):
        raise ValueError(
            f"trainings {list(trainings)} must have the same corridors; evaluate what is missing"
        )
    return np.stack([episodes[measure].astype(np.float64) for episodes in every])


def read_cells(file: Path) -> dict[tuple[Condition, str], dict[int | None, np.ndarray]]:
    """Read the episodes of a study, plain or packed (.gz)."""
    table, found = read_table(file), dict[tuple[Condition, str], dict[int | None, np.ndarray]]()
    for (axis, text, group, seed), rows in table.groupby(list(LABELS), sort=False, dropna=False):
        own = np.zeros(len(rows), EPISODE)
        for name in EPISODE.names or ():
            own[name] = rows[name].to_numpy()
        training = int(seed) if isinstance(seed, int | np.integer) else None
        found.setdefault(((axis, value_of(text)), group), {})[training] = own
    return found


def read_results(folder: Path) -> Results:
    """Read the results of a study from its run folder.

    Raises:
        ConfigError: An early version wrote the folder, without the facts needed for comparisons.
        RunError: A file is damaged.
    """
    facts = read_json(folder / "about.json")
    if "met" not in facts:
        raise ConfigError(f"resume: {folder} is of an earlier version; run its command again")
    file = folder / "episodes.csv"
    if facts.get("episodes_sha256") not in (None, sha256(file)):
        raise RunError(f"{file}: damaged; run the command of the study again")
    return Results(facts, read_cells(file))


def read_published(data: Path, name: str) -> Results:
    """Read a published study; without `NAME_about.json`, take groups and conditions from its episodes."""
    cells, about = read_cells(data / f"{name}_episodes.csv.gz"), data / f"{name}_about.json"
    if about.is_file():
        return Results(read_json(about), cells)
    axes: dict[str, dict[str, dict[str, object]]] = {}
    groups: dict[str, list[int | None]] = {}
    for ((axis, value), group), trainings in cells.items():
        axes.setdefault(axis, {})[text_of(value)] = {}
        groups.setdefault(group, list(trainings))
    return Results({"axes": axes, "groups": groups}, cells)


def write_cells(file: Path, cells: Cells) -> None:
    """Write the episodes of a study, plain or packed (.gz)."""
    write_episodes(file, LABELS, _labelled(cells))


def _labelled(cells: Cells) -> dict[tuple[object, ...], np.ndarray]:
    """Return axis, value, group and training, as files store them -> episodes."""
    return {
        (*texts_of(at), group, "" if seed is None else seed): own
        for (at, group), trainings in cells.items()
        for seed, own in trainings.items()
    }


def joined(earlier: Results, more: Results) -> Results:
    """Join the trainings of two runs of a study.

    Args:
        earlier: The earlier run; its groups come first.
        more: A run with other trainings in the same corridors under the same conditions.

    Raises:
        ConfigError: The runs were evaluated differently, or have a training in common.
    """
    one, other = earlier.facts, more.facts
    # Older versions recorded neither the split, which was always "eval", nor env_steps.
    usual = {"split": "eval", "env_steps": other.get("env_steps")}
    differ = [name for name in EVALUATION
              if one.get(name, usual.get(name)) != other.get(name, usual.get(name))]  # fmt: skip
    variants, more_variants = one.get("variants", {}), other.get("variants", {})
    differ += [name for name in variants if more_variants.get(name, variants[name]) != variants[name]]
    both = [f"{group} s{seed}" for group, seeds in one["groups"].items() for seed in seeds
            if seed in other["groups"].get(group, ())]  # fmt: skip
    if differ or both:
        what = f"other {', '.join(differ)}" if differ else f"also {', '.join(both)}"
        raise ConfigError(
            f"report.keep: must be false unless the run evaluates other trainings as the published ones were "
            f"evaluated; it has {what}"
        )
    named = dict.fromkeys((*one["groups"], *other["groups"]))
    groups = {name: [*one["groups"].get(name, ()), *other["groups"].get(name, ())] for name in named}
    facts = {
        **other,
        "groups": groups,
        "met": sorted([*one["met"], *(place_ for place_ in other["met"] if place_ not in one["met"])]),
        "variants": {**variants, **more_variants},
        "seeds": sorted({*one.get("seeds", ()), *other.get("seeds", ())}),
        "evaluated_at": sorted({*one["evaluated_at"], *other["evaluated_at"]}),
        "exactness": one.get("exactness", []),
        "compared": _compared_in_both(earlier, more),
        "earlier": [*one.get("earlier", ()), {name: one[name] for name in MADE}],
    }
    cells = {
        (at, group): {**earlier.trainings(at, group), **more.trainings(at, group)}
        for group in groups
        for at in earlier.conditions
    }
    return Results(facts, cells)


def _compared_in_both(earlier: Results, more: Results) -> list[dict[str, Any]]:
    """Return the fact `compared` for the groups of both runs: baselines and equal simulations."""
    found = []
    for at in earlier.conditions:
        usual = more.baselines()[at]
        each = {name: run.baselines(name)[at] for run in (earlier, more) for name in run.groups}
        same = more.same_as[at] if more.same_as[at] == earlier.same_as[at] else at
        own = {name: texts_of(other) for name, other in each.items() if other != usual}
        entry = {"condition": texts_of(at), "baseline": texts_of(usual), "same_as": texts_of(same)}
        found.append({**entry, "own_baseline": own} if own else entry)
    return found


def texts_of(at: Condition) -> list[str]:
    """Return axis and value of a condition as text, as files store them."""
    return [at[0], text_of(at[1])]


def publish(data: Path, name: str, results: Results) -> None:
    """Write a study into the published data.

    Args:
        data: Folder for `NAME_episodes.csv.gz`, `NAME_about.json` and `NAME_trainings.csv`.
        name: Name of the study.
        results: Its results.
    """
    write_cells(data / f"{name}_episodes.csv.gz", results.cells)
    facts = {key: value for key, value in results.facts.items() if key != "host"}  # a local name
    write_json(data / f"{name}_about.json", facts)
    rows = [
        (*label, len(own), f"{own['success'].mean():.4f}", f"{own['distance_m'].mean():.2f}")
        for label, own in _labelled(results.cells).items()
    ]
    write_csv(data / f"{name}_trainings.csv", (*LABELS, "episodes", "success_rate", "distance_m"), rows)


def check_whole(results: Results) -> None:
    """Check that every training has all of its episodes under every condition.

    Raises:
        ConfigError: Episodes are missing; the message names condition, group and seed.
    """
    trials = results.facts["trials"]
    for at in results.conditions:
        for group, seeds in results.groups.items():
            for seed in seeds:
                count = len(results.trainings(at, group).get(seed, ()))
                if count != trials:
                    what = f"{at[0]} {text_of(at[1])} of {group} s{seed}"
                    rule = f"resume: {what} must have {trials} episodes, got {count}"
                    raise ConfigError(f"{rule}; run the command of the study again")
