import dataclasses
import importlib
import re

import pytest
import yaml

from envs.config import EnvConfig
from jobs.config.command_line import hydra_words
from jobs.config.conditions import axis_points
from jobs.config.config import ConfigError, as_dict, known_keys, parse
from jobs.config.env_keys import env_with, flat_env
from jobs.config.registry import JOBS
from jobs.run.folder import run_name
from models.kinds import KINDS, model_keys
from tests.support.configs import CONF, compose

WITH_SETTINGS = [name for name, job in JOBS.items() if job.own_keys()]


def options(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


GROUPS = sorted(path.name for path in CONF.iterdir() if path.is_dir() and path.name != "hydra")
CHOICES = [
    f"{group}={option}"
    for group in GROUPS
    if group not in ("exp", "length", "job", "axes", "claims")  # of studies, whose experiments are tried
    for option in options(group)
]
# Where the length of a training is chosen -> an experiment that chooses it there; the others as bytestream.
OF_EACH_LENGTH = {"budget": "bytestream"} | {
    match[1]: file.stem
    for file in sorted((CONF / "exp").glob("*.yaml"))
    if (match := re.search(r"(?:length: \$\{budget\}_|override /algo: )(\w+)", file.read_text()))
}


@pytest.fixture(scope="module")
def values():
    return compose("+exp=bytestream")


def changed(values: dict, key: str, value: object) -> dict:
    section, _, name = key.rpartition(".")
    return {**values, section: {**values[section], name: value}} if section else {**values, name: value}


@pytest.mark.parametrize("exp", options("exp"))
def test_every_experiment_is_accepted_and_a_policys_folder_has_its_name(exp):
    config = parse(compose(f"+exp={exp}"))
    assert config.job in ((exp,) if exp in JOBS else ("study", "pipeline"))
    if config.job == "pipeline":
        assert run_name(config).startswith(f"{exp}-{config.budget}-s0-")


def test_every_kind_of_policy_has_an_experiment():
    composed = [compose(f"+exp={exp}") for exp in options("exp")]
    assert {values["model"]["name"] for values in composed if values["job"] == "pipeline"} == {*KINDS}


def test_every_job_has_a_module_whose_settings_are_those_of_its_file():
    for name, job in JOBS.items():
        keys, settings = job.own_keys(), job.settings()
        fields = [] if settings is None else [field.name for field in dataclasses.fields(settings)]
        assert (name, sorted(keys)) == (name, sorted(fields))
        assert callable(importlib.import_module(job.module).run)
        text = job.file.read_text()
        assert not keys or f"Fields: {settings.__module__}.Settings." in text.splitlines()[1]
        said = text.rpartition(f"\n{name}:\n")[2].splitlines() if keys else []
        assert [line for line in said if "#" not in line and not line.startswith("    ")] == []
        assert job.summary


@pytest.mark.parametrize("name", WITH_SETTINGS)
def test_a_configuration_is_the_core_and_the_section_of_its_job_and_survives_being_written(name):
    values = compose("+exp=event_columns", f"job={name}", "budget=smoke")
    assert [other for other in WITH_SETTINGS if other in values] == [name]
    config = parse(values)
    assert dataclasses.asdict(config.own) == values[name]
    assert parse(yaml.safe_load(yaml.safe_dump(as_dict(config), sort_keys=False))) == config
    assert (config.job, config.exp) == (name, "event_columns")


def test_a_setting_of_another_job_is_refused_by_the_name_of_that_job():
    with pytest.raises(ConfigError, match=r"^trade: no such key, got .*; a setting of the job trade$"):
        parse({**compose("+exp=demo"), "trade": {"trials": 3}})
    with pytest.raises(ConfigError, match=r"^job: demo needs its settings, .*`- override /job: demo`"):
        parse({**compose("+exp=train"), "job": "demo"})


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (["demo", "seed=1"], ["job=demo", "seed=1"]),
        (["train"], ["+exp=train"]),
        (["+exp=tune", "~tune.space", "+tune.space={}"], ["job=search", "~search.space", "+search.space={}"]),
        (["ship"], ["job=publish"]),
        (["+exp=event_columns", "job=tune"], ["+exp=event_columns", "job=search"]),
        (["video_events", "video.path=a.mp4"], ["job=video_events", "video_events.path=a.mp4"]),
        (["replay", "day.raw", "rgb-s0"], ["job=replay", "replay.recording=day.raw", "replay.policy=rgb-s0"]),
        (["demo", "rgb-s0", "more"], ["job=demo", "demo.policy=rgb-s0", "more"]),
        (["demo", "--cfg", "job"], ["job=demo", "--cfg", "job"]),
        (["train", "more"], ["+exp=train", "more"]),
        (["seed"], ["seed"]),
        (["+exp=mine", "-cd", "here"], ["+exp=mine", "-cd", "here"]),
        ([], []),
    ],
)  # fmt: skip
def test_a_job_is_called_by_its_name_and_by_the_names_that_it_had(words, meant):
    assert hydra_words(words) == meant


