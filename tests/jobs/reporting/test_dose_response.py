import csv
import dataclasses
import gzip
import json
import os
from pathlib import Path

import numpy as np
import pytest

from envs.config import CameraConfig, EnvConfig, FaultsConfig
from envs.event_error import error_between, event_error
from envs.events import EVENT
from envs.events.faults import PixelFaults, apply_faults
from jobs.config.config import ConfigError, parse
from jobs.config.env_keys import flat_env
from jobs.evaluation.sweep_plan import axes_of
from jobs.reporting import dose_response
from jobs.reporting.breaks import changes_of
from jobs.reporting.dose_plan import check_planned, read_plan
from jobs.reporting.dose_response import (
    Dose,
    asked_error,
    close_pairs,
    compare_kinds,
    doses_of,
    drawn_conditions,
    largest_drawn,
    over_doses,
    write_dose_response,
)
from jobs.reporting.planned_page import RESULTS
from jobs.reporting.report import find_study
from jobs.reporting.sweep_data import read_sweep, read_sweep_episodes
from jobs.rollout.policies import PRETRAINED
from tests.support.configs import compose, small_config
from tests.support.sweep_folders import KINDS, study_places, write_study

ERRORS = (0.05, 0.1, 0.2, 0.4)
PLAN = "# A plan\n\n- **Rule.** As it was.\n"


def composed():
    """The composed study."""
    return parse(compose("+exp=dose_response"))


def test_the_doses_are_those_of_the_plan():
    config = composed()
    axes = config.sweep.axes
    assert {kind: list(axis) for kind, axis in axes.items()} == {kind: [key] for kind, key in KINDS.items()}
    for kind, key in KINDS.items():
        if kind != "jittered":
            assert [asked_error(kind, one) for one in axes[kind][key]] == pytest.approx(ERRORS, abs=1e-5)
    assert axes["jittered"][KINDS["jittered"]] == [50, 100, 200, 400]
    assert (config.job, config.sweep.scene, config.sweep.trials) == ("sweep", "poles_eval", 14)
    assert config.evaluate.action == "stochastic"


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "jittered"])
def test_streams_with_a_dose_differ_by_the_error_that_it_stands_for(kind):
    rng = np.random.default_rng(3)
    shape, count, span_us = (400, 500), 20_000, 1_000_000  # so sparse that hardly any partner is chance
    true = np.zeros(count, EVENT)
    true["t"] = rng.integers(1, span_us, count)
    true["x"], true["y"] = rng.integers(0, shape[1], count), rng.integers(0, shape[0], count)
    true["p"] = rng.choice([-1, 1], count)
    true = true[np.lexsort((true["x"], true["y"], true["t"]))]
    pixels = PixelFaults(np.zeros(shape, bool), np.arange(shape[0] * shape[1]), np.empty(0, int))
    for asked, amount in zip(ERRORS, composed().sweep.axes[kind][KINDS[kind]], strict=True):
        faults = FaultsConfig(**{KINDS[kind].removeprefix("faults."): amount})
        wrong = apply_faults(true, 0, span_us, faults, pixels, rng)
        spread = (asked * (1 - asked) / count) ** 0.5
        assert event_error(wrong, true, 250.0) == pytest.approx(asked, abs=5 * spread)


def test_a_sensor_differs_from_itself_by_nothing_and_from_a_faulty_one_by_its_faults():
    clean = EnvConfig(scene="poles")
    turned = dataclasses.replace(clean, faults=FaultsConfig(flipped=1.0))
    assert error_between(clean, clean, 1, 4) == 0.0
    assert error_between(clean, turned, 1, 4) == error_between(turned, clean, 1, 4) > 0.9
    with pytest.raises(ValueError, match="same scene"):
        error_between(clean, dataclasses.replace(clean, control_hz=100.0))


def test_what_a_training_met_is_known_from_its_manifest():
    env = EnvConfig(scene="poles_eval")
    groups = {"bytestream": [0], "bytestream_robust": [0], "bytestream_hold": [0], "unknown": [0]}
    drawn = drawn_conditions(groups, PRETRAINED)
    assert [largest_drawn("invented", drawn[group]) for group in groups] == [0.0, 0.3, 0.35, 0.0]
    assert [largest_drawn("lost", drawn[group]) for group in groups] == [0.0, 0.3, 0.7, 0.0]
    axes = {"nominal": {"poles_eval": {}}, "invented": {"0.3": {KINDS["invented"]: 0.3}}}
    (dose,) = doses_of(axes, dataclasses.replace(env), drawn)
    assert dose.met_by == ("bytestream_robust", "bytestream_hold")
    assert dose.asked == pytest.approx(0.3 / 2.3)
    assert dose.measured == pytest.approx(dose.asked, abs=0.01)


@pytest.fixture
def study(tmp_path, monkeypatch):
    """The folder that a dose response of constructed episodes leaves."""
    monkeypatch.setattr(dose_response, "error_between", lambda one, other: 0.125)
    return write_study(tmp_path / "runs" / "dose_response-short-s0-1" / "sweep")


