import csv
import dataclasses
import json
import re

import pytest
import yaml

from jobs.config.config import ConfigError, as_dict, parse
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
    configs = {name: variant_config(config, name, 1) for name in config.own.variants}
    settings = {
        name: (changed.env, changed.model, changed.algo, changed.train, changed.collect, changed.pretrain)
        for name, changed in configs.items()
    }
    first, *others = settings.values()
    assert config.train.env_steps == 400_000
    assert ablation_config("budget=smoke").train.env_steps == 4_096
    assert all(other != first for other in others)
    assert {changed.seed for changed in configs.values()} == {1}
    assert configs["ppo"].algo.imitation is None
    assert configs["no_textures"].train.conditions[3]["weight"] < 1e-6
    assert configs["no_textures"].train.conditions[2]["weight"] == config.train.conditions[2]["weight"]


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


def test_learning_rates_differ_in_nothing_else_and_are_judged_apart_from_every_study():
    config = parse(compose("+exp=learning_rates", "model=event_image"))
    trained = [as_dict(variant_config(config, name, 10)) for name in config.own.variants]
    rates = sorted(one["algo"].pop("lr") for one in trained)
    assert rates == [3e-4, 1e-3, 3e-3]
    assert [{**one, "exp": ""} for one in trained[1:]] == [{**trained[0], "exp": ""}] * 2
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
    found = trainings.train_variants(config)
    for (name, seed), (_, _, first) in found.items():
        way, rank = name.split("_", 1)
        assert (first is None) == (way == "taught")
        assert first is None or first[:2] == (f"taught_{rank}", seed)
        assert trainings.shares_encoder(config, name) == (way == "ppo")
        settings = variant_config(config, name, seed)
        owner = variant_config(config, f"taught_{rank}", seed)
        assert (settings.pretrain, settings.collect, settings.env) == (
            owner.pretrain,
            owner.collect,
            owner.env,
        )
        assert settings.model.evae(64, 64) == owner.model.evae(64, 64)


def test_variants_without_an_encoder_share_none():
    config = parse(
        compose("+exp=taught", "+study.variants.again={model:{name:event_image,stack:3},algo.lr:3e-4}")
    )
    assert trainings.encoder_owner(config, "again") == "event_image"
    assert not trainings.shares_encoder(config, "again")


def test_cameras_are_compared_at_each_rate_with_nothing_else_changed():
    config = parse(compose("+exp=camera_rates"))
    seen = {}
    for name in config.own.variants:
        one = as_dict(variant_config(config, name, 1))
        seen[name] = one["env"].pop("control_hz"), one["camera"].pop("memory")
        first = as_dict(variant_config(config, "pixels_200hz", 1))
        del first["env"]["control_hz"], first["camera"]["memory"]
        assert {**one, "exp": ""} == {**first, "exp": ""}
    assert set(seen.values()) == {
        (hz, kind) for hz in (45.0, 200.0, 400.0) for kind in ("reference", "frame")
    }
    assert len(seen) == 6


@pytest.mark.parametrize("way", ["taught", "ppo"])
def test_memory_in_seconds_is_compared_with_a_stack_of_the_same_training(way):
    config = parse(compose("+exp=memory_seconds"))
    stack, seconds = (
        as_dict(variant_config(config, f"{way}_{memory}", 1)) for memory in ("stack", "seconds")
    )
    assert stack["model"].pop("memory_ms") == []
    assert len(seconds["model"].pop("memory_ms")) == 4
    assert stack | {"exp": ""} == seconds | {"exp": ""}
    if way == "ppo":
        usual = as_dict(parse(compose("+exp=bytestream")))
        usual["train"] |= {
            "env_steps": COMPARED_STEPS,
            "checkpoint_every": stack["train"]["checkpoint_every"],
        }
        assert [stack[name] for name in ("algo", "train", "env")] == [
            usual[name] for name in ("algo", "train", "env")
        ]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("{recipe: {}, other: {algo.lrr: 1}}", "algo.lrr"),
        ("{recipe: {}, other: {train.conditions.9.weight: 1}}", "train.conditions.9.weight"),
        ("{recipe: {}, other: {train.conditions.x: 1}}", "train.conditions.x"),
        ("{recipe: {}, other: {algo.lr.what: 1}}", "algo.lr.what"),
        ("{recipe: {}, other: {train.init: another}}", "train.init"),
        ("{recipe: {train.init: recipe}}", "train.init"),
        ("{recipe: {}, other: {seeds: [0, 2]}}", "seeds"),
        ("{recipe: {}, other: {seeds: [1]}}", "seeds"),
        ("{recipe: {}, other: {seeds: 2}}", "seeds"),
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
    settings = as_dict(config)
    for name, seed, lr in (("recipe", 0, 1e-3), ("recipe", 1, 1e-3), ("other", 1, 1e-3)):
        save_trained(tmp_path, name, seed, settings, lr=lr)
    with pytest.raises(ConfigError) as refused:
        published_policies(config)
    assert str(refused.value).startswith("study.published: must hold every training")
    assert str(refused.value).endswith(
        "ablation_other-s0 is not there; ablation_other-s1 has algo.lr: 0.001 there, 0.0001 here"
    )
    for seed in (0, 1):
        save_trained(tmp_path, "other", seed, settings, lr=1e-4, num_env_runners=7)
    assert {key: found.name for key, found in published_policies(config).items()} == {
        (name, seed): f"ablation_{name}-s{seed}" for name in variants for seed in (0, 1)
    }
    (tmp_path / "ablation_other-s1").rename(tmp_path / "third-s1")
    (tmp_path / "ablation_other-s0").rename(tmp_path / "third-s0")
    variants["other"]["published"] = str(tmp_path / "third")
    named = dataclasses.replace(config, own=dataclasses.replace(config.own, variants=variants))
    assert published_policies(named)["other", 1].name == "third-s1"
    nowhere = dataclasses.replace(config, own=dataclasses.replace(config.own, published=None))
    with pytest.raises(ConfigError, match=r"study\.published: must name published policies"):
        published_policies(nowhere)


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
    assert metrics == {
        f"{at} {name}": 0.0 for at in ("nominal=poles_eval", "sparsity=0.5") for name in variants
    }
    with (folder / "episodes.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {(row["Axis"], row["Group"], row["Training"]) for row in rows} == {
        (axis, name, seed) for axis in ("nominal", "sparsity") for name in variants for seed in "01"
    }
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
    again = dataclasses.replace(
        config.own, published=str(tmp_path / "published" / "ablation_VARIANT"), train=False
    )
    assert study.run(dataclasses.replace(config, own=again)) == metrics


def runs_of(config, name):
    """The runs of a variant, by seed."""
    return [locate_run(variant_config(config, name, seed)) for seed in config.own.seeds]


def ablation_config(*words, runs_dir="runs", **changes):
    """The composed experiment with other settings of the study."""
    values = compose("+exp=ablation", *words)
    return parse({**values, "runs_dir": runs_dir, "study": {**values["study"], **changes}})