@pytest.mark.parametrize(
    "word", ["my_policy.py:policy", "it's, [here].csv", r"back\'slash", r"C:\a b", "end\\"]
)
def test_a_word_reaches_its_setting_as_it_was_typed(word):
    assert compose("demo", word)["demo"]["policy"] == word


@pytest.mark.parametrize("budget", ["smoke", "paper"])
@pytest.mark.parametrize("exp", OF_EACH_LENGTH.values(), ids=OF_EACH_LENGTH)
def test_every_length_has_a_file_of_every_budget_or_takes_the_budgets_own(exp, budget):
    assert parse(compose(f"+exp={exp}", f"budget={budget}")).budget == budget


@pytest.mark.parametrize("choice", CHOICES)
def test_every_file_of_every_group_is_accepted(choice):
    parse(compose("+exp=bytestream", choice))


def test_the_sweep_is_by_day_and_by_night_what_the_lights_are(values):
    """Of a light that a sweep changes nothing is left out, and nothing added."""
    nominal, axis = parse(values), parse(compose("+exp=robustness")).own.axes["sensor_noise"]
    for light, point in zip(("none", "day", "night"), axis_points(axis), strict=True):
        assert parse(compose("+exp=bytestream", f"light={light}")).env == env_with(nominal.env, point)


def test_the_yaml_of_the_world_says_what_its_dataclasses_say(values):
    defaults = flat_env(EnvConfig(window_capacity=None))  # Gymnasium's clients need arrays of one size
    assert {group: values[group] for group in defaults} == defaults


def test_no_key_is_given_without_being_checked_nor_checked_without_being_given():
    given = set()
    for choice in (choice for choice in CHOICES if choice.startswith(("model=", "algo="))):
        values = compose("+exp=bytestream", choice)
        sections = {group: section for group, section in values.items() if isinstance(section, dict)}
        given |= {*values, *(f"{group}.{key}" for group, section in sections.items() for key in section)}
    assert given == {*known_keys()}


def test_every_value_says_its_unit_or_source_in_a_comment():
    for file in (path for path in CONF.rglob("*.yaml") if path.parent.name not in ("exp", "help")):
        lines = file.read_text().splitlines()
        assert lines[0].startswith("#"), file
        if file.parent != CONF and file.parent.name not in ("budget", "length", "job", "claims"):
            bare = [line for line in lines[1:] if ": " in line and "#" not in line and "name:" not in line]
            assert (file, bare) == (file, [])


def test_every_group_names_the_class_that_its_keys_are_fields_of():
    others = ("exp", "help", "budget", "length", "axes", "claims")
    for file in (path for path in CONF.rglob("*.yaml") if path.parent.name not in others):
        text = file.read_text()
        if text.startswith("# @package _global_"):  # keys of several groups
            continue
        values = yaml.safe_load(text)
        groups = {file.parent.name: values}
        if file.parent == CONF:
            groups = {key: own for key, own in values.items() if isinstance(own, dict) and key != "hydra"}
        classes = re.findall(r"Fields: ([\w.]+)\.(\w+)", text)
        for (module, name), group in zip(classes, groups.values(), strict=True):
            fields = dataclasses.fields(getattr(importlib.import_module(module), name))
            assert group.keys() - {"defaults"} <= {field.name for field in fields}, file


