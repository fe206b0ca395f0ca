"""What each part of a recipe contributes: trainings with one part changed, in the same corridors.

Run: python -m platform.launch +exp=ablation
Expect: by estimate six hours on two idle cores. Each training has a run folder of its own, and is read from
it once it is finished; in this run's folder under `ablation/`, and in MLflow, every episode, a table and
a plot. A stopped job continues when the same command is given again. With `ablation.trained=FOLDER` nothing
is trained: the policies of that folder are evaluated.
"""

import dataclasses
import itertools
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np

from envs.config import sensor_settings
from jobs.config.conditions import NOMINAL
from jobs.config.config import Config, ConfigError, as_dict, parse
from jobs.config.errors import differences
from jobs.evaluation.group_stats import LABELS, episode_values
from jobs.evaluation.sweep_plan import plan_sweep
from jobs.evaluation.sweep_report import SweepResults, about, training_text
from jobs.rollout.episodes import write_episodes
from jobs.rollout.executors import Executor
from jobs.rollout.policies import EvaluatedPolicy, read_policy
from jobs.rollout.scheduler import default_executor, evaluate_tasks
from jobs.rollout.store import EpisodeStore
from jobs.run.checkpoints import sha256
from jobs.run.files import read_json_lines
from jobs.run.folder import Run, finish, finished, group_name, locate_run, open_run
from jobs.run.progress import console
from jobs.run.provenance import provenance
from jobs.studies.ablation.page import AblationFacts, variant_result, write_page
from jobs.tracking.tracker import open_tracker
from jobs.training import train
from models.kinds import model_keys
from models.policy.policy import MANIFEST, read_policy_manifest

ENCODER_FILES = (
    "encoder/encoder.safetensors",
    "encoder/encoder.json",
    "stages/collect.json",
    "stages/pretrain.json",
)
# Settings by which a variant needs no encoder of its own, but sees by that of the first variant.
SAME_ENCODER = ("train.", "algo.", "model.memory_ms", "model.stack", "model.hidden")
INIT = "train.init"
TOLD = ("algo", "train", "collect", "pretrain")  # settings that a manifest tells, beside the model's
# Of a variant, and not settings of its experiment: the trainings that it has, if fewer than the first, and
# the seed of the encoder of the first by which all of them see.
SEEDS, ENCODER_SEED = "seeds", "encoder_seed"
Variant = Mapping[str, Any]  # key -> value


def run(config: Config, executor: Executor | None = None) -> dict[str, float]:
    """Train and evaluate every variant with every seed, and compare each with the first; return its success.

    Args:
        config: The experiment.
        executor: Computes the missing episodes; None: on all cores.

    Raises:
        ConfigError: There is no variant, or one has a wrong key or value; or as `trained_policies`.
    """
    variants = config.ablation.variants
    if not variants:
        raise ConfigError("ablation.variants: must name at least one, got none; +exp=ablation names twelve")
    for name in variants:
        seeds = seeds_of(config, name)
        variant_config(config, name, seeds[0])
        encoder_seed_of(config, name, seeds[0])
    places = None if config.ablation.trained is None else trained_policies(config)
    folder = open_run(config)
    config = folder.config
    times: dict[str, list[float]] = {name: [] for name in variants}
    if places is None:
        runs = train_variants(config)
        places = {training: run.policy for training, run in runs.items()}
        times = {name: [minutes(runs[name, seed]) for seed in seeds_of(config, name)] for name in variants}
    policies = [
        dataclasses.replace(read_policy(str(place)), group=name, training=seed)
        for (name, seed), place in sorted(places.items(), key=lambda item: list(variants).index(item[0][0]))
    ]
    return compare(config, folder, times, policies, executor)


def trained_policies(config: Config) -> dict[tuple[str, int], Path]:
    """The policy folders of all trainings in `ablation.trained`, by variant and seed, named as by +exp=ship.

    Those of another experiment are taken, too, where only one folder's name ends as that of the training
    does: a study may evaluate what another has trained.

    Raises:
        ConfigError: A training is missing, or its manifest says that it was trained otherwise.
    """
    named = str(config.ablation.trained)
    found, wrong = {}, []
    for name in config.ablation.variants:
        for seed in seeds_of(config, name):
            training = variant_config(config, name, seed)
            expected = as_dict(training)
            place = Path(named) / f"{group_name(expected)}-s{seed}"
            ending = place.name.removeprefix(config.exp)
            others = [path.parent for path in Path(named).glob(f"*{ending}/{MANIFEST}")]
            place = others[0] if not place.is_dir() and len(others) == 1 else place
            found[name, seed] = place
            if not (place / MANIFEST).is_file():
                wrong.append(f"{place.name} is not there")
                continue
            manifest = read_policy_manifest(place / MANIFEST)
            there, here = told(manifest), told(expected)
            both = there.keys() & here.keys()  # older policies lack what was added since
            differ = differences({key: there[key] for key in both}, {key: here[key] for key in both})
            sensor = sensor_settings(training.env)
            seen = {key: value for key, value in manifest["sensor"].items() if key in sensor}
            differ = differ or differences(seen, {key: sensor[key] for key in seen})
            wrong += [f"{place.name} has {differ}"] if differ else []
    if wrong:
        rule = f"must hold every training, as +exp={config.exp} makes and +exp=ship names them"
        raise ConfigError(f"ablation.trained: {rule}, got {named!r}: {'; '.join(wrong)}")
    return found


