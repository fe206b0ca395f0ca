import dataclasses

import numpy as np
import pytest

from docs.from_data import figures, pages
from jobs.config.config import ConfigError, parse
from jobs.config.env_keys import flat_env
from jobs.reporting import dose_response
from jobs.reporting.dose_plot import KINDS as LOOKS
from jobs.reporting.dose_response import asked_error
from jobs.reporting.dose_taught import (
    ERRORS,
    FILTERS,
    count_words,
    draw,
    error_changes,
    filter_changes,
    judge,
    mean_success,
    write_dose_taught,
)
from jobs.reporting.planned_page import RESULTS
from jobs.reporting.report import find_study
from jobs.reporting.sweep_data import read_sweep
from jobs.run.files import read_json, write_json
from jobs.studies.ablation.ablation import trained_policies
from tests.support.configs import compose
from tests.support.sweep_folders import KINDS, write_ablation

NAME = "dose_response_taught"
PLAN = "# A plan\n\n- **Rule.** As it was.\n"
FILTERED = ("lost", "displaced", "invented")


def failed(group, axis, value, seed):
    """Invented events cost one group flights, the largest dose most; the filter costs two and saves more."""
    lost = 2 if axis in ("filtered", "lost_filtered", "displaced_filtered") else 0
    if axis.startswith("invented"):
        most = float(value) > 1
        lost = (3 if most else 2) if axis.endswith("filtered") else (12 if most else 8)
    return seed % 2 + (lost if group == "bytestream" else 0)


@pytest.fixture
def study(tmp_path, monkeypatch):
    """The folder that the study of constructed episodes leaves."""
    monkeypatch.setattr(dose_response, "error_between", lambda one, other: 0.125)
    folder = write_ablation(tmp_path / "runs" / "one" / "ablation", NAME, failed)
    write_json(folder.parent / "config.json", flat_env(parse(compose(f"+exp={NAME}")).env))
    return folder


def test_doses_behind_the_filter_are_those_of_the_first_study():
    first, second = (parse(compose(f"+exp={name}")).sweep for name in ("dose_response", NAME))
    assert (second.scene, second.split, second.trials) == (first.scene, first.split, first.trials)
    assert {kind: second.axes[kind] for kind in KINDS} == first.axes
    for kind in FILTERED:
        key = KINDS[kind]
        assert second.axes[f"{kind}_filtered"] == {key: first.axes[kind][key], "env.filter_support": [1]}
    assert set(second.axes) == {*KINDS, "filtered", *(f"{kind}_filtered" for kind in FILTERED)}


def test_errors_are_compared_with_none_and_the_filter_with_none_at_the_same_doses(study):
    success = mean_success(*read_sweep(study))
    errors, filters = error_changes(success), filter_changes(success)
    groups = ("bytestream", "bytestream_xy", "event_image")
    assert set(errors) == {(group, kind) for group in groups for kind in KINDS}
    assert set(filters) == {(group, kind) for group in groups for kind in ("no error", *FILTERED)}
    own = {at: values.mean() for at, values in errors.items() if at[0] == "bytestream"}
    assert own.pop(("bytestream", "invented")) == pytest.approx(-(3 * 8 + 12) / 4 / 14)
    assert set(own.values()) == {0.0}
    own = {kind: values.mean() for (group, kind), values in filters.items() if group == "bytestream"}
    assert own.pop("invented") == pytest.approx((3 * 6 + 9) / 4 / 14)
    assert list(own.values()) == pytest.approx([-2 / 14] * 3)
    others = [values for found in (errors, filters) for at, values in found.items() if at[0] != "bytestream"]
    assert not np.any(others)
    judged = judge(errors, ERRORS), judge(filters, FILTERS)
    assert [own["bytestream", "invented"].verdict for own in judged] == ["costs", "helps"]
    verdicts = [[one.verdict for one in own.values()] for own in judged]
    assert count_words(verdicts[0], ERRORS) == {"costs": 1, "gains": 0, "free": 14, "undecided": 0}
    assert count_words(verdicts[1], FILTERS) == {"harms": 3, "helps": 1, "equal": 8, "undecided": 0}


