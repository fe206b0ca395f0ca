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
from jobs.config.errors import SET_BY_JOBS
from jobs.config.registry import JOBS as JOBS_THERE
from jobs.run.folder import run_name
from models.kinds import KINDS, model_keys
from tests.support.configs import CONF, compose

JOBS = {
    "robustness": "study",
    "dose_response": "study",
    "dose_response_taught": "study",
    "calibrated_camera": "study",
    "camera_rates": "study",
    "encoder_seeds": "study",
    "encoder_targets": "study",
    "false_events": "study",
    "pooling": "study",
    "learning_rates": "study",
    "training_lengths": "study",
    "memory_seconds": "study",
    "ppo_claims": "study",
    "ppo_event_set": "study",
    "ppo_paper": "study",
    "taught_claims": "study",
    "taught": "study",
    "ablation": "study",
    "hold": "study",
    "late_actions": "study",
    "body_speed": "study",
    "body_kinds": "study",
    "body_near": "study",
    "body_conditions": "study",
    "dodge": "study",
    "renderer": "study",
}
POLICIES = {
    "body_hold": "event_columns",
    "bytestream": "bytestream",
    "bytestream_finetuned": "bytestream",
    "bytestream_hold": "bytestream",
    "bytestream_imitation": "bytestream",
    "bytestream_late": "bytestream",
    "bytestream_paper": "bytestream",
    "bytestream_robust": "bytestream",
    "bytestream_xy": "bytestream_xy",
    "event_columns": "event_columns",
    "event_columns_gru": "event_columns_gru",
    "event_set": "event_set",
    "event_image": "event_image",
    "event_image_vae": "event_image_vae",
    "rgb": "rgb",
}


