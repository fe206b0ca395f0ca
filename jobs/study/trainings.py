"""Trainings of a study: each variant with each seed, trained in its own run folder or already published."""

import dataclasses
import itertools
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

from envs.config import sensor_settings
from jobs.config.config import Config, ConfigError, as_dict, parse
from jobs.config.errors import differences
from jobs.run.files import read_json_lines
from jobs.run.folder import Run, finished, group_name, locate_run, open_run
from jobs.run.progress import console
from jobs.study.learned import published_place
from jobs.training import train
from models.kinds import model_keys
from models.policy.policy import MANIFEST, read_policy_manifest

ENCODER_FILES = (
    "encoder/encoder.safetensors",
    "encoder/encoder.json",
    "stages/collect.json",
    "stages/pretrain.json",
)
# Settings that do not affect what an encoder learns from. Variants that differ only in these share encoders.
SAME_ENCODER = (
    *("train.", "algo.", "model.memory_ms", "model.stack", "model.hidden"),
    *("model.own_actions", "model.own_velocity"),
)
INIT = "train.init"
STATED = ("algo", "train", "collect", "pretrain")  # sections in a manifest, besides the model's
# Keys of a variant that are not settings of its experiment.
SEEDS, ENCODER_SEED = "seeds", "encoder_seed"
APART = (SEEDS, ENCODER_SEED, "tags", "published")
Training = tuple[str, int]  # variant and seed


def check_variants(config: Config) -> None:
    """Check every variant before anything is trained.

    Raises:
        ConfigError: A variant has a wrong key or value.
    """
    for name in config.own.variants:
        seed = seeds_of(config, name)[0]
        variant_config(config, name, seed)
        encoder_seed_of(config, name, seed)


def published_policies(config: Config) -> dict[Training, Path]:
    """Return the published policy folder of every training of a study.

    Raises:
        ConfigError: A training is missing, or its manifest says that it used other settings.
    """
    said, found, wrong = dataclasses.asdict(config.own), {}, []
    for name, seed in trainings_of(config):
        place = published_place(said, name)
        if place is None:
            raise ConfigError("study.published: must name published policies where train is false, got null")
        training = variant_config(config, name, seed)
        # `evade publish` puts the length of some trainings into their names.
        length = group_name(as_dict(training)).removeprefix(training.exp)
        folders = [place.with_name(f"{place.name}{end}-s{seed}") for end in (length, "")]
        folder = next(filter(Path.is_dir, folders), folders[-1])
        found[name, seed] = folder
        differ = _stated_otherwise(folder, training)
        wrong += [f"{folder.name} {differ}"] if differ else []
    if wrong:
        rule = f"must hold every training as +exp={config.exp} makes it"
        raise ConfigError(f"study.published: {rule}, got {config.own.published!r}: {'; '.join(wrong)}")
    return found


def _stated_otherwise(folder: Path, training: Config) -> str:
    """Return how a published policy's training differs from a configuration; "" if it does not."""
    if not (folder / MANIFEST).is_file():
        return "is not there"
    manifest = read_policy_manifest(folder / MANIFEST)
    there, here = stated(manifest), stated(as_dict(training))
    both = there.keys() & here.keys()  # older policies lack what was added since
    sensor = sensor_settings(training.env)
    seen = {key: value for key, value in manifest["sensor"].items() if key in sensor}
    differ = differences({key: there[key] for key in both}, {key: here[key] for key in both})
    differ = differ or differences(seen, {key: sensor[key] for key in seen})
    return f"has {differ}" if differ else ""


def stated(settings: Mapping[str, object]) -> dict[str, object]:
    """Return the training settings that a manifest or a configuration states: key -> value."""
    sections = {name: cast(dict[str, object], settings.get(name, {})) for name in (*STATED, "model")}
    model = sections.pop("model") or {name: settings[name] for name in model_keys() if name in settings}
    parts = {f"{name}.{key}": value for name, own in sections.items() for key, value in own.items()}
    parts.pop("algo.num_env_runners", None)  # as many as there were cores
    return {**model, **parts}


def trainings_of(config: Config) -> list[Training]:
    """Return every variant with each of its seeds."""
    return [(name, seed) for name in config.own.variants for seed in seeds_of(config, name)]


def train_variants(config: Config) -> dict[Training, Run]:
    """Train every variant with every seed, without repeating finished trainings; return the runs."""
    trained = dict[Training, Run]()
    for name, seed in trainings_of(config):
        first = trained.get((encoder_owner(config, name), encoder_seed_of(config, name, seed)))
        trained[name, seed] = train_variant(config, name, seed, first)
    return trained


def _first(config: Config) -> str:
    return next(iter(config.own.variants))