def test_invented_events_are_worse_where_they_are_and_nowhere_else(study):
    about, swept = read_sweep(study)
    doses = doses_of(about["axes"], EnvConfig(scene="poles_eval"), {})
    means = over_doses(changes_of(about, swept, every=True), doses, swept)
    found = {(one.group, one.kind): one for one in compare_kinds(means)}
    assert set(found) == {(group, kind) for group in about["groups"] for kind in KINDS if kind != "invented"}
    assert {place: one.verdict for place, one in found.items()} == {
        (group, kind): "worse" if group == "weak" else "undecided" for group, kind in found
    }
    weak = found["weak", "lost"]
    assert weak.difference.value == pytest.approx(-11 / 14)
    assert weak.adjusted_p >= weak.difference.p
    assert found["steady", "lost"].difference.value == 0.0


def test_only_a_difference_that_is_certain_in_its_family_and_by_its_interval_is_a_verdict():
    values = np.full((3, 14), -0.5) + np.array([[-0.06], [0.0], [0.06]])
    few = compare_kinds({("a", "invented"): values, ("a", "lost"): 0 * values})
    many = compare_kinds({("a", "invented"): values, **{("a", str(k)): 0 * values for k in range(40)}})
    assert [one.verdict for one in few] == ["worse"]
    assert {one.verdict for one in many} == {"undecided"}
    assert {one.difference for one in many} == {few[0].difference}
    turned = np.full((3, 14), 0.5) + np.array([[-0.01], [0.0], [0.01]])
    assert compare_kinds({("a", "invented"): turned, ("a", "lost"): 0 * turned})[0].verdict == "better"