def options(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


GROUPS = sorted(path.name for path in CONF.iterdir() if path.is_dir() and path.name != "hydra")
CHOICES = [
    f"{group}={option}"
    for group in GROUPS
    if group not in ("exp", "length", "job", "axes", "claims")  # of studies, whose experiments are tried
    for option in options(group)
]


@pytest.fixture(scope="module")
def values():
    return compose("+exp=bytestream")


def changed(values: dict, key: str, value: object) -> dict:
    section, _, name = key.rpartition(".")
    return {**values, section: {**values[section], name: value}} if section else {**values, name: value}


# Where the length of a training is chosen -> an experiment that chooses it there; the others as bytestream.
OF_EACH_LENGTH = {"budget": "bytestream"} | {
    match[1]: file.stem
    for file in sorted((CONF / "exp").glob("*.yaml"))
    if (match := re.search(r"(?:length: \$\{budget\}_|override /algo: )(\w+)", file.read_text()))
}


@pytest.mark.parametrize("exp", options("exp"))
def test_every_experiment_is_accepted_and_names_its_job(exp):
    config = parse(compose(f"+exp={exp}"))
    assert config.job == JOBS.get(exp, "pipeline" if exp in POLICIES else exp)


def test_every_job_has_a_module_whose_settings_are_those_of_its_file():
    for name, job in JOBS_THERE.items():
        keys, settings = job.own_keys(), job.settings()
        fields = [] if settings is None else [field.name for field in dataclasses.fields(settings)]
        assert (name, sorted(keys)) == (name, sorted(fields))
        assert callable(importlib.import_module(job.module).run)
        text = job.file.read_text()
        assert not keys or f"Fields: {settings.__module__}.Settings." in text.splitlines()[1]
        said = text.rpartition(f"\n{name}:\n")[2].splitlines() if keys else []
        assert [line for line in said if "#" not in line and not line.startswith("    ")] == []
        assert job.summary


@pytest.mark.parametrize(
    ("words", "rule"),
    [
        (
            ["env.vehicle=point_mass"],
            r"env.vehicle: must have discrete actions, .*the actions of 'point_mass' are",
        ),
        (["env.vehicle=boat"], r"env.vehicle: must be one of kinematic, point_mass, .*got 'boat'"),
        (["env.vehicle=point_mass", "+env.body.tau=1"], r"env.body has no 'tau'; it has command, "),
        (["+env.body.tau_s=1"], r"env.body must be empty for vehicle 'kinematic'"),
        (
            ["vehicle=point_mass", "algo=imitation", "algo.teacher_sight_m=20"],
            r"algo.teacher_sight_m: must be null for vehicle 'point_mass', .*got 20",
        ),
        (
            ["vehicle=point_mass", "train.conditions=[{env.body.primitives: 5}]"],
            r"env.body.primitives: must be the same for all of a training",
        ),
        (["env.task=race"], r"env.task: must be one of corridor, got 'race'"),
    ],
)
def test_a_vehicle_that_jobs_cannot_fly_is_refused(words, rule):
    assert parse(compose("+exp=event_columns", "env.vehicle=point_mass", "+env.body.primitives=3"))
    assert parse(compose("+exp=event_columns", "vehicle=crazyflie")).env.vehicle == "crazyflie"
    with pytest.raises(ConfigError, match=rule):
        parse(compose("+exp=event_columns", *words))


@pytest.mark.parametrize("budget", ["smoke", "short"])
@pytest.mark.parametrize("name", [name for name, job in JOBS_THERE.items() if job.own_keys()])
def test_a_configuration_is_the_core_and_the_section_of_its_job(name, budget):
    values = compose("+exp=event_columns", f"job={name}", f"budget={budget}")
    others = [other for other, job in JOBS_THERE.items() if job.own_keys() and other != name]
    assert [key for key in others if key in values] == []
    config = parse(values)
    assert dataclasses.asdict(config.own) == values[name]
    assert parse(as_dict(config)) == config
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
        (["+exp=trade", "trade.trials=3"], ["job=trade", "trade.trials=3"]),
        (["+exp=tune", "~tune.space", "+tune.space={}"], ["job=search", "~search.space", "+search.space={}"]),
        (["ship"], ["job=publish"]),
        (["+exp=event_columns", "job=tune"], ["+exp=event_columns", "job=search"]),
        (["video_events", "video.path=a.mp4"], ["job=video_events", "video_events.path=a.mp4"]),
        (["demo", "a b.onnx", "seed=1"], ["job=demo", "demo.policy='a b.onnx'", "seed=1"]),
        (["replay", "day.raw", "rgb-s0"], ["job=replay", "replay.recording=day.raw", "replay.policy=rgb-s0"]),
        (["demo", "--cfg", "job"], ["job=demo", "--cfg", "job"]),
        (["demo", "rgb-s0", "more"], ["job=demo", "demo.policy=rgb-s0", "more"]),
        (["train", "more"], ["+exp=train", "more"]),
        (["seed"], ["seed"]),
        (["--help"], ["--help"]),
        (["+exp=mine", "-cd", "here"], ["+exp=mine", "-cd", "here"]),
        ([], []),
    ],
)  # fmt: skip
def test_a_job_is_called_by_its_name_and_by_the_names_that_it_had(words, meant):
    assert hydra_words(words) == meant


WORDS = ("my_policy.py:policy", "a b.onnx", "it's, [here].csv", r"C:\a b", r"back\'slash", "end\\", "rgb-s1")


@pytest.mark.parametrize("word", WORDS)
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


def given_keys() -> set[str]:
    """Return the keys that the files give, with every model and every algorithm."""
    choices = [choice for choice in CHOICES if choice.startswith(("model=", "algo="))]
    given = set()
    for values in (compose("+exp=bytestream", choice) for choice in choices):
        sections = {group: section for group, section in values.items() if isinstance(section, dict)}
        given |= {*values, *(f"{group}.{key}" for group, section in sections.items() for key in section)}
    return given


def test_no_key_is_given_without_being_checked_nor_checked_without_being_given():
    given = given_keys()
    assert given == {*known_keys()}


@pytest.mark.parametrize(
    "file", sorted(path for path in CONF.rglob("*.yaml") if path.parent.name not in ("exp", "help"))
)
def test_every_value_says_its_unit_or_source_in_a_comment(file):
    lines = file.read_text().splitlines()
    assert lines[0].startswith("#")
    if file.parent != CONF and file.parent.name not in ("budget", "length", "job", "claims"):
        assert [line for line in lines[1:] if ": " in line and "#" not in line and "name:" not in line] == []


