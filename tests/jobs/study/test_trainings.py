import csv
import dataclasses
import itertools
import json
import re

import pytest
import yaml

from jobs.config.config import ConfigError, as_dict, parse
from jobs.config.flat import flat
from jobs.rollout.policies import read_policy
from jobs.run.files import read_json
from jobs.run.folder import COMPARED_STEPS, locate_run
from jobs.study import study, trainings
from jobs.study.plan import plan_study
from jobs.study.trainings import published_policies, seeds_of, variant_config
from jobs.tools.publish import newest_trainings, publish
from models.encoder.weights import with_checksum
from models.kinds import KINDS
from models.policy.policy import MANIFEST, read_policy_manifest
from tests.support.configs import CONF, SHORT, compose, make_config
from tests.support.policies import RECURRENT, save_training

# As docs/train.md says, rounded up.
STEP_BYTES = {"event_columns": 1_600, "event_set": 6_500, "event_image": 12_400, "rgb": 12_400}


def test_the_experiment_names_variants_that_can_be_trained():
    config = ablation_config()
    trained = {name: variant_config(config, name, 1) for name in config.own.variants}
    first, *others = ({**as_dict(one), "exp": ""} for one in trained.values())
    assert all(other != first for other in others)
    assert {one.seed for one in trained.values()} == {1}
    assert (config.train.env_steps, ablation_config("budget=smoke").train.env_steps) == (400_000, 4_096)
    assert trained["ppo"].algo.imitation is None
    usual, changed = (one.train.conditions for one in (config, trained["no_textures"]))
    assert changed[3]["weight"] < 1e-6
    assert changed[2]["weight"] == usual[2]["weight"]


def test_every_kind_of_policy_is_taught_alike():
    """By the step size of its PPO; with means over time where it can have them; all of its steps are kept."""
    config = parse(compose("+exp=taught"))
    trained = {name: variant_config(config, name, 1) for name in config.own.variants}
    assert {one.model.name for one in trained.values()} == set(trained) == set(KINDS) - set(RECURRENT)
    alike = []
    for name, one in trained.items():
        values = as_dict(one)
        algo = values.pop("algo")
        assert algo.pop("lr") == parse(compose(f"+exp={name}")).algo.lr
        assert algo["imitation"].pop("keep_mb") * 1e6 > config.train.env_steps * STEP_BYTES.get(name, 700)
        assert values.pop("model").get("memory_ms", [10, 30, 100, 300]) == [10, 30, 100, 300]
        alike.append((algo, {key: value for key, value in values.items() if key != "exp"}))
    assert all(one == alike[0] for one in alike)


@pytest.mark.parametrize(
    ("exp", "chosen", "keys"),
    [
        ("learning_rates", "", {"algo.lr"}),
        ("camera_rates", "", {"env.control_hz", "camera.memory"}),
        ("memory_seconds", "taught_", {"model.memory_ms"}),
        ("memory_seconds", "ppo_", {"model.memory_ms"}),
    ],
)
def test_variants_differ_in_what_is_compared_alone(exp, chosen, keys):
    config = parse(compose(f"+exp={exp}"))
    names = [name for name in config.own.variants if name.startswith(chosen)]
    first, *others = (dict(flat(as_dict(variant_config(config, name, 20)))) for name in names)
    assert others
    assert {key for one in others for key in first if one[key] != first[key]} == {"exp", *keys}


def test_learning_rates_are_judged_apart_from_every_study():
    config = parse(compose("+exp=learning_rates", "model=event_image"))
    assert config.train.env_steps == COMPARED_STEPS
    tasks = plan_study(config, [read_policy("oracle")]).tasks
    assert {task.env.split for task in tasks} == {"validation"}
    files = {path.stem: yaml.safe_load(path.read_text()) for path in (CONF / "exp").glob("*.yaml")}
    seeds = {name: set((file.get("study") or {}).get("seeds", {0, 1, 2})) for name, file in files.items()}
    assert [name for name, one in seeds.items() if one & set(config.own.seeds)] == ["learning_rates"]


