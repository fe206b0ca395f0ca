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
from jobs.study.page import new_page
from jobs.study.report import filled_pages, newest_studies, write_study
from jobs.study.results import read_published
from tests.support.configs import small_config
from tests.support.sweep_folders import ABOUT, write_ablation, write_sweep


@pytest.fixture
def sweep(tmp_path):
    """The folder that a sweep of an earlier version has left."""
    return write_sweep(tmp_path / "runs" / "robustness-short-s0-1" / "sweep")


def config_of(tmp_path):
    return small_config(tmp_path, job="report")


def test_a_study_is_published_with_its_data_figures_and_page_and_the_plan_stays(sweep, tmp_path):
    docs = tmp_path / "docs"
    docs.mkdir()
    plan = "# A plan\n\n- **Rule.** As it was.\n\n"
    (docs / "plan.md").write_text(plan + new_page("robustness").partition("\n\n")[2])
    written = write_study("robustness", sweep, config_of(tmp_path), docs)
    text = written.read_text()
    assert text.startswith(plan)
    for fact in ("2026-01-02", "commit c0ffee", "commands"):
        assert fact in text
    assert re.search(
        r"\| `bytestream` \| tolerates dead pixels \| D.3 \| `event_image` \| undecided \| \S+ m", text
    )
    estimates = (docs / "data" / "robustness_estimates.csv").read_text()
    assert "\nnominal,poles_eval,bytestream,3,60,0.8000," in estimates
    assert str(tmp_path) not in text
    names = {f"results_{name}.png" for name in ("axes", "survival", "map")}
    assert {path.name for path in (docs / "images").iterdir()} == names
    assert filled_pages(docs) == {"plan.md": text}  # from the data alone
    computed.published.cache_clear()


def test_every_episode_and_training_is_there_to_be_analysed_again(sweep, tmp_path):
    written = write_study("robustness", sweep, config_of(tmp_path), tmp_path / "docs")
    assert written == tmp_path / "docs" / "robustness.md"  # no page had marks
    data = tmp_path / "docs" / "data"
    text = gzip.decompress((data / "robustness_episodes.csv.gz").read_bytes())
    assert text == (sweep / "episodes.csv").read_bytes()
    rows = list(csv.DictReader(text.decode().splitlines()))
    assert len(rows) == 3 * 5 * 20
    with (data / "robustness_trainings.csv").open() as file:
        for one in csv.DictReader(file):
            own = [row for row in rows if all(row[name] == one[name] for name in LABELS)]
            won, metres = zip(
                *((row["success"] == "True", float(row["distance_m"])) for row in own), strict=True
            )
            assert int(one["episodes"]) == len(own) == 20
            assert float(one["success_rate"]) == np.mean(won)
            assert float(one["distance_m"]) == pytest.approx(np.mean(metres))


def test_more_trainings_come_beside_the_published_ones_if_that_is_asked(tmp_path):
    name, docs, config = "training_lengths", tmp_path / "docs", config_of(tmp_path)
    kept = dataclasses.replace(config, own=report.Settings(keep=True))
    runs = [write_ablation(tmp_path / str(number), name, lambda *at: at[-1] % 3) for number in range(2)]
    for number, run in enumerate(runs):
        about, table = read_json(run / "about.json"), read_table(run / "episodes.csv")
        groups = {group: own[number::2] for group, own in about["groups"].items()}
        flown = [seed in groups[group] for group, seed in zip(table["Group"], table["Training"], strict=True)]
        table[flown].to_csv(run / "episodes.csv", index=False)
        write_json(run / "about.json", {**about, "groups": groups, "command": f"command {number}"})
    with pytest.raises(ConfigError, match=r"report\.keep: must be false for a study that is not published"):
        write_study(name, runs[0], kept, docs)
    assert not docs.exists()
    write_study(name, runs[0], config, docs)
    write_study(name, runs[1], kept, docs)
    both = read_published(docs / "data", name)
    assert [one["command"] for one in (*both.facts["earlier"], both.facts)] == ["command 0", "command 1"]
    assert all(len(both.groups[group]) > len(own) for group, own in groups.items())
    assert (docs / "images" / f"{name}.png").is_file()


def test_what_cannot_be_drawn_replaces_nothing(sweep, tmp_path, monkeypatch):
    def fail(study):
        raise KeyError("figure")

    monkeypatch.setattr(report, "figures", fail)
    with pytest.raises(KeyError, match="figure"):
        write_study("robustness", sweep, config_of(tmp_path), tmp_path / "docs")
    assert not (tmp_path / "docs").exists()


def test_the_newest_run_of_each_study_is_found_in_folders_of_any_version(sweep, tmp_path):
    config, runs = config_of(tmp_path), tmp_path / "runs"
    later, ablation = runs / "later" / "study", runs / "third" / "ablation"
    for folder, exp in ((later, "robustness"), (ablation, "taught")):
        folder.mkdir(parents=True)
        write_json(folder / "about.json", ABOUT | {"exp": exp})
    for time, found in ((1, sweep), (2**32, later)):
        os.utime(later / "about.json", (time, time))
        assert newest_studies(config) == {"robustness": found, "taught": ablation}
    named = dataclasses.replace(config, resume=str(sweep.parent))
    assert newest_studies(named) == {"robustness": sweep}


def test_the_page_of_a_trade_is_copied_with_its_picture_and_nothing_else_written(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rule = r"^resume: no finished study or trade in .*: run python -m platform\.launch \+exp=robustness or "
    with pytest.raises(ConfigError, match=rule):
        report.run(config_of(tmp_path))
    trade = tmp_path / "runs" / "trade-short-s0-1" / "trade"
    (trade / "images").mkdir(parents=True)
    (trade / "trade.md").write_text("# A page\n![](images/trade.png)\n")
    picture = np.zeros((40, 50, 3), np.uint8)
    picture[10:20], picture[:, 30] = (37, 99, 235), 255
    Image.fromarray(picture).save(trade / "images" / "trade.png")
    (trade / "about.json").write_text("{}")
    report.run(config_of(tmp_path))
    (page,) = (tmp_path / "docs").glob("*.md")
    assert (page.name, page.read_text()) == ("trade.md", (trade / "trade.md").read_text())
    with Image.open(page.parent / "images" / "trade.png") as copy:
        np.testing.assert_array_equal(np.asarray(copy.convert("RGB")), picture)
