import csv
import dataclasses
import gzip
import os
import re

import numpy as np
import pytest
from PIL import Image

from jobs.config.config import ConfigError
from jobs.rollout.table import LABELS, read_table
from jobs.run.files import read_json, write_json
from jobs.study import computed, report
from jobs.study.page import fill, marked, new_page
from jobs.study.report import filled_pages, newest_studies, write_study, write_trade
from jobs.study.results import read_published
from tests.support.configs import small_config
from tests.support.sweep_folders import ABOUT, write_ablation, write_sweep


@pytest.fixture
def sweep(tmp_path):
    """The folder that a sweep of an earlier version has left."""
    return write_sweep(tmp_path / "runs" / "robustness-short-s0-1" / "sweep")


def config_of(tmp_path):
    return small_config(tmp_path, job="report")


def test_marks_alone_are_filled_and_twice_is_once():
    text = "a\n<!-- study one results -->\nold\n<!-- end of study -->\nb\n"
    once = fill(text, lambda mark, part: f"{mark} {part}")
    assert once == "a\n<!-- study one results -->\n\none results\n\n<!-- end of study -->\nb\n"
    assert fill(once, lambda mark, part: f"{mark} {part}") == once
    assert marked([text, new_page("two")]) == ["one", "two"]


def test_a_study_is_published_with_its_data_figures_and_page_and_the_plan_stays(sweep, tmp_path):
    docs = tmp_path / "docs"
    docs.mkdir()
    plan = "# A plan\n\n- **Rule.** As it was.\n\n"
    (docs / "plan.md").write_text(plan + new_page("robustness").partition("\n\n")[2])
    written = write_study("robustness", sweep, config_of(tmp_path), docs)
    text = written.read_text()
    assert text.startswith(plan)
    for fact in ("2026-01-02", "`python -m platform.launch +exp=robustness`", "commit c0ffee"):
        assert fact in text
    assert re.search(
        r"\| `bytestream` \| tolerates dead pixels \| D.3 \| `event_image` \| undecided \| \S+ m", text
    )
    estimates = (docs / "data" / "robustness_estimates.csv").read_text()
    assert "\nnominal,poles_eval,bytestream,3,60,0.8000," in estimates
    assert "\n\n\n" not in text
    assert str(tmp_path) not in text
    names = {f"results_{name}.png" for name in ("axes", "survival", "map")}
    assert {path.name for path in (docs / "images").iterdir()} == names
    assert filled_pages(docs) == {"plan.md": text}  # from the data alone
    computed.published.cache_clear()


def test_every_episode_and_training_is_there_to_be_analysed_again(sweep, tmp_path):
    write_study("robustness", sweep, config_of(tmp_path), tmp_path / "docs")
    data = tmp_path / "docs" / "data"
    with gzip.open(data / "robustness_episodes.csv.gz", "rt") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 3 * 5 * 20
    assert (
        gzip.decompress((data / "robustness_episodes.csv.gz").read_bytes())
        == (sweep / "episodes.csv").read_bytes()
    )
    with (data / "robustness_trainings.csv").open() as file:
        trainings = list(csv.DictReader(file))
    for one in trainings:
        own = [row for row in rows if all(row[name] == one[name] for name in LABELS)]
        assert float(one["success_rate"]) == np.mean([row["success"] == "True" for row in own])
        assert float(one["distance_m"]) == pytest.approx(np.mean([float(row["distance_m"]) for row in own]))
        assert int(one["episodes"]) == len(own) == 20
    assert (tmp_path / "docs" / "robustness.md").is_file()  # no page had marks
    assert {f"robustness_{name}.csv" for name in ("estimates", "changes")} <= {
        path.name for path in data.iterdir()
    }


