import numpy as np
import pydantic
import pytest

from envs.config import EnvConfig
from jobs.config.conditions import (
    Conditions,
    axis_errors,
    axis_numbers,
    axis_points,
    condition_errors,
    episode_draw,
    moving_settings,
)
from jobs.config.env_keys import env_with
from jobs.config.scenes import scene_errors


def test_settings_that_exclude_each_other_are_replaced_together():
    held = env_with(EnvConfig(), {"camera.refractory_us": 10})
    with pytest.raises(pydantic.ValidationError):
        env_with(held, {"camera.memory": "frame"})
    changed = env_with(held, {"camera.memory": "frame", "camera.refractory_us": 0, "renderer": "pyrender"})
    assert (changed.camera.memory, changed.renderer) == ("frame", "pyrender")


def test_settings_of_an_axis_go_together_and_a_single_value_stays():
    points = axis_points({"env.control_hz": [45, 200], "faults.sparsity": [0.5, 0.0], "env.scene": ["poles"]})
    assert points == [
        {"env.control_hz": 45, "faults.sparsity": 0.5, "env.scene": "poles"},
        {"env.control_hz": 200, "faults.sparsity": 0.0, "env.scene": "poles"},
    ]


@pytest.mark.parametrize(
    ("axis", "reasons"),
    [
        ({"env.control_hz": [45, 100], "faults.sparsity": [0.0, 0.1, 0.2]},
         ["settings must have equally many values, or one, got {'env.control_hz': 2, 'faults.sparsity': 3}"]),
        ({"env.scene": ["poles"], "env.control_hz": [45, 100]},
         ["env.scene comes first, so it must differ at each of 2 points, got ['poles']"]),
        ({"env.control_hz": [45, 45.0]},
         ["env.control_hz comes first, so it must differ at each of 2 points, got [45, 45.0]"]),
        ({"algo.lr": [1.0]}, ["algo.lr: no such setting, got [1.0]; --cfg job shows every key"]),
        ({"camera.memry": ["frame"]},
         ["camera.memry: no such setting, got ['frame']; did you mean camera.memory?"]),
        ({"env.split": ["train"]},
         ["env.split: no such setting, got ['train']; every job chooses it itself"]),
        ({"faults.sparsity": [2.0, 0.0, -1]},
         ["faults.sparsity=2.0: Input should be less than or equal to 1",
          "faults.sparsity=-1: Input should be greater than or equal to 0"]),
        ({"env.control_hz": ["fast"]}, ["env.control_hz='fast': Input should be a valid number"]),
        ({"camera.memory": ["frame"], "camera.refractory_us": [10]},
         ["camera.memory='frame', camera.refractory_us=10: Value error, "
          "needs memory 'reference' or must be 0, got 10"]),
    ],
)  # fmt: skip
def test_each_setting_that_is_not_valid_gives_one_line_that_names_key_and_value(axis, reasons):
    assert axis_errors({"here": axis}, EnvConfig()) == [f"study.axes.here: {reason}" for reason in reasons]


def test_an_axis_of_numbers_changes_one_setting_and_no_words():
    slow, fast = {"env.control_hz": 45, "env.scene": "poles"}, {"env.control_hz": 200, "env.scene": "poles"}
    assert axis_numbers({"45": slow, "200": fast}) == {"45": 45.0, "200": 200.0}
    assert moving_settings({"45": slow, "200": fast}) == ["env.control_hz"]
    assert axis_numbers({"45": slow, "200": {**fast, "env.scene": "dynamic"}}) is None
    assert axis_numbers({"poles": {"env.scene": "poles"}, "dynamic": {"env.scene": "dynamic"}}) is None


DRAWN = {
    "weight": 3,
    "faults.sparsity": {"low": 0.1, "high": 0.6},
    "env.control_hz": {"low": 30.0, "high": 500.0, "log": True},
    "env.layout.num_obstacles": {"low": 10, "high": 12},
    "env.layout.ground_texture.pattern": ["rings", "stripes"],
    "env.scene": ["poles", "poles_dense"],
    "camera.memory": "frame",
}


