import numpy as np
import pytest

from envs.config import EnvConfig
from envs.scene import LAYOUTS, make_scene
from jobs.config.scenes import scene_errors


@pytest.mark.parametrize("name", sorted(LAYOUTS))
def test_a_layout_that_is_not_drawn_again_can_be_drawn(name):
    env = EnvConfig()
    make_scene(name, np.random.default_rng(0), env.vehicle_radius_m, env.camera_height_m)


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


def test_a_vehicle_that_cannot_pass_is_named_by_the_layout_of_each_scene():
    env = EnvConfig(vehicle_radius_m=8.0)
    (line,) = scene_errors([("env.scene", "poles"), ("study.scene", "poles")], env)
    assert line.startswith("env.layout: layout of scene 'poles'")
    assert "8.0 m" in line


def test_an_unknown_scene_is_named_by_its_key():
    (line,) = scene_errors([("env.scene", "poles"), ("study.scene", "moon")], EnvConfig())
    assert line.startswith("study.scene: must be one of ")
    assert "'moon'" in line
