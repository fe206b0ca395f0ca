"""The check of a file of spheres."""

import pytest

from jobs.config.config import ConfigError, parse
from jobs.tools import scene_check
from tests.support.configs import compose

LEFT = "rpg_box01, 20.0, 4.0, 2.0, 1, 0, 0, 0, 13.0, 13.0, 13.0\n"


def configured(file, **own):
    values = compose("+exp=scene_check")
    return parse({**values, "scene_check": {**values["scene_check"], "file": str(file), **own}})


def test_it_says_what_can_be_passed_what_is_not_drawn_as_it_is_and_what_is_left_out(tmp_path, capsys):
    file = tmp_path / "world.csv"
    file.write_text(LEFT + LEFT.replace(" 4.0", " -4.0"))
    ball = "  csvtraj: across\n  scale: [60.0, 60.0, 60.0]\n"
    (tmp_path / "dynamic_obstacles.yaml").write_text(f"N: 1\nObject1:\n{ball}")
    (tmp_path / "csvtrajs").mkdir()
    (tmp_path / "csvtrajs" / "across.csv").write_text("# t, x, y, z\n0.0, 30.0, 0.0, 9.0\n")
    assert scene_check.run(configured(file, heights_m=[2.0, 9.0])) == {"passable": 1.0, "overlaps": 1.0}
    said = capsys.readouterr().out
    assert "1 pairs overlap" in said
    assert "2 reach into the ground" in said
    assert "1 spheres of dynamic_obstacles.yaml move" in said
    last = [part.strip() for line in said.splitlines() if "│ 9 " in line for part in line.split("│")]
    assert last[3:5] + last[7:9] == ["yes", "yes", "no", "no"]  # the ball fills the lane


def test_spheres_that_cannot_be_read_are_left_out(tmp_path, capsys):
    file = tmp_path / "world.csv"
    file.write_text(LEFT)
    (tmp_path / "dynamic_obstacles.yaml").write_text("Object1: {csvtraj: none, scale: [1.0, 1.0, 1.0]}\n")
    assert scene_check.run(configured(file, heights_m=[9.0]))["passable"] == 1.0
    assert "What moves is left out: scene" in capsys.readouterr().out


def test_a_file_that_cannot_be_drawn_is_refused_by_the_key(tmp_path):
    file = tmp_path / "world.csv"
    file.write_text(LEFT.replace("13.0\n", "12.0\n"))
    with pytest.raises(ConfigError, match=r"scene_check\.file: scene .* line 1"):
        scene_check.run(configured(file))
