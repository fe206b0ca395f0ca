import dataclasses
import json

import pytest

from envs.config import CameraConfig, EnvConfig, FidelityConfig, sensor_settings
from jobs.config.conditions import NOMINAL
from jobs.config.config import ConfigError
from jobs.rollout.policies import PRETRAINED, find_study_policies, read_policy, with_sensor
from jobs.rollout.tasks import text_of
from jobs.run.folder import open_run
from jobs.study.plan import plan_study, was_met
from jobs.study.record import _compared as compared
from models.policy.policy import MANIFEST, read_policy_manifest
from tests.support.configs import AXES, sweep_config
from tests.support.policies import save_training
from tests.support.runs import planned

OTHER_CAMERA = {"threshold_mismatch": 0.03, "threshold_seed": 1, "response": "lin_log", "encoding": "linear8"}


def at(sweep, axis, value):
    (task,) = [task for task in sweep.tasks if task.condition == (axis, value)]
    return task


def test_axes_change_their_settings_alone_and_share_the_unchanged_task(tmp_path):
    config = sweep_config(tmp_path)
    sweep = planned(config, save_training(tmp_path / "policy", "a", 0, config.env))
    assert sweep.conditions == [
        (NOMINAL, "poles_eval"), ("sparsity", 0), ("sparsity", 0.5), ("rate", 100), ("rate", 200)
    ]  # fmt: skip
    usual = at(sweep, NOMINAL, "poles_eval")
    assert usual.key == at(sweep, "sparsity", 0).key == at(sweep, "rate", 200).key
    sparse = dataclasses.replace(usual.env.faults, sparsity=0.5)
    assert at(sweep, "sparsity", 0.5).env == dataclasses.replace(usual.env, faults=sparse)
    assert at(sweep, "rate", 100).env == dataclasses.replace(usual.env, control_hz=100.0)
    assert len({task.key for task in sweep.tasks}) == 3
    assert all(task.env.split == "eval" and task.seeds == (0, 1) for task in sweep.tasks)


def test_faults_change_no_accuracy_and_anything_else_does(tmp_path):
    sweep = planned(sweep_config(tmp_path), "straight", "oracle")
    usual, sparse, slow = (
        {task.simulation for task in sweep.tasks if task.condition == label}
        for label in ((NOMINAL, "poles_eval"), ("sparsity", 0.5), ("rate", 100))
    )
    assert usual == sparse != slow
    assert len(usual) == 1


def test_another_policy_is_another_task(tmp_path):
    config = sweep_config(tmp_path)
    one = save_training(tmp_path / "one", "a", 0, config.env)
    keys = {planned(config, name).tasks[0].key for name in ("straight", "oracle", one)}
    manifest = read_policy_manifest(tmp_path / "one" / MANIFEST)
    (tmp_path / "one" / MANIFEST).write_text(json.dumps({**manifest, "sha256": {}}))
    assert len(keys | {planned(config, one).tasks[0].key}) == 4


def test_what_an_agent_does_not_see_makes_no_task_of_its_own(tmp_path):
    axes = {
        **AXES,
        "threshold": {"camera.contrast_threshold": [0.2, 0.4]},
        "exactness": {"fidelity.samples": [1, 8]},
    }
    config = sweep_config(tmp_path, axes=axes)
    agents = [save_training(tmp_path / name, name, 0, config.env, name) for name in ("rgb", "event_image")]
    sweep = planned(config, "straight", *agents)
    keys = {
        group: {task.condition: task.key for task in sweep.tasks if task.policy.group == group}
        for group in sweep.groups
    }
    assert {group: len(set(found.values())) for group, found in keys.items()} == {
        "straight": 2,  # the rate alone
        "rgb": 4,  # and what a picture shows
        "event_image": 6,
    }
    assert keys["rgb"]["exactness", 8] != keys["rgb"][NOMINAL, "poles_eval"]
    errors = {task.simulation for task in sweep.tasks if task.condition == ("threshold", 0.4)}
    assert len(errors) == 1, "the condition is the same for all"