@pytest.mark.parametrize(
    "length", [length for length in options("length") if length.partition("_")[2] in options("algo")]
)
def test_an_algorithm_trains_as_long_as_it_needs_in_each_budget_unless_told_otherwise(length):
    budget, _, algo = length.partition("_")
    words = "+exp=event_columns", f"budget={budget}", f"algo={algo}"
    own = yaml.safe_load((CONF / "length" / f"{length}.yaml").read_text())
    assert own["train"].items() <= compose(*words)["train"].items()
    assert compose(*words, "train.env_steps=7")["train"]["env_steps"] == 7


def test_an_experiment_with_a_length_of_its_own_is_as_short_as_others_in_a_smoke_test():
    names = "bytestream_hold", "bytestream_imitation"
    own, usual = (compose(f"+exp={name}", "budget=smoke") for name in names)
    assert own["train"]["env_steps"] == usual["train"]["env_steps"]
    assert own["algo"]["imitation"]["final_steps"] == usual["algo"]["imitation"]["final_steps"]
    long, short = (compose(f"+exp={name}")["train"]["env_steps"] for name in names)
    assert long > short


def test_the_stages_of_an_experiment_share_its_run_folder():
    stages = ("bytestream", "collect", "pretrain", "train", "evaluate")
    assert len({run_name(parse(compose(f"+exp={stage}"))) for stage in stages}) == 1


@pytest.mark.parametrize("name", ["bytestream_xy", "event_columns_gru", "event_image_vae"])
def test_a_kind_has_the_settings_of_its_parts_and_no_others(values, name):
    usual, own = values["model"], model_keys(name)
    values = compose("+exp=bytestream", f"model={name}")
    assert list(values["model"]) == own
    for key in own[1:]:
        with pytest.raises(ConfigError, match=rf"^model\.{key}: .*got None"):
            parse(changed(values, f"model.{key}", None))
    for key in usual.keys() - {*own}:
        with pytest.raises(ConfigError, match=rf"^model\.{key}: no such key, got .*; this kind of model has"):
            parse(changed(values, f"model.{key}", usual[key]))


POINT_MASS = "env.vehicle=point_mass"
GROWN = ("algo.imitation.temperature=0.0", "algo.imitation.fit_steps=0.5")
TOO_SMALL = "camera.width: must be at least 36 for the network of"


@pytest.mark.parametrize(
    ("words", "rule"),
    [
        ([POINT_MASS], "env.vehicle: must have discrete actions, .*the actions of 'point_mass' are"),
        (["env.vehicle=boat"], "env.vehicle: must be one of kinematic, point_mass, .*got 'boat'"),
        ([POINT_MASS, "+env.body.tau=1"], "env.body has no 'tau'; it has command, "),
        (["+env.body.tau_s=1"], "env.body must be empty for vehicle 'kinematic'"),
        (["vehicle=point_mass", "algo=imitation", "algo.teacher_sight_m=20"],
         "algo.teacher_sight_m: must be null for vehicle 'point_mass', .*got 20"),
        (["vehicle=point_mass", "train.conditions=[{env.body.primitives: 5}]"],
         "env.body.primitives: must be the same for all of a training"),
        (["env.task=race"], "env.task: must be one of corridor, got 'race'"),
        (["algo=imitation", *GROWN], r"^algo\.imitation: temperature: .*got 0\.0; fit_steps: .*got 0\.5$"),
        (["model=bytestream_xy", "model.coding=eventnet"],
         "coding must be additive or none for bytestream_xy.*got 'eventnet'"),
        (["model=event_image_vae", "model.encoder=finetuned"],
         "encoder must be frozen for event_image_vae; bytestream, bytestream_xy can be"),
        (["model=bytestream", "model.encoder=finetuned", "model.time_bins=40000"],
         "time_bins must be at most 32768 for encoder=finetuned, got 40000"),
        (["model=rgb", "camera.width=35"], f"^{TOO_SMALL} rgb, got 35$"),
        (["model=event_image_vae", "camera.width=35"], f"^{TOO_SMALL} event_image_vae, got 35$"),
    ],
)  # fmt: skip
def test_settings_that_do_not_go_together_are_refused(words, rule):
    with pytest.raises(ConfigError, match=rule):
        parse(compose("+exp=event_columns", *words))


def test_settings_just_inside_those_limits_are_accepted():
    vehicle, coding = (POINT_MASS, "+env.body.primitives=3"), ("model=bytestream", "model.coding=eventnet")
    for words in (vehicle, coding, ("model=rgb", "camera.width=36"), ("camera.width=35",)):
        parse(compose("+exp=event_columns", *words))