@pytest.mark.parametrize(
    "file",
    sorted(
        path
        for path in CONF.rglob("*.yaml")
        if path.parent.name not in ("exp", "help", "budget", "length", "axes", "claims")
        and not path.read_text().startswith("# @package _global_")  # keys of several groups
    ),
)
def test_every_group_names_the_class_that_its_keys_are_fields_of(file):
    text = file.read_text()
    values = yaml.safe_load(text)
    groups = {file.parent.name: values}
    if file.parent == CONF:
        groups = {key: group for key, group in values.items() if isinstance(group, dict) and key != "hydra"}
    classes = re.findall(r"Fields: ([\w.]+)\.(\w+)", text)
    assert len(classes) == len(groups)
    for (module, name), group in zip(classes, groups.values(), strict=True):
        fields = {field.name for field in dataclasses.fields(getattr(importlib.import_module(module), name))}
        assert group.keys() - {"defaults"} <= fields


def test_ppo_is_the_papers():
    algo = parse(compose("+exp=bytestream", "budget=paper", "algo=ppo")).algo
    assert dataclasses.asdict(algo) == {
        "lr": 3e-4,
        "lr_schedule": "constant",
        "gamma": 0.99,
        "lambda_": 0.95,
        "clip_param": 0.2,
        "num_epochs": 10,
        "minibatch_size": 32,
        "train_batch_size_per_learner": 2048,
        "vf_loss_coeff": 0.5,
        "entropy_coeff": 0.0,
        "grad_clip": 0.5,
        "reward_scale": 1.0,
        "num_env_runners": 0,
        "num_envs_per_env_runner": 16,
        "critic": "observation",
        "shaping": 0.0,
        "imitation": None,
        "mirrored": False,
        "teacher_sight_m": None,
    }


OF_EXPERIMENTS = (
    "_ablation",
    "_claims",
    "_compared",
    "_first",
    "long",
    "_hold",
    "_body",
    *(f"_{job}" for job in JOBS_THERE),
)  # lengths that name an experiment instead of an algorithm


@pytest.mark.parametrize("length", [name for name in options("length") if not name.endswith(OF_EXPERIMENTS)])
def test_an_algorithm_trains_as_long_as_it_needs_in_each_budget(length):
    budget, _, algo = length.partition("_")
    told = compose("+exp=event_columns", f"budget={budget}", f"algo={algo}")
    own = yaml.safe_load((CONF / "length" / f"{length}.yaml").read_text())
    assert own["train"].items() <= told["train"].items()
    assert parse(told).algo.imitation is not None
    assert (
        compose("+exp=event_columns", f"budget={budget}", f"algo={algo}", "train.env_steps=7")["train"][
            "env_steps"
        ]
        == 7
    )


def test_an_experiment_with_a_length_of_its_own_is_as_short_as_others_in_a_smoke_test():
    own, usual = (
        compose(f"+exp={name}", "budget=smoke") for name in ("bytestream_hold", "bytestream_imitation")
    )
    assert own["train"]["env_steps"] == usual["train"]["env_steps"]
    assert own["algo"]["imitation"]["final_steps"] == usual["algo"]["imitation"]["final_steps"]
    short = compose("+exp=bytestream_hold")
    assert short["train"]["env_steps"] > compose("+exp=bytestream_imitation")["train"]["env_steps"]


def test_wrong_settings_of_imitation_are_refused_by_name():
    values = compose("+exp=bytestream", "algo=imitation")
    values["algo"]["imitation"] |= {"temperature": 0.0, "fit_steps": 0.5}
    with pytest.raises(
        ConfigError, match=r"^algo\.imitation: temperature: .*got 0\.0; fit_steps: .*got 0\.5$"
    ):
        parse(values)


def test_the_stages_of_an_experiment_share_its_run_folder():
    stages = ("bytestream", "collect", "pretrain", "train", "evaluate")
    assert len({run_name(parse(compose(f"+exp={stage}"))) for stage in stages}) == 1


@pytest.mark.parametrize(("exp", "name"), POLICIES.items())
def test_every_kind_of_policy_has_an_experiment_whose_stages_share_a_folder_of_its_name(exp, name):
    jobs = ("pipeline", "train", "evaluate", "collect")
    configs = [parse({**compose(f"+exp={exp}", "budget=short"), "job": job}) for job in jobs]
    assert [(config.job, config.model.name) for config in configs] == [(job, name) for job in jobs]
    (folder,) = {run_name(config) for config in configs}
    assert folder.startswith(f"{exp}-short-s0-")


