import numpy as np
import pytest

from docs.from_data import figures, pages
from jobs.config.config import parse
from jobs.reporting import dose_response
from jobs.reporting.dose_response import asked_error
from jobs.reporting.dose_taught import (
    ERRORS,
    FILTERS,
    count_words,
    error_changes,
    filter_changes,
    judge,
    mean_success,
    write_dose_taught,
)
from jobs.reporting.planned_page import RESULTS
from jobs.reporting.report import find_study
from jobs.reporting.sweep_data import read_sweep
from tests.support.configs import compose
from tests.support.sweep_folders import KINDS, write_ablation

NAME = "dose_response_taught"
PLAN = "# A plan\n\n- **Rule.** As it was.\n"
FILTERED = ("lost", "displaced", "invented")


def failed(group, axis, value, seed):
    """Invented events cost one group most of its flights without a filter, and some behind it."""
    lost = {"invented": 11, "invented_filtered": 4}.get(axis, 0) if group == "bytestream" else 0
    return seed % 2 + lost


@pytest.fixture
def study(tmp_path, monkeypatch):
    """The folder that the study of constructed episodes leaves."""
    monkeypatch.setattr(dose_response, "error_between", lambda one, other: 0.125)
    return write_ablation(tmp_path / "runs" / "one" / "ablation", NAME, failed)


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
    assert errors["bytestream", "invented"].mean() == pytest.approx(-11 / 14)
    assert filters["bytestream", "invented"].mean() == pytest.approx(7 / 14)
    others = [at for at in (*errors, *filters) if at != ("bytestream", "invented")]
    assert {values.mean() for values in (*errors.values(), *filters.values())} == {-11 / 14, 7 / 14, 0.0}
    assert all(not (errors | filters)[at].any() for at in others)
    judged = judge(errors, ERRORS), judge(filters, FILTERS)
    assert [own["bytestream", "invented"].verdict for own in judged] == ["costs", "helps"]
    assert count_words(judged[0], ERRORS) == {"costs": 1, "gains": 0, "free": 14, "undecided": 0}
    assert count_words(judged[1], FILTERS) == {"harms": 0, "helps": 1, "equal": 11, "undecided": 0}


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
    assert "1 costs, 0 gains, 14 free, 0 undecided" in text
    assert "0 harms, 1 helps, 11 equal, 0 undecided" in text
    assert text.count("\n| invented | 12.5 |") == text.count("\n| invented, filtered | 12.5 |") == 4
    assert write_dose_taught(study, docs, config.env).read_text() == text
    assert set(figures(docs / "data")) == {NAME}
    assert pages(docs, [NAME]) == {f"{NAME}.md": text}


def test_doses_of_the_plan_stand_for_the_errors_that_it_names():
    axes = parse(compose(f"+exp={NAME}")).sweep.axes
    for kind in FILTERED:
        amounts = axes[f"{kind}_filtered"][KINDS[kind]]
        assert [asked_error(kind, one) for one in amounts] == pytest.approx([0.05, 0.1, 0.2, 0.4], abs=1e-5)
