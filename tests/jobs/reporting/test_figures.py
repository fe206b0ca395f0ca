import re
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from docs import from_data
from docs.from_data import (
    ABLATIONS,
    PAIRS,
    STUDIES,
    ablation,
    figures,
    main,
    pages,
    trade,
    variant_results,
)
from envs.config import EnvConfig
from jobs.analysis.statistics import Difference
from jobs.analysis.tables import estimate_text, save_plot, write_csv
from jobs.evaluation.group_stats import LABELS, episode_values
from jobs.reporting import dose_response, report
from jobs.reporting.breaks import Change, changes_of
from jobs.reporting.claims_study import TAUGHT
from jobs.reporting.dose_response import write_dose_response
from jobs.reporting.dose_taught import DOSES_TAUGHT
from jobs.reporting.figures import contacts, survivals
from jobs.reporting.headline import BEGIN, END
from jobs.reporting.paper_claims import CLAIMS, compare
from jobs.reporting.report import write_results
from jobs.reporting.summary_plots import change_map, still_going
from jobs.reporting.sweep_data import SWEEP, TRAININGS, read_sweep, read_sweep_episodes, write_data
from jobs.rollout.episodes import write_episodes
from jobs.rollout.policies import PRETRAINED
from jobs.tools.curves import PublishedTraining, published_trainings, read_curves, read_trainings
from tests.support.episodes import flights
from tests.support.sweep_folders import study_places, write_shipped, write_study, write_sweep

DOCS = Path(__file__).resolve().parents[3] / "docs"


def pixels(path):
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB"))


@pytest.mark.slow
def test_the_figures_of_a_report_are_drawn_again_from_its_data_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(dose_response, "error_between", lambda one, other: 1 / 7)
    docs, again = tmp_path / "docs", tmp_path / "again.png"
    write_results(write_sweep(tmp_path / "sweep"), docs, write_shipped(tmp_path / "shipped"))
    study = write_study(tmp_path / "study")
    write_dose_response(study, docs, EnvConfig(), **study_places(study))
    drawn = figures(docs / "data")
    assert {f"{name}.png" for name in drawn} == {path.name for path in (docs / "images").iterdir()}
    for name, figure in drawn.items():
        save_plot(again, figure)
        np.testing.assert_array_equal(pixels(again), pixels(docs / "images" / f"{name}.png"))


@pytest.mark.slow
def test_the_published_pages_are_those_of_the_published_data(monkeypatch):
    """`python -m docs.from_data` changes nothing; coverage is simulated elsewhere."""
    was = (DOCS / "results.md").read_text()
    shares = dict(re.findall(r"(\d+) trainings do in ([^;.]*)", was))
    monkeypatch.setattr(report, "coverage_text", lambda trainings, corridors: shares[str(trainings)])
    drawn = sorted((DOCS / "images").glob("results_*.png"))
    shown = re.findall(r"images/(results_\w+)\.png", was + (DOCS / "results_tables.md").read_text())
    assert sorted(shown) == [path.stem for path in drawn]
    found = pages(DOCS, [*shown, dose_response.DOSES, DOSES_TAUGHT, TAUGHT])
    studies = [f"{name}.md" for name in (dose_response.DOSES, DOSES_TAUGHT, TAUGHT)]
    assert list(found) == ["results.md", "results_tables.md", "robustness.md", *studies]
    for name, text in found.items():
        assert text == (DOCS / name).read_text(), f"{name}: renew it by python -m docs.from_data"


def test_pages_and_figures_are_written_from_the_data_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(report, "coverage_text", lambda trainings, corridors: "95 % at 0")
    docs, again = tmp_path / "docs", tmp_path / "again"
    docs.mkdir()
    (docs / "robustness.md").write_text(f"before\n{BEGIN}{END}")
    write_data(docs / "data", SWEEP, write_sweep(tmp_path / "sweep"), read_sweep(tmp_path / "sweep")[1])
    trainings = published_trainings(write_shipped(tmp_path / "shipped"))
    write_csv(docs / "data" / TRAININGS, PublishedTraining._fields, trainings)
    monkeypatch.setattr(from_data, "results_figures", lambda *data: {"results_map": Figure()})
    main(docs, again)
    written = {str(path.relative_to(again)) for path in again.rglob("*") if path.is_file()}
    estimated = {"data/robustness_estimates.csv", "data/robustness_changes.csv"}
    pages = {"results.md", "results_tables.md", "robustness.md"}
    assert written == pages | estimated | {"images/results_map.png"}
    assert "| `bytestream` (3) | 80 |" in (again / "robustness.md").read_text()
    assert (docs / "robustness.md").read_text() == f"before\n{BEGIN}{END}"
    main(docs, docs)
    assert (docs / "robustness.md").read_text() == (again / "robustness.md").read_text()