def test_a_policy_of_another_rate_is_compared_at_its_own_and_shares_only_what_is_the_same_for_all(tmp_path):
    dense = {"env.control_hz": [100, 200], "env.scene": ["poles_dense"]}
    config = sweep_config(tmp_path, axes={**AXES, "rate_dense": dense})
    usual, slow = (
        save_training(tmp_path / f"{hz}", f"at_{hz}", 0, dataclasses.replace(config.env, control_hz=hz))
        for hz in (200.0, 100.0)
    )
    alone, both = planned(config, usual, "straight"), planned(config, usual, "straight", slow)
    nominal = (NOMINAL, "poles_eval")
    assert alone.own_baselines == {}
    assert alone.baselines["rate_dense", 100] == both.baselines["rate_dense", 100] == ("rate_dense", 200)
    assert both.own_baselines.keys() == {"at_100.0"}
    own = both.own_baselines["at_100.0"]
    assert own["rate_dense", 100] == own["rate_dense", 200] == ("rate_dense", 100)
    assert {own[axis, value] for axis, value in both.conditions if axis != "rate_dense"} == {nominal}
    assert (alone.same_as["rate", 200], both.same_as["rate", 200]) == (nominal, ("rate", 200))
    assert alone.same_as["sparsity", 0] == both.same_as["sparsity", 0] == nominal
    told = {at: compared(both, at) for at in both.conditions}
    assert told["rate_dense", 200]["own_baseline"] == {"at_100.0": ["rate_dense", "100"]}
    assert "own_baseline" not in told["sparsity", 0.5]


def test_a_policy_keeps_its_own_sensor_with_an_axis_changed_on_it(tmp_path):
    config = sweep_config(tmp_path)
    trained = dataclasses.replace(config.env, control_hz=100.0, camera=CameraConfig(memory="frame"))
    agent = save_training(tmp_path / "policy", "a", 0, trained)
    sweep = planned(config, agent, "straight")
    assert sweep.differences == {agent: {"control_hz": (100.0, 200.0), "memory": ("frame", "reference")}}
    own = sensor_settings(trained)
    used = {task.condition: sensor_settings(task.env) for task in sweep.tasks if task.policy.agent == agent}
    assert used[NOMINAL, "poles_eval"] == used["sparsity", 0.5] == used["rate", 100] == own
    assert used["rate", 200] == {**own, "control_hz": 200.0}
    ours = [task.env for task in sweep.tasks if task.policy.agent == "straight"]
    assert {env.camera.memory for env in ours} == {"reference"}


def test_an_own_sensor_that_an_axis_excludes_is_refused_with_both_named(tmp_path):
    config = sweep_config(tmp_path, axes={"dead_time": {"camera.refractory_us": [0, 10]}})
    agent = save_training(
        tmp_path / "policy", "a", 0, dataclasses.replace(config.env, camera=CameraConfig(memory="frame"))
    )
    with pytest.raises(ConfigError, match=r"^study\.axes\.dead_time: .*refractory_us.* 10.*got 10$"):
        planned(config, agent)


def test_every_sensor_setting_of_a_manifest_reaches_the_simulation():
    changed = {"luminance_floor": 1e-2, "max_events_per_pixel": 7, "contrast_threshold_off": 0.4}
    fidelity = FidelityConfig(0.1, max_step_m=0.05, samples=3, cull_m=40.0)
    usual, differ = sensor_settings(EnvConfig()), set()
    held = EnvConfig(camera=CameraConfig(refractory_us=10))
    for exclusive in ({"memory": "frame"}, {"refractory_us": 100}, {"excess": "carry"}):
        camera = CameraConfig(32, 48, 60.0, 0.3, **OTHER_CAMERA, **changed, **exclusive)
        other = EnvConfig(camera=camera, control_hz=50.0, speed_mps=5.0, fidelity=fidelity)
        sensor = json.loads(json.dumps(sensor_settings(other)))
        differ |= {name for name in usual if sensor[name] != usual[name]}
        assert sensor_settings(with_sensor(EnvConfig(), sensor)) == sensor
        assert sensor_settings(with_sensor(held, sensor)) == sensor
    assert differ == set(usual)


def test_policies_of_one_group_stand_together_by_their_training_seed(tmp_path):
    config = sweep_config(tmp_path)
    folder, env = open_run(config), config.env
    for place, group, seed in (("x", "b", 1), ("y", "a", 0), ("z", "b", 0)):
        save_training(tmp_path / "pretrained" / place, group, seed, env)
    named = sweep_config(tmp_path, policies=["pretrained", "oracle", "pretrained"])
    policies = find_study_policies(named, folder, tmp_path / "pretrained")
    assert [(policy.group, policy.training) for policy in policies] == [
        ("b", 0),
        ("b", 1),
        ("a", 0),
        ("oracle", None),
    ]
    assert plan_study(named, policies).groups == {"b": [0, 1], "a": [0], "oracle": [None]}