def told(settings: Mapping[str, object]) -> dict[str, object]:
    """What a manifest says of how its policy was trained, or the same of a configuration."""
    sections = {name: cast(dict[str, object], settings.get(name, {})) for name in (*TOLD, "model")}
    model = sections.pop("model") or {name: settings[name] for name in model_keys() if name in settings}
    parts = {f"{name}.{key}": value for name, own in sections.items() for key, value in own.items()}
    parts.pop("algo.num_env_runners", None)  # as many as there were cores
    return {**model, **parts}


def train_variants(config: Config) -> dict[tuple[str, int], Run]:
    """Train every variant with every seed unless that is done; return the runs."""
    variants, trained = config.ablation.variants, dict[tuple[str, int], Run]()
    first = next(iter(variants))
    for name in variants:
        for seed in seeds_of(config, name):
            sees_by = trained.get((first, encoder_seed_of(config, name, seed)))
            trained[name, seed] = train_variant(config, name, seed, sees_by)
    return trained


def seeds_of(config: Config, name: str) -> list[int]:
    """Of the trainings of a variant, in the order of `ablation.seeds`: all of these unless it names fewer.

    Raises:
        ConfigError: They are fewer than two, or others, or it is the first variant, which has all.
    """
    every, named = config.ablation.seeds, config.ablation.variants[name].get(SEEDS)
    if named is None:
        return every
    first = next(iter(config.ablation.variants))
    several = isinstance(named, list) and len(named) > 1
    if name == first or not several or any(one not in every or named.count(one) > 1 for one in named):
        raise ConfigError(
            f"ablation.variants.{name}.{SEEDS}: must be two or more of ablation.seeds, {every}, and not of "
            f"{first}, with which the others are compared; got {named!r}"
        )
    return [seed for seed in every if seed in named]


def encoder_seed_of(config: Config, name: str, seed: int) -> int:
    """The seed of the training of the first variant whose encoder a training sees by, if not by its own.

    Raises:
        ConfigError: The variant names another seed than those, needs an encoder of its own, or is the first.
    """
    named = config.ablation.variants[name].get(ENCODER_SEED)
    if named is None:
        return seed
    first = next(iter(config.ablation.variants))
    if name == first or named not in config.ablation.seeds or not shares_encoder(config, name):
        raise ConfigError(
            f"ablation.variants.{name}.{ENCODER_SEED}: must be one of ablation.seeds, "
            f"{config.ablation.seeds}, of a variant after the first, {first}, that changes nothing its "
            f"encoder learns from; got {named!r}"
        )
    return int(named)


def shares_encoder(config: Config, name: str) -> bool:
    """Whether a variant sees by an encoder of the first: there is one, and it learns from nothing changed."""
    changes = changes_of(config, name)
    same = changes.get(INIT) is None and all(key.startswith(SAME_ENCODER) for key in changes)
    return config.model.has_encoder and same


def variant_config(config: Config, name: str, seed: int) -> Config:
    """The experiment of one training.

    Raises:
        ConfigError: It has a wrong key or value.
    """
    changes, first = changes_of(config, name), next(iter(config.ablation.variants))
    values = as_dict(config) | {"job": "train", "exp": f"{config.exp}_{name}", "seed": seed}
    try:
        for key, value in changes.items():
            _set(values, key, value)
        if changes.get(INIT) is not None:
            if changes[INIT] != first or name == first:
                raise ConfigError(f"{INIT}: must be {first}, the first variant, got {changes[INIT]!r}")
            _set(values, INIT, str(locate_run(variant_config(config, first, seed)).path))
        parsed = parse(values)
    except ConfigError as error:
        raise ConfigError(f"ablation.variants.{name}: {error}") from None
    return dataclasses.replace(parsed, tracking=config.tracking)  # with its password