@pytest.mark.slow
def test_every_published_study_with_data_is_drawn_again(tmp_path):
    data = DOCS / "data"
    there = [study for study, files in STUDIES.items() if all((data / name).is_file() for name in files)]
    drawn = figures(data)
    assert set(drawn) >= {study.__name__ for study in (ablation, trade) if study in there}
    assert len(there) >= 2
    for name in ("ablation", "encoder_inference"):
        save_plot(tmp_path / f"{name}.png", drawn[name])
        np.testing.assert_array_equal(
            pixels(tmp_path / f"{name}.png"), pixels(DOCS / "images" / f"{name}.png")
        )
    for name, figure in drawn.items():
        save_plot(tmp_path / f"{name}.png", figure)
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000


def test_the_published_table_of_trainings_is_that_of_the_published_policies():
    assert read_trainings(DOCS / "data" / "trainings.csv") == published_trainings(PRETRAINED)


def test_no_published_curve_falls_by_more_than_its_episodes_allow():
    """Success is a mean over the last 100 episodes, few of which end between two points of a curve."""
    for curve in read_curves(PRETRAINED).values():
        assert (np.diff(curve.success_rate) > -0.25).all()


def test_episodes_go_on_until_they_end():
    episodes = flights(5, trials=20)
    x, share = still_going(episodes, 100.0)
    assert (x[0], x[-1], share[0], share[-1]) == (0.0, 100.0, 1.0, 5 / 20)
    assert (np.diff(x) >= 0).all()
    assert (np.diff(share) <= 1e-12).all()
    for at in (10.0, 47.5, 52.5, 99.0):
        assert share[x <= at][-1] == pytest.approx(
            np.mean(episodes["success"] | (episodes["distance_m"] > at))
        )
    alone = still_going(flights(20), 100.0)
    assert [list(part) for part in alone] == [[0.0, 100.0], [1.0, 1.0]]


def test_the_worst_condition_of_a_group_is_the_one_it_succeeds_least_in(tmp_path):
    about, episodes = read_sweep(write_sweep(tmp_path))
    for one in episodes[("sparsity", "0.2"), "bytestream"].values():
        one["success"][:] = False
    found = survivals(about, episodes, changes_of(about, episodes))
    assert found["bytestream"].worst == "20 % dead pixels"
    assert len(found["bytestream"].there) == 3
    assert not np.concatenate(found["bytestream"].there)["success"].any()


def test_contacts_are_those_of_the_same_scene_and_of_no_simulation_twice(tmp_path):
    about, episodes = read_sweep(write_sweep(tmp_path))
    found = contacts(about, episodes)
    assert [len(part) for part in found["bytestream"]] == [3 * 20, 2 * 3 * 20]
    assert [len(part) for part in found["oracle"]] == [20, 0]  # sees no events: dead pixels change nothing
    about["axes"]["sparsity"]["0.5"]["env.scene"] = "poles_dense"
    episodes[("sparsity", "0.2"), "bytestream"] = episodes[("nominal", "poles_eval"), "bytestream"]
    about["compared"].reverse()  # nothing changed stays nothing changed wherever it stands
    assert [len(part) for part in contacts(about, episodes)["bytestream"]] == [3 * 20, 0]


def test_a_group_that_was_not_evaluated_unchanged_is_left_out_of_how_far_episodes_get(tmp_path):
    about, episodes = read_sweep(write_sweep(tmp_path))
    about["compared"][2]["baseline"] = ["sparsity", "0.2"]
    del episodes[("nominal", "poles_eval"), "bytestream"]
    changes = changes_of(about, episodes)
    assert {change.group for change in changes} == {"bytestream", "event_image"}
    assert set(survivals(about, episodes, changes)) == {"event_image"}