def test_a_variant_of_a_kind_without_an_encoder_looks_for_none(tmp_path, monkeypatch):
    trained = []
    monkeypatch.setattr(trainings.train, "run", trained.append)
    config = parse(compose("+exp=learning_rates", "model=event_image", f"runs_dir={tmp_path}"))
    runs = trainings.train_variants(config)
    assert [one.seed for one in trained] == 3 * config.own.seeds
    assert len({run.path for run in runs.values()}) == 9


def test_every_encoder_is_met_by_every_seed_of_ppo_once(monkeypatch):
    """Encoder and seed crossed, the trainings of `own` on the diagonal."""
    config = parse(compose("+exp=encoder_seeds"))
    trained = []
    monkeypatch.setattr(trainings, "train_variant", lambda config, name, seed, first: (name, seed, first))
    for (_, seed), (_, _, first) in trainings.train_variants(config).items():
        encoder = seed if first is None else first[1]
        assert first is None or first[0] == "own"
        trained.append((encoder, seed))
    assert sorted(trained) == [(encoder, seed) for encoder in range(5) for seed in range(5)]


def test_variants_whose_encoders_learn_from_the_same_settings_share_them_seed_by_seed(monkeypatch):
    config = parse(compose("+exp=pooling"))
    monkeypatch.setattr(trainings, "train_variant", lambda config, name, seed, first: (name, seed, first))
    for (name, seed), (_, _, first) in trainings.train_variants(config).items():
        way, rank = name.split("_", 1)
        assert (first is None) == (way == "taught")
        assert first is None or first[:2] == (f"taught_{rank}", seed)
        assert trainings.shares_encoder(config, name) == (way == "ppo")
        own, owner = (variant_config(config, one, seed) for one in (name, f"taught_{rank}"))
        for section in ("pretrain", "collect", "env"):
            assert getattr(own, section) == getattr(owner, section)
        assert own.model.evae(64, 64) == owner.model.evae(64, 64)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("{recipe: {}, other: {algo.lrr: 1}}", "algo.lrr"),
        ("{recipe: {}, other: {train.conditions.9.weight: 1}}", "train.conditions.9.weight"),
        ("{recipe: {}, other: {train.init: another}}", "train.init"),
        ("{recipe: {train.init: recipe}}", "train.init"),
        ("{recipe: {}, other: {seeds: [0, 2]}}", "seeds"),
        ("{recipe: {}, other: {seeds: [1]}}", "seeds"),
        ("{recipe: {seeds: [0, 1]}, other: {}}", "seeds"),
        ("{recipe: {}, other: {encoder_seed: 2}}", "encoder_seed"),
        ("{recipe: {encoder_seed: 1}, other: {}}", "encoder_seed"),
        ("{recipe: {}, other: {encoder_seed: 1, env.filter_support: 0}}", "encoder_seed"),
    ],
)
def test_a_wrong_variant_is_refused_before_anything_is_trained(tmp_path, change, message):
    config = ablation_config(runs_dir=str(tmp_path), seeds=[0, 1], variants=yaml.safe_load(change))
    with pytest.raises(ConfigError, match=rf"study\.variants.*{re.escape(message)}"):
        study.run(config)
    assert not list(tmp_path.iterdir())


def test_a_variant_may_have_fewer_trainings():
    variants = {"recipe": {}, "other": {"seeds": [7, 3], "algo.lr": 1e-4, "tags": {"a": 1}}}
    config = ablation_config(seeds=[3, 5, 7], variants=variants)
    assert seeds_of(config, "recipe") == [3, 5, 7]
    assert seeds_of(config, "other") == [3, 7]
    assert variant_config(config, "other", 7).algo.lr == 1e-4


def save_trained(folder, name, seed, settings, **changes):
    """An untrained policy whose manifest says that it was trained so, but for `changes` of its algorithm."""
    path = folder / f"ablation_{name}-s{seed}"
    save_training(path, f"ablation_{name}", seed, make_config().env)
    said = {**settings["model"], **{part: settings[part] for part in ("train", "collect", "pretrain")}}
    manifest = read_policy_manifest(path / MANIFEST) | {**said, "algo": {**settings["algo"], **changes}}
    (path / MANIFEST).write_text(json.dumps(with_checksum(manifest)))