def test_a_whole_number_names_the_same_run_as_its_float():
    words = ("env.control_hz=100", "env.control_hz=100.0")
    assert len({run_name(parse(compose("+exp=bytestream", word))) for word in words}) == 1


@pytest.mark.parametrize("value", [float("nan"), float("inf"), "fast", True, None, [1.0]])
@pytest.mark.parametrize("key", ["algo.lr", "env.control_hz", "camera.contrast_threshold"])
def test_no_number_may_be_anything_but_a_finite_number(values, key, value):
    with pytest.raises(ConfigError, match=f"^{key}: "):
        parse(changed(values, key, value))


NOT_A_SCENE = "must be one of cones, dynamic, gates, "


@pytest.mark.parametrize(
    ("key", "value", "rule"),
    [
        ("env.control_hz", -1, "greater than or equal to 0.1, got -1"),
        ("camera.memory", "none", "'reference', 'frame' or 'legacy', got 'none'"),
        ("faults.sparsity", 1.2, "less than or equal to 1, got 1.2"),
        ("algo.minibatch_size", 4096, "must not exceed train_batch_size_per_learner"),
        ("seed", 1.5, "valid integer, got 1.5"),
        ("seed", 2**31, "less than 2147483648, got 2147483648"),
        ("job", "os.system", "got 'os.system'"),
        ("exp", "../up", "got '../up'"),
        ("study.axes", {"a": {"env.control_hz": [1.0, 0.0]}}, "a: env.control_hz=0.0: Input should be"),
        ("study.axes", {"a": {"env.control_hz": []}}, "a.env.control_hz: List should have at least 1"),
        ("study.axes", {"a": {"env.control_hz": [float("nan")]}}, "must be a finite number, a word or null"),
        ("study.axes", {"a/b": {"env.control_hz": [1]}}, "String should match pattern"),
        ("study.axes", {"nominal": {"faults.sparsity": [0.5]}}, "study.axes.nominal: must have another name"),
        ("study.axes", {"where": {"env.scene": ["moon"]}}, f"study.axes: {NOT_A_SCENE}"),
        ("study.scene", "moon", f"study.scene: {NOT_A_SCENE}"),
        ("env.scene", "moon", f"env.scene: {NOT_A_SCENE}"),
        ("collect.scenes", ["poles", "moon"], f"collect.scenes: {NOT_A_SCENE}"),
        ("collect.scenes", [], "must name a scene where collect.recordings is empty, got []"),
        ("train.conditions", [{"env.scene": "moon"}], f"train.conditions: {NOT_A_SCENE}"),
        ("env.camera", {"width": 64}, "env.camera: "),
        ("camera", 64, "must be a group of settings, got 64"),
        ("env", None, "must be a group of settings, got None"),
        ("env.contrast_treshold", 0.2, "no such key, got 0.2; did you mean camera.contrast_threshold?"),
        ("env.split", "eval", "env.split: no such key, got 'eval'; every job chooses it itself"),
        ("env.layout", {"num_obstacles": 100_000}, "num_obstacles=100000 cannot be placed 2.0 m apart"),
        ("env.layout", {"num_obstacles": 2.5}, "num_obstacles must be a whole number"),
        ("env.layout", {"num_pole": 3}, "has no 'num_pole'"),
        ("model.name", "snn", f"must be one of {', '.join(KINDS)}, got 'snn'"),
        ("model.name", "eip", "which is called event_image now"),
    ],
)  # fmt: skip
def test_a_configuration_error_names_the_key_the_rule_and_the_value(values, key, value, rule):
    values = compose("+exp=robustness") if key.startswith("study.") else values
    with pytest.raises(ConfigError) as error:
        parse(changed(values, key, value))
    assert str(error.value).startswith(key.partition(".")[0])
    assert rule in str(error.value)
    assert len(str(error.value).splitlines()) == 1


def test_all_errors_come_at_once(values):
    with pytest.raises(ConfigError) as error:
        parse(changed(changed(changed(values, "seed", -1), "algo.lr", -1.0), "env.control_hz", -1.0))
    keys = [line.partition(":")[0] for line in str(error.value).splitlines()]
    assert sorted(keys) == ["algo.lr", "env.control_hz", "seed"]