@pytest.mark.parametrize("name", sorted(KINDS))
def test_a_kind_has_the_settings_of_its_parts_and_no_others(name):
    values, usual = compose("+exp=bytestream", f"model={name}"), compose("+exp=bytestream")["model"]
    own = model_keys(name)
    assert list(values["model"]) == own
    for key in own:
        if key != "name":
            with pytest.raises(ConfigError, match=rf"^model\.{key}: .*got None"):
                parse(changed(values, f"model.{key}", None))
    for key in usual.keys() - {*own}:
        with pytest.raises(
            ConfigError, match=rf"^model\.{key}: no such key, got .*; this kind of model has none"
        ):
            parse(changed(values, f"model.{key}", usual[key]))


@pytest.mark.parametrize("name", ["bytestream_xy", "event_image_vae"])
def test_eventnets_coding_is_an_error_where_there_is_no_time(name):
    with pytest.raises(ConfigError, match=f"coding must be additive or none for {name}.*got 'eventnet'"):
        parse(compose("+exp=bytestream", f"model={name}", "model.coding=eventnet"))
    assert parse(compose("+exp=bytestream", "model.coding=eventnet")).model.coding == "eventnet"


def test_an_encoder_learns_on_only_where_its_events_can_be_kept():
    assert parse(compose("+exp=bytestream_finetuned")).model.encoder == "finetuned"
    with pytest.raises(
        ConfigError, match="encoder must be frozen for event_image_vae; bytestream, bytestream_xy can be"
    ):
        parse(compose("+exp=event_image_vae", "model.encoder=finetuned"))
    with pytest.raises(ConfigError, match="time_bins must be at most 32768 for encoder=finetuned, got 40000"):
        parse(compose("+exp=bytestream_finetuned", "model.time_bins=40000"))


def test_a_whole_number_names_the_same_run_as_its_float():
    words = ("env.control_hz=100", "env.control_hz=100.0")
    assert len({run_name(parse(compose("+exp=bytestream", word))) for word in words}) == 1


def test_a_configuration_survives_being_written_and_read(values):
    config = parse(values)
    assert parse(yaml.safe_load(yaml.safe_dump(as_dict(config), sort_keys=False))) == config


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), "fast", True, None, [1.0], {}])
@pytest.mark.parametrize("key", ["algo.lr", "env.control_hz", "camera.contrast_threshold", "faults.sparsity"])
def test_no_number_may_be_anything_but_a_finite_number(values, key, value):
    with pytest.raises(ConfigError, match=f"^{key}: "):
        parse(changed(values, key, value))