def test_a_policy_without_an_experiment_is_of_the_group_of_its_kind(tmp_path):
    agent = save_training(tmp_path / "policy", "x", 5, EnvConfig())
    manifest = read_policy_manifest(tmp_path / "policy" / MANIFEST)
    del manifest["exp"]
    (tmp_path / "policy" / MANIFEST).write_text(json.dumps(manifest))
    assert read_policy(agent).group == "event_columns"


def test_a_policy_is_named_by_its_folder_its_run_folder_or_as_the_newest(tmp_path):
    config = sweep_config(tmp_path)
    folder = open_run(config)
    path = save_training(tmp_path / "runs" / "trained" / "policy", "a", 0, config.env, "bytestream")
    for name in ("newest", path, path.removesuffix("/policy")):
        (policy,) = find_study_policies(sweep_config(tmp_path, policies=[name]), folder)
        assert policy.agent == path


def test_a_policy_is_found_by_its_name_in_the_pretrained_folder(tmp_path):
    config = sweep_config(tmp_path, policies=["one"])
    path = save_training(tmp_path / "pretrained" / "one", "a", 0, config.env)
    (policy,) = find_study_policies(config, open_run(config), tmp_path / "pretrained")
    assert policy.agent == path


def test_a_group_of_the_pretrained_folder_is_all_its_trainings_and_no_other_group(tmp_path):
    config = sweep_config(tmp_path, policies=["a", "straight"])
    for place, group, seed in (("a-s1", "a", 1), ("a-set-s0", "a-set", 0), ("a-s0", "a", 0)):
        save_training(tmp_path / "pretrained" / place, group, seed, config.env)
    policies = find_study_policies(config, open_run(config), tmp_path / "pretrained")
    assert [(policy.group, policy.training) for policy in policies] == [
        ("a", 0),
        ("a", 1),
        ("straight", None),
    ]


def test_policies_that_are_not_there_are_refused_with_the_remedy(tmp_path):
    folder = open_run(sweep_config(tmp_path))

    def refusal(*names):
        with pytest.raises(ConfigError) as refused:
            find_study_policies(sweep_config(tmp_path, policies=names), folder, tmp_path / "none")
        return str(refused.value)

    assert refusal("pretrained").startswith("study.policies: 'pretrained' means the policies in ")
    assert "train one (python -m platform.launch +exp=bytestream)" in refusal("pretrained")
    assert refusal("pretrained").endswith("study.policies=[newest]")
    assert refusal(str(tmp_path)).startswith("study.policies: must be 'pretrained', 'newest', ")
    assert refusal(str(tmp_path)).endswith(f"got {str(tmp_path)!r}")
    one, two = (save_training(tmp_path / name, "a", 0, EnvConfig(), kind) for name, kind in (
        ("one", "event_columns"), ("two", "event_image")
    ))  # fmt: skip
    assert refusal(one, two).startswith("study.policies: two policies are a with training seed 0, got ")
    (tmp_path / "one" / MANIFEST).write_text("{}")
    assert "lacks ['name', 'seed', 'sensor']; train it again" in refusal(one)


@pytest.mark.parametrize(
    ("value", "label"),
    [(45, "45"), (0.05, "0.05"), (0.12345678, "0.12345678"), ("frame", "frame"), (None, "null")],
)
def test_a_value_is_told_from_every_other_by_its_label(value, label):
    assert text_of(value) == label


def test_a_policy_whose_manifest_names_no_conditions_met_the_scene_of_training_and_a_baseline_none():
    old, baseline = read_policy(str(PRETRAINED / "bytestream-s0")), read_policy("straight")
    assert "conditions" not in read_policy_manifest(PRETRAINED / "bytestream-s0" / MANIFEST)
    nominal, trained_in = EnvConfig(scene="poles_eval"), EnvConfig(scene="poles")
    assert was_met(old, nominal, trained_in)
    assert not was_met(old, nominal, EnvConfig(scene="poles_dense"))
    assert not was_met(baseline, nominal, trained_in)