def draws(conditions, count):
    draw, rng = episode_draw(conditions), np.random.default_rng(0)
    return [draw(EnvConfig(), rng) for _ in range(count)]


def test_a_condition_is_drawn_by_its_weight_and_its_values_each_from_list_or_range():
    drawn = draws([{}, DRAWN], 1000)
    changed = [env for env in drawn if env != EnvConfig()]
    assert len(changed) / len(drawn) == pytest.approx(0.75, abs=0.05)
    sparsity = np.array([env.faults.sparsity for env in changed])
    assert 0.1 <= sparsity.min() < 0.11 < 0.59 < sparsity.max() <= 0.6
    assert sparsity.mean() == pytest.approx(0.35, abs=0.03)
    hz = np.log([env.control_hz for env in changed])
    assert hz.mean() == pytest.approx(np.log([30.0, 500.0]).mean(), abs=0.1)
    layouts = [env.layout for env in changed]
    assert {layout["num_obstacles"] for layout in layouts} == {10.0, 11.0, 12.0}
    assert {layout["ground_texture"]["pattern"] for layout in layouts} == {"rings", "stripes"}
    assert {env.scene for env in changed} == {"poles", "poles_dense"}
    assert {env.camera.memory for env in changed} == {"frame"}


def test_the_same_generator_draws_the_same_and_nothing_to_draw_is_told():
    assert draws([{}, DRAWN], 20) == draws([{}, DRAWN], 20)
    assert episode_draw([{}]) is None


@pytest.mark.parametrize(
    ("condition", "reason"),
    [
        ({"faults.sparsity": {"low": 0.5, "high": 1.5}}, "less than or equal to 1"),
        ({"faults.sparsity": [0.5, -0.5]}, "greater than or equal to 0"),
        ({"env.hz": 5}, "env.hz: no such setting, got 5; --cfg job shows every key"),
        ({"weight": 0}, "weight: must be a number > 0, got 0"),
        ({"env.layout.num_obstacle": 3}, "layout has no 'num_obstacle'"),
        ({"env.layout.ground_texture.patern": "rings"}, "layout ground_texture has no 'patern'"),
        ({"env.layout.shape": ["pole", "sphere"]}, "shape must be one of"),
        ({"env.filter_support": 2}, "must be the same for all of a training, got 2"),
    ],
)
def test_whatever_may_be_drawn_is_checked_before(condition, reason):
    valid = {"faults.sparsity": 0.5, "env.control_hz": 100}
    (error,) = condition_errors("train.conditions", [{}, valid, condition], EnvConfig())
    assert error.startswith("train.conditions[2]: ")
    assert reason in error


@pytest.mark.parametrize("value", [{"low": 1, "high": 1}, {"low": 0, "high": 2, "log": True}, {"low": 1}, []])
def test_a_range_that_is_none_is_refused(value):
    with pytest.raises(pydantic.ValidationError, match="must"):
        pydantic.TypeAdapter(Conditions).validate_python([{"faults.sparsity": value}])


def test_only_what_differs_from_the_layouts_is_drawn(monkeypatch):
    drawn = []
    monkeypatch.setattr("envs.scene.make_scene", lambda name, *given, **layout: drawn.append(name))
    named = [("env.scene", "poles"), ("study.scene", "gates")]
    assert scene_errors(named, EnvConfig()) == []
    assert drawn == []
    for changed in (EnvConfig(layout={"num_obstacles": 9}), EnvConfig(vehicle_radius_m=0.5)):
        drawn.clear()
        scene_errors(named, changed)
        assert drawn == ["poles", "gates"]


def test_a_scene_that_is_unknown_or_that_a_vehicle_cannot_pass_is_named():
    wide = EnvConfig(vehicle_radius_m=8.0)
    (line,) = scene_errors([("env.scene", "poles"), ("study.scene", "poles")], wide)
    assert line.startswith("env.layout: layout of scene 'poles'")
    assert "8.0 m" in line
    (line,) = scene_errors([("env.scene", "poles"), ("study.scene", "moon")], EnvConfig())
    assert line.startswith("study.scene: must be one of ")
    assert "'moon'" in line