def seeds_of(config: Config, name: str) -> list[int]:
    """Return the seeds of a variant in the order of `study.seeds`: all of them unless it names fewer.

    Raises:
        ConfigError: The variant names fewer than two seeds or unknown ones, or is the first variant, which
            must have all.
    """
    every, named = config.own.seeds, config.own.variants[name].get(SEEDS)
    if named is None:
        return every
    first = _first(config)
    several = isinstance(named, list) and len(named) > 1
    if name == first or not several or any(one not in every or named.count(one) > 1 for one in named):
        raise ConfigError(
            f"study.variants.{name}.{SEEDS}: must be two or more of study.seeds, {every}, and not of "
            f"{first}, with which the others are compared; got {named!r}"
        )
    return [seed for seed in every if seed in named]


def encoder_seed_of(config: Config, name: str, seed: int) -> int:
    """Return the seed whose encoder a training uses: its own seed, or the variant's `encoder_seed`.

    Raises:
        ConfigError: `encoder_seed` is not in `study.seeds`, or the variant is the first or needs an encoder
            of its own.
    """
    named = config.own.variants[name].get(ENCODER_SEED)
    if named is None:
        return seed
    first = _first(config)
    if name == first or named not in config.own.seeds or not shares_encoder(config, name):
        raise ConfigError(
            f"study.variants.{name}.{ENCODER_SEED}: must be one of study.seeds, {config.own.seeds}, of a "
            f"variant after the first, {first}, that changes nothing its encoder learns from; got {named!r}"
        )
    return int(named)


def encoder_owner(config: Config, name: str) -> str:
    """Return the first variant whose encoders learn from the same settings; often the variant itself."""
    own = _encoder_changes(config, name)
    return next(other for other in config.own.variants if _encoder_changes(config, other) == own)


def shares_encoder(config: Config, name: str) -> bool:
    """Whether a variant uses an earlier variant's encoders; False if it has none or starts from a policy."""
    if changes_of(config, name).get(INIT) is not None or encoder_owner(config, name) == name:
        return False
    return variant_config(config, name, config.own.seeds[0]).model.has_encoder


def _encoder_changes(config: Config, name: str) -> dict[str, Any]:
    """Return the changed settings of a variant that affect what its encoder learns from."""
    return {key: value for key, value in changes_of(config, name).items() if not key.startswith(SAME_ENCODER)}


def changes_of(config: Config, name: str) -> dict[str, Any]:
    """Return the settings that a variant changes."""
    return {key: value for key, value in config.own.variants[name].items() if key not in APART}


def variant_config(config: Config, name: str, seed: int) -> Config:
    """Return the configuration of one training.

    Raises:
        ConfigError: The variant has a wrong key or value.
    """
    changes, first = changes_of(config, name), _first(config)
    values = as_dict(config) | {"job": "train", "exp": f"{config.exp}_{name}", "seed": seed}
    del values[config.job]  # the settings of the study
    try:
        for key, value in changes.items():
            _set(values, key, value)
        if changes.get(INIT) is not None:
            if changes[INIT] != first or name == first:
                raise ConfigError(f"{INIT}: must be {first}, the first variant, got {changes[INIT]!r}")
            _set(values, INIT, str(locate_run(variant_config(config, first, seed)).path))
        parsed = parse(values)
    except ConfigError as error:
        raise ConfigError(f"study.variants.{name}: {error}") from None
    return dataclasses.replace(parsed, tracking=config.tracking)  # with its password


def _set(values: Any, key: str, value: Any) -> None:
    """Replace one value in nested containers; `parse` rejects an unknown last key."""
    *path, last = [int(word) if word.isdigit() else word for word in key.split(".")]
    try:
        for name in path:
            values = values[name]
        values[last] = value
    except (KeyError, IndexError, TypeError):
        raise ConfigError(f"{key}: no such key, got {value!r}") from None


def train_variant(config: Config, name: str, seed: int, first: Run | None) -> Run:
    """Train a variant unless it is finished, with the encoder of the run `first` if they share it."""
    own = open_run(variant_config(config, name, seed))
    if finished(own, "train") is None:
        console.print(f"Train {name}, seed {seed}", markup=False)
        if first is not None and shares_encoder(config, name) and finished(own, "pretrain") is None:
            for file in ENCODER_FILES:  # the markers of finished stages come last
                (own.path / file).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(first.path / file, own.path / file)
        train.run(own.config)
    return own


def minutes(training: Run) -> float:
    """Return the training time of a policy without its encoder [min]."""
    rows = read_json_lines(training.train / "results.jsonl")
    ends = [0, *(row["env_steps"] for row in rows)]
    steps = [end - begin for begin, end in itertools.pairwise(ends)]
    return sum(step / row["perf/env_steps_per_second"] for step, row in zip(steps, rows, strict=True)) / 60
