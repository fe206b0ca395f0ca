import dataclasses
import json
import os
import re

import numpy as np
import pytest
from PIL import Image

from jobs.analysis.plots import Curve
from jobs.config.config import ConfigError
from jobs.evaluation.group_stats import LABELS
from jobs.reporting import report as results
from jobs.reporting.learning_curves import as_csv
from jobs.reporting.report import breaks_table, find_study, read_sweep_episodes, write_results, write_trade
from jobs.rollout.episodes import write_episodes
from jobs.run.files import write_json
from models.policy.policy import MANIFEST
from tests.support.configs import small_config
from tests.support.episodes import flights

ABOUT = {
    "run": "robustness-short-s0-1",
    "identity": "abc",
    "command": "python -m platform.launch +exp=robustness",
    "commit": "c0ffee",
    "evaluated_at": ["c0ffee"],
    "date": "2026-01-02",
    "scene": "poles_eval",
    "trials": 20,
    "reference": "event_columns",
    "action": "stochastic",
    "groups": {"bytestream": [0, 1], "event_image": [0], "oracle": [None]},
    "exactness": [
        {"condition": ["sparsity", "0.5"], "asked": 0.05, "event_error": 0.0163, "renders_per_step": 5.0}
    ],
    "axes": {"nominal": {"poles_eval": {}}, "sparsity": {"0.2": {}, "0.5": {}}},
}


@pytest.fixture
def sweep(tmp_path):
    """The folder that a sweep leaves, made of constructed episodes."""
    folder = tmp_path / "runs" / "robustness-short-s0-1" / "sweep"
    won = {"bytestream": 16, "event_image": 4, "oracle": 20}
    flown = {
        (axis, value, group, "" if seed is None else str(seed)): flights(won[group])
        for axis, points in ABOUT["axes"].items()
        for value in points
        for group, seeds in ABOUT["groups"].items()
        for seed in seeds
    }
    write_episodes(folder / "episodes.csv", LABELS, flown)
    (folder / "about.json").write_text(json.dumps(ABOUT))
    for name in ("sparsity", "contacts", "left_over"):
        Image.new("RGB", (4, 4)).save(folder / f"{name}.png")
    return folder


def shipped(tmp_path):
    """A folder with learning curves, of policies that are there."""
    ends = {"bytestream": (0.8, 0.81), "event_image": (0.4, 0.41)}
    steps = np.array([0.0, 500_000.0])
    curves = [Curve(exp, seed, steps, np.array([0.0, end]), steps)
              for exp, both in ends.items() for seed, end in enumerate(both)]  # fmt: skip
    for curve in curves:
        write_json(tmp_path / "shipped" / f"{curve.exp}-s{curve.seed}" / MANIFEST, {})
    (tmp_path / "shipped" / "curves.csv").write_text(as_csv(curves))
    return tmp_path / "shipped"


def test_the_page_tells_what_made_it_and_what_it_says_of_the_paper(sweep, tmp_path):
    text = write_results(sweep, tmp_path / "docs", shipped(tmp_path)).read_text()
    for fact in ("2026-01-02", "`python -m platform.launch +exp=robustness`", "commit c0ffee", "sweep `abc`"):
        assert fact in text
    assert "\n\n\n" not in text
    assert "bytestream (2), event_image (1), oracle (1)" in text
    assert "| sparsity | 0.5 | 5 | 1.6 | 5.0 |" in text
    assert text.index("(images/results_sparsity.png)") < text.index("## Success [%]")
    assert "| `bytestream`: tolerates dead pixels | D.3 | `event_image` | holds |" in text
    assert (
        "| `bytestream`: adapts to other control rates | abstract, D.3 | `event_image` | not tested |" in text
    )
    assert "| `bytestream`: learns faster | abstract | `event_image` | holds | +20 [" in text
    assert "| `bytestream_xy`: learns faster | abstract | `event_image` | not tested |" in text
    assert "| nominal | poles_eval | 80 [" in text
    assert text.count("(images/results_") == 2
    assert {path.name for path in (tmp_path / "docs" / "images").iterdir()} == {
        "results_sparsity.png", "results_contacts.png"
    }  # fmt: skip
    assert str(tmp_path) not in text


def test_flights_survive_their_file(sweep):
    found = read_sweep_episodes(sweep / "episodes.csv")
    assert set(found[("sparsity", "0.2"), "bytestream"]) == {0, 1}
    np.testing.assert_array_equal(found[("sparsity", "0.5"), "oracle"][None], flights(20))


def test_the_newest_study_is_found_unless_one_is_named(sweep, tmp_path):
    older = tmp_path / "runs" / "older"
    (older / "sweep").mkdir(parents=True)
    (older / "sweep" / "about.json").write_text("{}")
    os.utime(older / "sweep" / "about.json", (1, 1))
    config = small_config(tmp_path, job="report")
    assert find_study(config, "sweep") == sweep
    assert find_study(dataclasses.replace(config, resume=str(older)), "sweep") == older / "sweep"
    assert find_study(config, "trade") is None


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
    assert np.abs(one - other).max() <= 2


def test_what_there_is_is_written_and_nothing_else(trade, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    results.run(small_config(tmp_path, job="report"))
    assert [path.name for path in (tmp_path / "docs").glob("*.md")] == ["trade.md"]


def test_nothing_finished_is_refused_with_the_remedy(tmp_path):
    config = small_config(tmp_path, job="report")
    rule = r"^resume: no finished sweep or trade in .*: run python -m platform\.launch \+exp=robustness or "
    with pytest.raises(ConfigError, match=rule):
        results.run(config)


def test_a_condition_breaks_a_policy_where_its_own_loss_is_certain(sweep, tmp_path):
    flown = read_sweep_episodes(sweep / "episodes.csv")
    for seed in (0, 1):
        flown[("sparsity", "0.5"), "bytestream"][seed]["success"][:10] = False
        flown[("sparsity", "0.2"), "bytestream"][seed]["success"][:1] = False
    flown[("sparsity", "0.5"), "event_image"][0]["success"] = True
    text = breaks_table(ABOUT, flown)
    assert re.search(r"\| `bytestream` \| 80 \| sparsity 0.5: -50 \[-\d+, -\d+\] \|", text)
    assert "| `event_image` | 20 | none is certain |" in text
    assert "oracle" not in text


def test_the_figure_of_a_trade_is_shown_where_there_is_one(sweep, trade, tmp_path):
    assert "Success against cost" not in write_results(sweep, tmp_path / "docs").read_text()
    write_trade(trade, tmp_path / "docs")
    assert "![Success against cost](images/trade.png)" in write_results(sweep, tmp_path / "docs").read_text()
