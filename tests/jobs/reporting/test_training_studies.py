import pytest

from docs.from_data import figures, pages
from jobs.config.config import parse
from jobs.reporting.planned_page import RESULTS, coarse_text
from jobs.reporting.report import find_study
from jobs.reporting.training_studies import STUDIES, write_training_study
from tests.support.configs import compose
from tests.support.sweep_folders import write_ablation

PLAN = "# A plan\n\n- **Rule.** As it was.\n"


@pytest.mark.parametrize("name", STUDIES)
def test_a_study_leaves_its_plan_and_is_made_again_from_what_it_publishes(name, tmp_path):
    study = write_ablation(tmp_path / "runs" / "one" / "ablation", name, lambda *_: 1)
    docs = tmp_path / "docs"
    docs.mkdir()
    (docs / f"{name}.md").write_text(PLAN)
    page = write_training_study(study, docs, name)
    text = page.read_text()
    assert text.startswith(PLAN)
    assert text.count(RESULTS) == 1
    assert write_training_study(study, docs, name).read_text() == text
    assert (docs / "images" / f"{name}.png").is_file()
    assert set(figures(docs / "data")) == {name}
    assert pages(docs, [name]) == {f"{name}.md": text}


@pytest.mark.parametrize("name", STUDIES)
def test_the_report_finds_each_study_by_its_experiment(name, tmp_path):
    for exp in STUDIES:
        write_ablation(tmp_path / exp / "ablation", exp, lambda *_: 1)
    config = parse(compose("+exp=report", f"runs_dir={tmp_path}"))
    assert find_study(config, name) == tmp_path / name / "ablation"


def test_what_was_simulated_more_coarsely_is_named_with_its_error_and_nothing_else():
    def one(axis, value, asked, error):
        return {
            "condition": [axis, value],
            "asked": asked,
            "event_error": error,
            "renders_per_step": 1.0,
        }

    usual, rate = one("nominal", "poles_eval", 0.05, 0.019), one("control_hz", "45", 0.05, 0.022)
    assert coarse_text([]) == coarse_text([usual, rate]) == ""
    text = coarse_text([usual, rate, one("world", "dynamic", 0.5, 0.182)])
    assert "moving textures 18.2 %" in text
    assert "with nothing changed 1.9 %" in text
    assert "45 Hz" not in text
