import dataclasses
import json

import pytest

from envs.config import CameraConfig, EnvConfig, FidelityConfig, sensor_settings
from jobs.config.conditions import NOMINAL
from jobs.config.config import ConfigError
from jobs.rollout import policies
from jobs.rollout.policies import find_study_policies, read_policy, with_sensor
from jobs.run.folder import open_run
from jobs.study.plan import plan_study
from jobs.study.record import _compared as compared
from models.policy.policy import MANIFEST, read_policy_manifest
from tests.support.configs import AXES, sweep_config
from tests.support.policies import save_training
from tests.support.runs import planned

OTHER_CAMERA = {"threshold_mismatch": 0.03, "threshold_seed": 1, "response": "lin_log", "encoding": "linear8"}


def test_axes_change_their_settings_alone_and_share_the_unchanged_task(tmp_path):
    config = sweep_config(tmp_path)
    sweep = planned(config, save_training(tmp_path / "policy", "a", 0, config.env))
    found = {task.condition: task for task in sweep.tasks}
    usual = found[NOMINAL, "poles_eval"]
    sparse = dataclasses.replace(usual.env.faults, sparsity=0.5)
    envs = {
        (NOMINAL, "poles_eval"): usual.env,
        ("sparsity", 0): usual.env,
        ("sparsity", 0.5): dataclasses.replace(usual.env, faults=sparse),
        ("rate", 100): dataclasses.replace(usual.env, control_hz=100.0),
        ("rate", 200): usual.env,
    }
    assert sweep.conditions == list(envs)
    assert {at: task.env for at, task in found.items()} == envs
    assert len({task.key for task in sweep.tasks}) == 3
    assert usual.key == found["sparsity", 0].key == found["rate", 200].key
    assert all(task.env.split == "eval" and task.seeds == (0, 1) for task in sweep.tasks)


def test_another_policy_is_another_task(tmp_path):
    config = sweep_config(tmp_path)
    one = save_training(tmp_path / "one", "a", 0, config.env)
    keys = {planned(config, name).tasks[0].key for name in ("straight", "oracle", one)}
    manifest = read_policy_manifest(tmp_path / "one" / MANIFEST)
    (tmp_path / "one" / MANIFEST).write_text(json.dumps({**manifest, "sha256": {}}))
    assert len(keys | {planned(config, one).tasks[0].key}) == 4


def test_what_an_agent_does_not_see_makes_no_task_of_its_own(tmp_path):
    thresholds, exact = {"camera.contrast_threshold": [0.2, 0.4]}, {"fidelity.samples": [1, 8]}
    config = sweep_config(tmp_path, axes={**AXES, "threshold": thresholds, "exactness": exact})
    agents = [save_training(tmp_path / name, name, 0, config.env, name) for name in ("rgb", "event_image")]
    sweep = planned(config, "straight", *agents)
    keys = {
        group: {task.condition: task.key for task in sweep.tasks if task.policy.group == group}
        for group in sweep.groups
    }
    different = {group: len(set(found.values())) for group, found in keys.items()}
    assert different == {"straight": 2, "rgb": 4, "event_image": 6}  # rates; what a picture shows; all
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
    framed = dataclasses.replace(config.env, camera=CameraConfig(memory="frame"))
    with pytest.raises(ConfigError, match=r"^study\.axes\.dead_time: .*refractory_us.* 10.*got 10$"):
        planned(config, save_training(tmp_path / "policy", "a", 0, framed))


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


NAMED = [
    (["pretrained", "oracle", "pretrained"], {"a": [0, 1], "a-set": [0], "oracle": [None]}),
    (["a", "straight"], {"a": [0, 1], "straight": [None]}),
    (["a-s1"], {"a": [1]}),
]


@pytest.mark.parametrize(("names", "groups"), NAMED)
def test_pretrained_policies_stand_by_their_groups_and_training_seeds_each_once(
    tmp_path, monkeypatch, names, groups
):
    config = sweep_config(tmp_path, policies=names)
    for place, group, seed in (("a-s1", "a", 1), ("a-set-s0", "a-set", 0), ("a-s0", "a", 0)):
        save_training(tmp_path / "pretrained" / place, group, seed, config.env)
    monkeypatch.setattr(policies, "PRETRAINED", tmp_path / "pretrained")
    found = find_study_policies(config, open_run(config))
    named = [(group, seed) for group, seeds in groups.items() for seed in seeds]
    assert [(policy.group, policy.training) for policy in found] == named
    assert plan_study(config, found).groups == groups


def test_policies_that_are_not_there_are_refused_with_the_remedy(tmp_path, monkeypatch):
    monkeypatch.setattr(policies, "PRETRAINED", tmp_path / "none")
    folder = open_run(sweep_config(tmp_path))
    kinds = ("event_columns", "event_image")
    one, two = (save_training(tmp_path / name, "a", 0, EnvConfig(), name) for name in kinds)
    damaged = save_training(tmp_path / "damaged", "b", 0, EnvConfig())
    (tmp_path / "damaged" / MANIFEST).write_text("{}")
    train = r"'pretrained' means the policies in .* train one \(python -m platform.launch \+exp=bytestream\)"
    for names, rule in {
        ("pretrained",): rf"^study\.policies: {train} .* study\.policies=\[newest\]$",
        (str(tmp_path),): rf"^study\.policies: must be 'pretrained', 'newest', .*got '{tmp_path}'$",
        (one, two): "^study.policies: two policies are a with training seed 0, got ",
        (damaged,): r"lacks \['name', 'seed', 'sensor'\]; train it again",
    }.items():
        with pytest.raises(ConfigError, match=rule):
            find_study_policies(sweep_config(tmp_path, policies=names), folder)