def test_dashed_lines_are_against_the_filter_alone_and_the_others_against_no_error(study):
    about, swept = read_sweep(study)
    env = parse(compose(f"+exp={NAME}")).env
    doses = dose_response.doses_of({kind: about["axes"][kind] for kind in KINDS}, env, {})
    panel = draw(about, swept, doses).axes[0]
    lines = {line.get_linestyle(): line.get_ydata() for line in panel.lines
             if line.get_color() == LOOKS["invented"][0] and len(line.get_ydata()) == 5}  # fmt: skip
    assert lines["-"] == pytest.approx(np.array([0, -8, -8, -8, -12]) / 14 * 100)
    assert lines["--"] == pytest.approx(np.array([0, 0, 0, 0, -1]) / 14 * 100)


@pytest.mark.parametrize(("name", "value"), [("trials", 7), ("groups", {"bytestream": [0]})])
def test_another_study_is_refused_before_anything_is_written(study, tmp_path, name, value):
    about = read_json(study / "about.json")
    write_json(study / "about.json", about | {name: value})
    env = parse(compose("+exp=report")).env
    with pytest.raises(ConfigError, match=f"its {name} must be"):
        write_dose_taught(study, tmp_path / "docs", env)
    write_json(study / "about.json", about)
    with pytest.raises(ConfigError, match="simulation of this command"):
        write_dose_taught(study, tmp_path / "docs", dataclasses.replace(env, control_hz=100.0))
    assert not (tmp_path / "docs").exists()


@pytest.mark.parametrize("name", [NAME, "taught_claims"])
def test_the_thirty_policies_are_there_and_trained_so(name):
    config = parse(compose(f"+exp={name}", "ablation.trained=docs/data/taught_claims_policies"))
    found = trained_policies(config)
    assert len({path.name for path in found.values()}) == 30
    assert all(path.name.endswith(f"_{variant}-s{seed}") for (variant, seed), path in found.items())


def test_what_is_certain_alone_need_not_be_so_in_a_family_and_wide_intervals_are_not_free():
    rng = np.random.default_rng(0)
    loss = -0.2 + 0.2 * rng.normal(size=(10, 1)) + np.zeros((10, 14))
    alone = judge({("a", "lost"): loss}, ERRORS)["a", "lost"]
    many = judge({("a", "lost"): loss, **{("a", str(k)): 0 * loss for k in range(40)}}, ERRORS)["a", "lost"]
    assert (alone.verdict, many.verdict) == ("costs", "undecided")
    assert alone.difference == many.difference
    assert judge({("a", "lost"): -loss}, ERRORS)["a", "lost"].verdict == "gains"


def test_the_page_keeps_its_plan_and_is_made_again_from_what_it_publishes(study, tmp_path):
    config = parse(compose("+exp=report", f"runs_dir={tmp_path / 'runs'}"))
    assert find_study(config, NAME) == study
    docs = tmp_path / "docs"
    (docs / "data").mkdir(parents=True)
    (docs / f"{NAME}.md").write_text(PLAN)
    page = write_dose_taught(study, docs, config.env)
    text = page.read_text()
    assert text.startswith(f"{PLAN}\n{RESULTS}")
    assert "1 costs, 0 gains, 11 free, 0 undecided" in text
    assert "0 costs, 0 gains, 3 free, 0 undecided" in text
    assert "3 harms, 1 helps, 8 equal, 0 undecided" in text
    rows = [
        line for line in text.splitlines() if line.startswith(("| invented | 12.5", "| invented, filtered |"))
    ]
    assert len(rows) == 8
    assert text.count("\n| the filter alone | 0.0 | **-14 [") == 1
    assert "met by" not in text
    assert write_dose_taught(study, docs, config.env).read_text() == text
    assert set(figures(docs / "data")) == {NAME}
    assert pages(docs, [NAME]) == {f"{NAME}.md": text}


def test_doses_of_the_plan_stand_for_the_errors_that_it_names():
    axes = parse(compose(f"+exp={NAME}")).sweep.axes
    for kind in FILTERED:
        amounts = axes[f"{kind}_filtered"][KINDS[kind]]
        assert [asked_error(kind, one) for one in amounts] == pytest.approx([0.05, 0.1, 0.2, 0.4], abs=1e-5)