def changes_of(config: Config, name: str) -> Variant:
    """The settings that a variant changes."""
    apart = (SEEDS, ENCODER_SEED)
    return {key: value for key, value in config.ablation.variants[name].items() if key not in apart}


def _set(values: Any, key: str, value: Any) -> None:
    """Replace one value in nested containers; `parse` checks that its key is one."""
    *path, last = [int(word) if word.isdigit() else word for word in key.split(".")]
    try:
        for name in path:
            values = values[name]
        values[last] = value
    except (KeyError, IndexError, TypeError):
        raise ConfigError(f"{key}: no such key, got {value!r}") from None


def train_variant(config: Config, name: str, seed: int, first: Run | None) -> Run:
    """Train a variant unless that is done, on the encoder of a run of the first where it may."""
    own = open_run(variant_config(config, name, seed))
    if finished(own, "train") is None:
        console.print(f"Train {name}, seed {seed}", markup=False)
        if first is not None and shares_encoder(config, name) and finished(own, "pretrain") is None:
            for file in ENCODER_FILES:  # the marks of the finished stages last
                (own.path / file).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(first.path / file, own.path / file)
        train.run(own.config)
    return own


def compare(
    config: Config,
    folder: Run,
    times: Mapping[str, Sequence[float]],
    policies: Sequence[EvaluatedPolicy],
    executor: Executor | None,
) -> dict[str, float]:
    """Evaluate all trainings in the same corridors, and write table and plot; `times` [min] may be empty."""
    sweep = plan_sweep(config, policies)
    place = folder.path / "ablation"
    store, executor = EpisodeStore(place), executor or default_executor(config.cluster, place)
    with open_tracker(config, folder, key=f"ablation {sweep.identity[:8]}") as tracker:
        tracker.tags({"kind": "ablation"})
        found = SweepResults(sweep, store, *evaluate_tasks(sweep.tasks, store, executor, "Ablation"))
        if found.failed:
            raise RuntimeError(
                f"not evaluated: {next(iter(found.failed.values()))}; the same command tries again"
            )
        success = {name: by_condition(found, name) for name in config.ablation.variants}
        results = [
            variant_result(name, success[name], paired(config, success, name), times[name])
            for name in success
        ]
        write_all_episodes(place, found)
        write_page(folder, tracker, results, facts_of(config, folder, found))
        metrics = {f"eval/{result.name}_success": result.mean.value for result in results}
        tracker.log(0, metrics)
        console.print(tracker.dashboard(), markup=False)
    return finish(folder, "ablation", metrics)


def by_condition(found: SweepResults, name: str) -> dict[str, Any]:
    """Condition as text -> success of a variant, bool (trainings, corridors)."""
    return {
        value if axis == NOMINAL else f"{axis}={value}": episode_values(
            found.trainings((axis, value), name), "success"
        )
        for axis, value in found.sweep.conditions
    }


def paired(
    config: Config, success: Mapping[str, Mapping[str, np.ndarray]], name: str
) -> Mapping[str, np.ndarray] | None:
    """Success of the first variant, (trainings, corridors) by condition, of the seeds that another has."""
    first, own = next(iter(success)), seeds_of(config, name)
    if name == first:
        return None
    rows = [config.ablation.seeds.index(seed) for seed in own]
    return {condition: values[rows] for condition, values in success[first].items()}


def minutes(training: Run) -> float:
    """How long a policy was trained, without its encoder [min]."""
    rows = read_json_lines(training.train / "results.jsonl")
    ends = [0, *(row["env_steps"] for row in rows)]
    steps = [end - begin for begin, end in itertools.pairwise(ends)]
    return sum(step / row["perf/env_steps_per_second"] for step, row in zip(steps, rows, strict=True)) / 60


def write_all_episodes(place: Path, found: SweepResults) -> None:
    """Write every episode as a row of a CSV file."""
    episodes = {
        (*task.condition, task.policy.group, training_text(task)): found.results[task.key].episodes
        for task in found.sweep.tasks
    }
    write_episodes(place / "episodes.csv", LABELS, episodes)


def facts_of(config: Config, folder: Run, found: SweepResults) -> AblationFacts:
    """What made the numbers."""
    return {
        **about(config, folder, found),
        **provenance(),
        "episodes_sha256": sha256(folder.path / "ablation" / "episodes.csv"),
        "seeds": config.ablation.seeds,
        "env_steps": config.train.env_steps,
        "variants": {name: dict(changes) for name, changes in config.ablation.variants.items()},
    }