@pytest.mark.parametrize(
    ("key", "value", "rule"),
    [
        ("env.control_hz", -1, "greater than or equal to 0.1, got -1"),
        ("env.speed_mps", 0, "greater than 0, got 0"),
        ("camera.width", 4097, "less than or equal to 4096, got 4097"),
        ("camera.memory", "none", "'reference', 'frame' or 'legacy', got 'none'"),
        ("faults.sparsity", 1.2, "less than or equal to 1, got 1.2"),
        ("algo.minibatch_size", 4096, "must not exceed train_batch_size_per_learner"),
        ("algo.minibatch_size", 0, "greater than or equal to 1, got 0"),
        ("seed", -1, "greater than or equal to 0, got -1"),
        ("seed", 1.5, "valid integer, got 1.5"),
        ("seed", 2**31, "less than 2147483648, got 2147483648"),
        ("job", "os.system", "got 'os.system'"),
        ("exp", "../up", "got '../up'"),
        ("evaluate.renderers", [], "at least 1 item"),
        (
            "study.axes",
            {"rate": {"env.control_hz": [100.0, 0.0]}},
            "rate: env.control_hz=0.0: Input should be",
        ),
        ("study.axes", {"rate": {}}, "study.axes.rate: Dictionary should have at least 1 item"),
        ("study.axes", {"rate": {"env.control_hz": []}}, "rate.env.control_hz: List should have at least 1"),
        (
            "study.axes",
            {"rate": {"env.control_hz": [float("nan")]}},
            "must be a finite number, a word or null",
        ),
        ("study.axes", {"a/b": {"env.control_hz": [1]}}, "String should match pattern"),
        (
            "study.axes",
            {"nominal": {"faults.sparsity": [0.5]}},
            "study.axes.nominal: must have another name, this one is of the condition that changes nothing",
        ),
        (
            "study.axes",
            {"where": {"env.scene": ["moon"]}},
            "study.axes: must be one of cones, dynamic, gates",
        ),
        ("env.camera", {"width": 64}, "env.camera: "),
        ("camera", 64, "must be a group of settings, got 64"),
        ("env", None, "must be a group of settings, got None"),
        ("env.contrast_treshold", 0.2, "no such key, got 0.2; did you mean camera.contrast_threshold?"),
        ("sed", 1, "no such key, got 1; did you mean seed?"),
        ("env.split", "eval", "env.split: no such key, got 'eval'; every job chooses it itself"),
        ("env.observation", "luminance", "no such key, got 'luminance'; every job chooses it itself"),
        ("env.scene", "moon", "env.scene: must be one of cones, dynamic, gates, "),
        ("study.scene", "moon", "study.scene: must be one of cones, dynamic, gates, "),
        (
            "collect.scenes",
            ["poles", "moon"],
            "collect.scenes: must be one of cones, dynamic, gates, poles, ",
        ),
        ("collect.scenes", [], "must name a scene where collect.recordings is empty, got []"),
        ("env.layout", {"num_obstacles": 100_000}, "num_obstacles=100000 cannot be placed 2.0 m apart"),
        ("env.layout", {"num_obstacles": 2.5}, "num_obstacles must be a whole number"),
        ("env.layout", {"num_pole": 3}, "has no 'num_pole'"),
        ("env.layout", {"name": 3}, "has no 'name'"),
        ("model.name", "snn", f"must be one of {', '.join(KINDS)}, got 'snn'"),
        ("model.name", "eip", "which is called event_image now"),
        ("train.conditions", [{"env.scene": "moon"}], "train.conditions: must be one of cones, "),
        ("train.conditions", [], "at least 1 item"),
        ("model.coding", "phase", "'additive', 'eventnet' or 'none', got 'phase'"),
    ],
)
def test_a_configuration_error_names_the_key_the_rule_and_the_value(values, key, value, rule):
    values = compose("+exp=robustness") if key.startswith("study.") else values
    with pytest.raises(ConfigError) as error:
        parse(changed(values, key, value))
    assert str(error.value).startswith(key.partition(".")[0])
    assert rule in str(error.value)
    assert len(str(error.value).splitlines()) == 1


@pytest.mark.parametrize("exp", ["event_image", "event_image_vae", "rgb"])
def test_an_image_too_small_for_the_network_is_an_error(exp):
    rule = f"camera.width: must be at least 36 for the network of {POLICIES[exp]}, got 35"
    with pytest.raises(ConfigError, match=f"^{re.escape(rule)}$"):
        parse(compose(f"+exp={exp}", "camera.width=35"))
    parse(compose(f"+exp={exp}", "camera.width=36"))
    parse(compose("+exp=event_columns", "camera.width=35"))


def test_all_errors_come_at_once(values):
    with pytest.raises(ConfigError) as error:
        parse(changed(changed(changed(values, "seed", -1), "algo.lr", -1.0), "env.control_hz", -1.0))
    keys = [line.partition(":")[0] for line in str(error.value).splitlines()]
    assert sorted(keys) == ["algo.lr", "env.control_hz", "seed"]


def test_what_jobs_set_is_no_key_and_reaches_no_run(values):
    assert {f"env.{name}" for name in SET_BY_JOBS}.isdisjoint(known_keys())
    config = parse(values)
    assert set(as_dict(config)["env"]).isdisjoint(SET_BY_JOBS)
    assert (config.env.split, config.env.observation) == ("train", "window")


def test_every_known_key_can_be_replaced():
    keys = known_keys()
    assert {"seed", "env.control_hz", "camera.memory", "algo.lambda_"} <= set(keys)
    assert {*keys} <= given_keys()