def cells_of(page):
    """The cells of each row of a page's tables."""
    rows = (DOCS / page).read_text().splitlines()
    return [[cell.strip(" `") for cell in row.strip("|").split("|")] for row in rows if row.startswith("|")]


def test_the_table_of_the_policy_that_holds_is_that_of_its_episodes():
    episodes = read_sweep_episodes(DOCS / "data" / "hold_episodes.csv.gz")
    expected = [
        ", ".join(str(round(100 * value)) for value in episode_values(trainings, "success").mean(axis=1))
        for trainings in episodes.values()
    ]
    found = [row[2] for row in cells_of("policies.md") if len(row) == 3 and row[2].count(",") == 4]
    assert sorted(found) == sorted(expected)


@pytest.mark.parametrize("name", ABLATIONS)
def test_the_tables_of_the_ablation_are_those_of_their_episodes(name):
    page = "ablation.md" if name.startswith("ablation") else "policies.md"
    rows = cells_of(page)
    for one in variant_results(DOCS / "data" / f"{name}_episodes.csv.gz"):
        success = (f"{100 * values.mean():.0f}" for values in one.success.values())
        expected = [one.name, *success, estimate_text(one.mean, 100, ".0f")]
        if name != "memory_seconds":  # whose column compares two others
            expected.append(estimate_text(one.difference, 100, "+.0f") if one.difference else "")
        assert expected in [[row[0], *row[2 : 1 + len(expected)]] for row in rows]


def test_variants_are_paired_with_the_first_by_seed_whatever_their_order_and_number(tmp_path):
    won = {"first": {0: 20, 1: 4, 2: 12}, "fewer": {2: 12, 1: 4}}
    rows = {("nominal", "poles_eval", group, str(seed)): flights(count)
            for group, own in won.items() for seed, count in own.items()}  # fmt: skip
    write_episodes(tmp_path / "episodes.csv", LABELS, rows)
    first, fewer = variant_results(tmp_path / "episodes.csv")
    assert first.difference is None
    assert fewer.differences.tolist() == [0.0, 0.0]
    assert fewer.difference.value == 0.0


def test_what_memory_in_seconds_is_worth_is_that_of_its_episodes():
    shown = {row[0]: row[-1] for row in cells_of("policies.md")}
    found = variant_results(DOCS / "data" / "memory_seconds_episodes.csv.gz", PAIRS["memory_seconds"])
    for own in found:
        paired = own.name.endswith("_seconds")
        assert shown[own.name] == (estimate_text(own.difference, 100, "+.0f") if paired else "")


def test_what_taught_policies_say_of_cameras_and_autoencoders_is_that_of_their_episodes():
    episodes = read_sweep_episodes(DOCS / "data" / "taught_episodes.csv.gz")
    nominal, text = ("nominal", "poles_eval"), " ".join((DOCS / "policies.md").read_text().split())

    def find(at, group):
        return episodes[at, group]

    for claim in (one for one in CLAIMS if one.source == "D.1.2"):
        found = compare(claim, find, {("world", "texture_change"): nominal}).overall
        ends = [round(100 * end) for end in found.interval]
        cost = [round(-100 * found.value), -ends[1], -ends[0]]
        said = f"{cost[0]} points [{cost[1]}, {cost[2]}]" if claim.ours == "bytestream" else None
        if claim.ours == "bytestream_xy":
            said = f"{cost[0]} [{cost[1]}, {cost[2]}]"
        assert (said or f"{round(100 * found.value)} points [{ends[0]}, +{ends[1]}]") in text


def test_trainings_that_do_alike_have_a_dot_each_in_the_map():
    success = np.array([1.0, 1.0, 0.5, 1.0, 1.0])
    condition, baseline = ("sparsity", "0.5"), ("nominal", "poles_eval")
    change = Change(
        condition, baseline, "ours", success, success, Difference(0.0, None, None), False, success < 0
    )
    panel = change_map([change], ["ours"], {condition: "half"}).axes[0]
    (dots,) = [line for line in panel.lines if line.get_marker() == "o"]
    assert len({tuple(point) for point in dots.get_xydata()}) == len(success)
    assert abs(dots.get_ydata()).max() < 0.5  # within the row