def test_published_policies_are_taken_from_the_named_places_if_they_were_trained_so(tmp_path):
    variants = {"recipe": {}, "other": {"algo.lr": 1e-4}}
    place = str(tmp_path / "ablation_VARIANT")
    config = ablation_config(seeds=[0, 1], published=place, train=False, variants=variants)
    config = dataclasses.replace(config, model=make_config("model=event_columns").model)

    def found(**changes):
        own = dataclasses.replace(config.own, **changes)
        return published_policies(dataclasses.replace(config, own=own))

    settings = as_dict(config)
    for name, seed in (("recipe", 0), ("recipe", 1), ("other", 1)):
        save_trained(tmp_path, name, seed, settings, lr=1e-3)
    differ = "ablation_other-s0 is not there; ablation_other-s1 has algo.lr: 0.001 there, 0.0001 here"
    with pytest.raises(ConfigError, match=rf"^study\.published: must hold every training .*{differ}$"):
        found()
    for seed in (0, 1):
        save_trained(tmp_path, "other", seed, settings, lr=1e-4, num_env_runners=7)
    named = {(name, seed): f"ablation_{name}-s{seed}" for name in variants for seed in (0, 1)}
    assert {key: folder.name for key, folder in found().items()} == named
    for seed in (0, 1):
        (tmp_path / f"ablation_other-s{seed}").rename(tmp_path / f"third-s{seed}")
    elsewhere = {**variants, "other": {**variants["other"], "published": str(tmp_path / "third")}}
    assert found(variants=elsewhere)["other", 1].name == "third-s1"
    with pytest.raises(ConfigError, match=r"study\.published: must name published policies"):
        found(published=None)


@pytest.mark.slow
@pytest.mark.system
def test_every_variant_is_trained_and_evaluated_once(tmp_path):
    words = "budget=smoke", "study.trials=1", *SHORT
    variants = {
        "recipe": {},
        "ppo": {"algo.imitation": None, "algo.mirrored": False, "train.init": "recipe"},
        "bare": {"env.filter_support": 0},
    }
    config = ablation_config(*words, runs_dir=str(tmp_path), seeds=[0, 1], variants=variants)
    own = dataclasses.replace(config.own, axes={"sparsity": {"faults.sparsity": [0.5]}})
    config = dataclasses.replace(config, own=own)
    metrics = study.run(config)
    folder = locate_run(config).path / "study"
    conditions = ("nominal=poles_eval", "sparsity=0.5")
    assert metrics == {f"{at} {name}": 0.0 for at in conditions for name in variants}
    with (folder / "episodes.csv").open() as file:
        rows = list(csv.DictReader(file))
    flown = {(row["Axis"], row["Group"], row["Training"]) for row in rows}
    assert flown == set(itertools.product(("nominal", "sparsity"), variants, "01"))
    assert len({row["seed"] for row in rows}) == 1
    assert (folder / "ablation.png").stat().st_size > 10_000
    assert "### What each variant changes" in (folder / "study.md").read_text()
    encoders = {
        name: [read_json(one.encoder / "encoder.json")["sha256"] for one in runs_of(config, name)]
        for name in ("recipe", "bare")
    }
    assert len({*encoders["recipe"], *encoders["bare"]}) == 4
    begun = [read_json(one.policy / "policy.json") for one in runs_of(config, "ppo")]
    assert [manifest["sha256"]["encoder.safetensors"] for manifest in begun] == encoders["recipe"]
    before = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*/policy/*")}
    study.run(config)
    assert before == {path: path.stat().st_mtime_ns for path in tmp_path.glob("*/policy/*")}
    assert len(before) > 6
    for training in newest_trainings(tmp_path, "smoke"):
        publish(training, tmp_path / "published")
    place = str(tmp_path / "published" / "ablation_VARIANT")
    again = dataclasses.replace(config.own, published=place, train=False)
    assert study.run(dataclasses.replace(config, own=again)) == metrics


def runs_of(config, name):
    """The runs of a variant, by seed."""
    return [locate_run(variant_config(config, name, seed)) for seed in config.own.seeds]


def ablation_config(*words, runs_dir="runs", **changes):
    """The composed experiment with other settings of the study."""
    values = compose("+exp=ablation", *words)
    return parse({**values, "runs_dir": runs_dir, "study": {**values["study"], **changes}})