def test_more_trainings_come_beside_the_published_ones_if_that_is_asked(tmp_path):
    docs, config = tmp_path / "docs", config_of(tmp_path)
    kept = dataclasses.replace(config, own=report.Settings(keep=True))
    runs = [tmp_path / "runs" / str(number) / "study" for number in range(2)]
    for number, run in enumerate(runs):
        write_ablation(run, "training_lengths", lambda group, axis, value, seed: seed % 3)
        table = read_table(run / "episodes.csv")
        seeds = sorted(set(table["Training"]))[number::2]
        table[table["Training"].isin(seeds)].to_csv(run / "episodes.csv", index=False)
        about = read_json(run / "about.json")
        about["groups"] = {
            name: [seed for seed in own if seed in seeds] for name, own in about["groups"].items()
        }
        write_json(run / "about.json", {**about, "command": f"command {number}"})
    with pytest.raises(ConfigError, match=r"report\.keep: must be false for a study that is not published"):
        write_study("training_lengths", runs[0], kept, docs)
    assert not docs.exists()
    write_study("training_lengths", runs[0], config, docs)
    alone = read_published(docs / "data", "training_lengths")
    page = write_study("training_lengths", runs[1], kept, docs).read_text()
    assert "`command 0`" in page
    assert "`command 1`" in page
    both = read_published(docs / "data", "training_lengths")
    assert all(len(both.groups[name]) > len(own) for name, own in alone.groups.items())
    for at, trainings in alone.cells.items():
        assert all(np.array_equal(both.cells[at][seed], own) for seed, own in trainings.items())
    with pytest.raises(ConfigError, match=r"report\.keep"):
        write_study("training_lengths", runs[1], kept, docs)


@pytest.mark.parametrize("exp", ["training_lengths", "encoder_seeds", "camera_rates", "ppo_event_set"])
def test_every_kind_of_study_is_published_from_the_folder_of_an_earlier_version(exp, tmp_path):
    folder = write_ablation(tmp_path / "ablation", exp, lambda group, axis, value, seed: seed % 3)
    text = write_study(exp, folder, config_of(tmp_path), tmp_path / "docs").read_text()
    assert f"(data/{exp}_trainings.csv)" in text
    assert list((tmp_path / "docs" / "images").glob(f"{exp}.png"))


def test_what_cannot_be_drawn_replaces_nothing(sweep, tmp_path, monkeypatch):
    def fail(study):
        raise KeyError("figure")

    monkeypatch.setattr(report, "figures", fail)
    with pytest.raises(KeyError, match="figure"):
        write_study("robustness", sweep, config_of(tmp_path), tmp_path / "docs")
    assert not (tmp_path / "docs").exists()


def test_the_newest_run_of_each_study_is_found_in_folders_of_any_version(sweep, tmp_path):
    config, later = config_of(tmp_path), tmp_path / "runs" / "later" / "study"
    later.mkdir(parents=True)
    ablation = tmp_path / "runs" / "third" / "ablation"
    ablation.mkdir(parents=True)
    write_json(ablation / "about.json", ABOUT | {"exp": "taught"})
    for time, found in ((1, sweep), (2**32, later)):
        write_json(later / "about.json", ABOUT | {"exp": "robustness"})
        os.utime(later / "about.json", (time, time))
        assert newest_studies(config) == {"robustness": found, "taught": ablation}
    named = dataclasses.replace(config, resume=str(sweep.parent))
    assert newest_studies(named) == {"robustness": sweep}


@pytest.fixture
def trade(tmp_path):
    """The folder that a trade leaves."""
    folder = tmp_path / "runs" / "trade-short-s0-1" / "trade"
    (folder / "images").mkdir(parents=True)
    (folder / "trade.md").write_text("# A page\n![](images/trade.png)\n")
    picture = np.zeros((40, 50, 3), np.uint8)
    picture[10:20], picture[:, 30] = (37, 99, 235), 255
    Image.fromarray(picture).save(folder / "images" / "trade.png")
    (folder / "about.json").write_text("{}")
    return folder


def test_the_page_of_a_trade_is_copied_with_its_picture(trade, tmp_path):
    text = write_trade(trade, tmp_path / "docs").read_text()
    assert text == (trade / "trade.md").read_text()
    copy, whole = (folder / "images" / "trade.png" for folder in (tmp_path / "docs", trade))
    one, other = (np.asarray(Image.open(path).convert("RGB"), int) for path in (copy, whole))
    np.testing.assert_array_equal(one, other)


def test_what_there_is_is_written_and_nothing_else(trade, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    report.run(config_of(tmp_path))
    assert [path.name for path in (tmp_path / "docs").glob("*.md")] == ["trade.md"]


def test_nothing_finished_is_refused_with_the_remedy(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rule = r"^resume: no finished study or trade in .*: run python -m platform\.launch \+exp=robustness or "
    with pytest.raises(ConfigError, match=rule):
        report.run(config_of(tmp_path))
