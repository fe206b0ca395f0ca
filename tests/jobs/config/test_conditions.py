import pydantic
import pytest

from envs.config import EnvConfig
from jobs.config.conditions import (
    CONDITION_KEYS,
    axis_errors,
    axis_numbers,
    axis_points,
    condition_errors,
    moving_settings,
)
from jobs.config.env_keys import env_with


def errors_of(axis):
    return axis_errors({"here": axis}, EnvConfig())


def test_settings_of_the_world_can_be_replaced_by_their_keys():
    assert env_with(EnvConfig(), {"env.control_hz": 45.0}).control_hz == 45.0
    changed = env_with(EnvConfig(), {"camera.memory": "frame", "camera.width": 32, "renderer": "pyrender"})
    assert (changed.camera.memory, changed.camera.width, changed.renderer) == ("frame", 32, "pyrender")
    assert changed.camera.height == 64


def test_settings_that_exclude_each_other_are_replaced_together():
    held = env_with(EnvConfig(), {"camera.refractory_us": 10})
    both = {"camera.memory": "frame", "camera.refractory_us": 0}
    with pytest.raises(pydantic.ValidationError):
        env_with(held, {"camera.memory": "frame"})
    assert env_with(held, both).camera.memory == "frame"


def test_settings_of_an_axis_go_together_and_a_single_value_stays():
    points = axis_points({"env.control_hz": [45, 200], "faults.sparsity": [0.5, 0.0], "env.scene": ["poles"]})
    assert points == [
        {"env.control_hz": 45, "faults.sparsity": 0.5, "env.scene": "poles"},
        {"env.control_hz": 200, "faults.sparsity": 0.0, "env.scene": "poles"},
    ]


@pytest.mark.parametrize(
    ("axis", "reason"),
    [
        (
            {"env.control_hz": [45, 100], "faults.sparsity": [0.0, 0.1, 0.2]},
            "settings must have equally many values, or one, got {'env.control_hz': 2, 'faults.sparsity': 3}",
        ),
        (
            {"env.scene": ["poles"], "env.control_hz": [45, 100]},
            "env.scene comes first, so it must differ at each of 2 points, got ['poles']",
        ),
        (
            {"env.control_hz": [45, 45.0]},
            "env.control_hz comes first, so it must differ at each of 2 points, got [45, 45.0]",
        ),
        ({"algo.lr": [1.0]}, "algo.lr: no such setting, got [1.0]; --cfg job shows every key"),
        (
            {"camera.memry": ["frame"]},
            "camera.memry: no such setting, got ['frame']; did you mean camera.memory?",
        ),
        ({"env.split": ["train"]}, "env.split: no such setting, got ['train']; every job chooses it itself"),
        ({"camera": [0.2]}, "camera: no such setting, got [0.2]; --cfg job shows every key"),
        ({"faults.sparsity": [0.0, 2.0]}, "faults.sparsity=2.0: Input should be less than or equal to 1"),
        ({"env.control_hz": ["fast"]}, "env.control_hz='fast': Input should be a valid number"),
        ({"env.control_hz": [None]}, "env.control_hz=None: Input should be a valid number"),
        (
            {"camera.memory": ["frame"], "camera.refractory_us": [10]},
            "camera.memory='frame', camera.refractory_us=10: Value error, "
            "needs memory 'reference' or must be 0, got 10",
        ),
    ],
)
def test_a_setting_that_is_not_valid_gives_one_line_that_names_key_and_value(axis, reason):
    assert errors_of(axis) == [f"sweep.axes.here: {reason}"]


def test_each_bad_value_has_its_line():
    assert len(errors_of({"env.control_hz": [45, 0, -1]})) == 2


def test_every_key_that_an_axis_may_hold_is_a_field_of_the_simulation():
    for key in CONDITION_KEYS:
        section, _, name = key.rpartition(".")
        owner = EnvConfig() if section in ("", "env") else getattr(EnvConfig(), section)
        assert hasattr(owner, name), key


def test_an_axis_of_numbers_changes_one_setting_and_no_words():
    slow, fast = {"env.control_hz": 45, "env.scene": "poles"}, {"env.control_hz": 200, "env.scene": "poles"}
    assert axis_numbers({"45": slow, "200": fast}) == {"45": 45.0, "200": 200.0}
    assert moving_settings({"45": slow, "200": fast}) == ["env.control_hz"]
    assert axis_numbers({"45": slow, "200": {**fast, "env.scene": "dynamic"}}) is None
    assert axis_numbers({"poles": {"env.scene": "poles"}, "dynamic": {"env.scene": "dynamic"}}) is None


def test_conditions_of_a_training_have_an_error_for_each_line_and_keep_the_networks_image():
    conditions = [{}, {"faults.sparsity": 2.0}, {"env.hz": 5}, {"camera.width": 32}]
    assert condition_errors(conditions, EnvConfig()) == [
        "train.conditions[1]: faults.sparsity=2.0: Input should be less than or equal to 1",
        "train.conditions[2]: env.hz: no such setting, got 5; --cfg job shows every key",
        "train.conditions[3]: camera.width: must be the same for all of a training, got 32",
    ]
    assert condition_errors([{}, {"faults.sparsity": 0.5, "env.control_hz": 100}], EnvConfig()) == []
