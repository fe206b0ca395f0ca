"""Whether a sweep is the planned dose-response study, whole: no other may stand below its plan."""

import json
import re
from collections.abc import Mapping
from pathlib import Path

import yaml

from envs.config import EnvConfig
from jobs.config.env_keys import flat_env
from jobs.config.errors import ConfigError
from jobs.config.schema import SweepConfig
from jobs.evaluation.sweep_plan import axes_of
from jobs.evaluation.sweep_report import SweepFacts
from jobs.reporting.breaks import SweptEpisodes
from jobs.run.files import read_json
from jobs.run.identity import ADDED_SETTINGS
from jobs.run.provenance import REPOSITORY
from models.policy.policy import MANIFEST

PLAN = REPOSITORY / "conf" / "sweep" / "dose_response.yaml"
ACTION = "stochastic"  # the plan's
REMEDY = (
    "give `python -m platform.launch +exp=dose_response` as it stands, which reads stored episodes back, "
    "or name its run folder: resume="
)


def read_plan(file: Path = PLAN) -> SweepConfig:
    """The settings of the planned sweep."""
    return SweepConfig(**yaml.safe_load(file.read_text()))


def check_planned(
    sweep: Path, env: EnvConfig, about: SweepFacts, swept: SweptEpisodes, plan: SweepConfig, pretrained: Path
) -> None:
    """Check that a sweep has the settings of the plan and all of its episodes, and the simulation `env`.

    Args:
        sweep: The folder that the sweep has left in its run folder.
        env: The simulation of this command, in which event errors are measured.
        about: What made the sweep.
        swept: Its episodes.
        plan: Of the study.
        pretrained: Where the published policies are: of a group that is named, all belong to the study.

    Raises:
        ConfigError: It has not; the message names the first difference.
    """
    groups: dict[str, list[int]] = {}
    for name in plan.policies:
        group, seeds = _trainings(name, pretrained)
        groups.setdefault(group, []).extend(seeds)
    planned = {"scene": plan.scene, "trials": plan.trials, "action": ACTION, "groups": groups}
    planned["axes"] = axes_of(plan)
    other = _difference("", planned, {name: about.get(name) for name in planned})
    if other:
        raise ConfigError(f"resume: {sweep} is not the planned study: its {other}; {REMEDY}")
    check_whole(sweep, env, about, swept)


def check_whole(sweep: Path, env: EnvConfig, about: SweepFacts, swept: SweptEpisodes) -> None:
    """Check that a sweep has all of its episodes, and the simulation of this command.

    Args:
        sweep: The folder that the sweep has left in its run folder.
        env: The simulation of this command, in which event errors are measured.
        about: What made the sweep.
        swept: Its episodes.

    Raises:
        ConfigError: It has not; the message names the first difference.
    """
    changed = _difference("", json.loads(json.dumps(flat_env(env))), _stored_env(sweep.parent))
    if changed:
        rule = f"{sweep} must have the simulation of this command: its {changed}"
        raise ConfigError(f"resume: {rule}; leave that setting out of this command, or else {REMEDY}")
    missing = _missing(about, swept)
    if missing:
        raise ConfigError(f"resume: {sweep} is not complete: {missing}; give its command again")


def _trainings(name: str, pretrained: Path) -> tuple[str, list[int]]:
    """Group and seeds of what a plan names: one training, such as bytestream-s0, or all of a group."""
    if one := re.fullmatch(r"(.+)-s(\d+)", name):
        return one[1], [int(one[2])]
    names = [path.parent.name for path in pretrained.glob(f"{name}-s*/{MANIFEST}")]
    return name, sorted(int(own.rpartition("-s")[2]) for own in names if re.search(r"-s\d+$", own))


def _stored_env(run: Path) -> dict[str, object]:
    """The simulation of a run folder, in the groups of conf/."""
    stored = run / "config.json"
    if not stored.is_file():
        rule = "must be a run folder (one that holds config.json)"
        raise ConfigError(f"resume: {rule} for its simulation to be known, got {str(run)!r}; {REMEDY}")
    return {
        name: {**ADDED_SETTINGS.get(name, {}), **values} if isinstance(values, Mapping) else values
        for name, values in read_json(stored).items()
        if name in flat_env(EnvConfig())
    }


def _difference(name: str, asked: object, found: object) -> str | None:
    """The first place in nested mappings where what is found is not what is asked; None: there is none."""
    if not isinstance(asked, Mapping) or not isinstance(found, Mapping):
        said = ["nothing" if one is None else repr(one) for one in (asked, found)]
        return None if asked == found else f"{name} must be {said[0]}, got {said[1]}"
    for key in dict.fromkeys([*asked, *found]):
        below = _difference(f"{name}.{key}" if name else str(key), asked.get(key), found.get(key))
        if below:
            return below
    return None


def _missing(about: SweepFacts, swept: SweptEpisodes) -> str | None:
    """The first training that has not all of its episodes under a condition; None: there is none."""
    trainings = [(group, seed) for group, seeds in about["groups"].items() for seed in seeds]
    for axis, points in about["axes"].items():
        for value in points:
            for group, seed in trainings:
                count = len(swept.get(((axis, value), group), {}).get(seed, ()))
                if count != about["trials"]:
                    rule = f"must have {about['trials']} episodes, got {count}"
                    return f"{axis} {value} of {group} s{seed} {rule}"
    return None