def test_the_plan_stays_as_it_is_and_the_results_are_written_below_it(study, tmp_path):
    docs = tmp_path / "docs"
    (docs / "data").mkdir(parents=True)
    (docs / "dose_response.md").write_text(PLAN)
    page = write_dose_response(study, docs, EnvConfig(), **study_places(study))
    text = page.read_text()
    assert text.startswith(f"{PLAN}\n{RESULTS}")
    assert "| `weak` | **worse**: -79 [" in text
    assert "(lost, displaced, flipped): of 6 comparisons 3 are *worse* and 0 *better*" in text
    assert text.count("\n| invented | 12.5 |") == 2
    assert "\n\n\n" not in text
    for said in ("Hollow: a training", "false events per true event", "standard deviation of the delay [us]"):
        assert said in text
    write_dose_response(study, docs, EnvConfig(), **study_places(study))
    assert page.read_text() == text
    assert (docs / "images" / "dose_response.png").stat().st_size > 10_000
    with (docs / "data" / "dose_response_doses.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["Axis"], row["asked_event_error"]) for row in rows][-2:] == [("jittered", "")] * 2
    assert {row["measured_event_error"] for row in rows} == {"0.1250"}
    packed = docs / "data" / "dose_response_episodes.csv.gz"
    assert gzip.decompress(packed.read_bytes()) == (study / "episodes.csv").read_bytes()
    one, other = read_sweep_episodes(packed), read_sweep_episodes(study / "episodes.csv")
    assert one.keys() == other.keys()


def test_the_plan_that_sweeps_are_checked_against_is_the_composed_one():
    config = composed()
    assert read_plan() == config.sweep
    named = [name for name in config.sweep.policies if "-s" not in name]
    groups = {name: [0, 1, 2] for name in named} | {"bytestream_hold": [0, 1, 2, 3]}
    about = {"scene": "poles_eval", "trials": 14, "action": "stochastic", "groups": groups}
    about["axes"] = axes_of(config.sweep)
    with pytest.raises(ConfigError, match=r"must be a run folder .*, got 'absent'"):
        check_planned(Path("absent/sweep"), config.env, about, {}, read_plan(), PRETRAINED)


OTHERS = {
    "trials must be 14, got 2": lambda about: about.update(trials=2),
    "scene must be 'poles_eval', got 'poles'": lambda about: about.update(scene="poles"),
    "action must be 'stochastic', got 'deterministic'": lambda about: about.update(action="deterministic"),
    r"groups.steady must be \[0, 1, 2, 3, 4, 5\], got nothing": lambda about: about["groups"].pop("steady"),
    r"groups.weak must be \[0, 1, 2, 3, 4, 5\], got \[0\]": lambda about: about["groups"].update(weak=[0]),
    "groups.rgb must be nothing, got": lambda about: about["groups"].update(rgb=[0]),
    "axes.flipped.0.2 must be {.*}, got nothing": lambda about: about["axes"]["flipped"].pop("0.2"),
    "axes.lost.0.3 must be nothing, got": lambda about: about["axes"]["lost"].update({"0.3": {"a.b": 0.3}}),
}


@pytest.mark.parametrize("said", OTHERS)
def test_another_sweep_is_not_published_as_the_planned_one(study, tmp_path, said):
    about = json.loads((study / "about.json").read_text())
    OTHERS[said](about)
    (study / "about.json").write_text(json.dumps(about))
    with pytest.raises(ConfigError, match=rf"not the planned study: its {said}.*\+exp=dose_response. as it"):
        write_dose_response(study, tmp_path / "docs", EnvConfig(), **study_places(study))
    assert not (tmp_path / "docs").exists()


def test_jitter_is_counted_apart_and_shown_where_its_event_error_is_close(study, tmp_path, monkeypatch):
    measured = {"jittered 0.1": 0.006, "jittered 0.2": 0.105, "invented 0.1": 0.1, "invented 0.2": 0.2}

    def error(env, clean):
        keys = {"jittered": env.camera.latency_jitter_us, "invented": env.faults.background_activity}
        return next((measured[f"{kind} {amount}"] for kind, amount in keys.items() if amount), 0.15)

    monkeypatch.setattr(dose_response, "error_between", error)
    page = write_dose_response(study, tmp_path / "docs", EnvConfig(), **study_places(study))
    text = page.read_text()
    said = (
        "(jittered: 5.5 % in the mean over the doses, invented: 15.0 %): of 2 comparisons 1 is *worse* and 0"
    )
    assert f"**Not at the same event errors** {said} *better*" in text
    assert "\n| Group | jittered, 10.5 % | invented, 10.0 % |\n" in text
    assert "\n\n\n" not in text


def test_doses_are_close_up_to_half_as_much_again():
    def dose(kind, measured, asked=None):
        return Dose(kind, str(measured), asked, measured, ())

    worst = [dose("invented", error, error) for error in (0.1, 0.2)]
    jitter = [dose("jittered", error) for error in (0.0, 0.066, 0.067, 0.257, 0.31)]
    same = dose("lost", 0.1, 0.1)
    assert close_pairs([*worst, same, *jitter]) == [(jitter[2], worst[0]), (jitter[3], worst[1])]
    assert close_pairs(jitter) == []


@pytest.mark.parametrize("kept", [0, 9])
def test_a_sweep_that_lacks_episodes_is_not_published(study, tmp_path, kept):
    lines = (study / "episodes.csv").read_text().splitlines(keepends=True)
    own = [line for line in lines if line.startswith("flipped,0.2,steady,1,")]
    assert len(own) == 14
    rest = [line for line in lines if line not in own[kept:]]
    (study / "episodes.csv").write_text("".join(rest))
    said = f"not complete: flipped 0.2 of steady s1 must have 14 episodes, got {kept}; give its command again"
    with pytest.raises(ConfigError, match=said):
        write_dose_response(study, tmp_path / "docs", EnvConfig(), **study_places(study))
    assert not (tmp_path / "docs").exists()


def test_event_errors_are_measured_in_the_simulation_of_the_sweep_or_not_at_all(study, tmp_path):
    finer = EnvConfig(camera=CameraConfig(contrast_threshold=0.1))
    said = "simulation of this command: its camera.contrast_threshold must be 0.1, got 0.2; leave"
    with pytest.raises(ConfigError, match=said):
        write_dose_response(study, tmp_path / "docs", finer, **study_places(study))
    stored = flat_env(EnvConfig())
    del stored["faults"]["flipped"]  # as an earlier version wrote it, which had none
    (study.parent / "config.json").write_text(json.dumps(stored))
    write_dose_response(study, tmp_path / "docs", EnvConfig(), **study_places(study))


def test_markers_are_hollow_where_training_met_as_much(study):
    about, swept = read_sweep(study)
    drawn = {
        "steady": [{KINDS["invented"]: [0.0, 0.15]}],
        "weak": [{KINDS["flipped"]: {"low": 0.0, "high": 1.0}}],
    }
    doses = doses_of(about["axes"], EnvConfig(), drawn)
    figure = dose_response.draw(doses, changes_of(about, swept, every=True))
    panels = {
        panel.get_title(loc="left").split(",")[0]: panel for panel in figure.axes if panel.get_visible()
    }
    hollow = {
        name: sum(line.get_markerfacecolor() == "white" for line in panel.lines)
        for name, panel in panels.items()
    }
    assert hollow == {"steady": 1, "weak": 2}
    markers = [line for line in panels["weak"].lines if line.get_marker() not in ("None", "")]
    assert len(markers) == 2 * len(KINDS)


def test_each_sweep_is_found_by_its_own_page_whichever_ran_last(study, tmp_path):
    other = tmp_path / "runs" / "robustness-short-s0-1" / "sweep"
    other.mkdir(parents=True)
    config = small_config(tmp_path, job="report")
    for about, time in (({"exp": "robustness"}, 1), ({}, 1), ({"exp": "robustness"}, 2**31)):
        (other / "about.json").write_text(json.dumps(about))
        os.utime(other / "about.json", (time, time))
        assert find_study(config, "sweep") == other
        assert find_study(config, "dose_response") == study
    named = dataclasses.replace(config, resume=str(study.parent))
    assert find_study(named, "sweep") is None
    assert find_study(named, "dose_response") == study
