import csv
import dataclasses

import numpy as np
import pytest
import torch

from jobs.analysis.tables import write_csv
from jobs.config.config import ConfigError, parse
from jobs.measure import encodings as encoder_costs
from jobs.measure import trade_encoder
from jobs.measure.encodings import (
    COST_FIELDS,
    UNCHANGED,
    cost_values,
    costs_us,
    default_encodings,
    exact_latents,
    explained,
    read_costs,
    repeats,
)
from jobs.measure.measured import Measured, columns
from jobs.measure.plots import plot_encoding_costs
from jobs.measure.trade_encoder import MAX_EVENTS, cost_cells
from jobs.run.folder import locate_run
from jobs.run.provenance import REPOSITORY
from models.encoder.evae import event_targets, reconstruct
from models.encoder.event_batch import batch_windows
from models.encoder.table import EncoderTable
from models.kinds import DenseModel
from tests.support.configs import compose, small_config
from tests.support.encoders import WINDOW_US, make_evae, make_events

WINDOWS = [(make_events(count, seed=count), 0, WINDOW_US) for count in (0, 1, 40, 300)]


def make_row(knob="default", cost=10.0, error=0.01, share=0.2, setting=""):
    outcome = {"step_us": cost / 2, "error_max": 2 * error, "explained": share}
    return Measured(knob, setting, cost, error, outcome)


@pytest.mark.parametrize("coding", ["additive", "none"])
def test_exact_latents_are_those_of_a_table_of_very_many_bins(coding):
    evae = make_evae(dtype=torch.float64, coding=coding)
    mu, deviation = exact_latents(evae, WINDOWS)
    table = EncoderTable.from_evae(evae, time_bins=65536)
    near = np.stack([table.encode(*window) for window in WINDOWS])
    assert np.abs(mu - near).max() < 1e-4
    logvar = evae(batch_windows(WINDOWS, evae.grid))[2].numpy()
    assert np.allclose(deviation, np.exp(0.5 * logvar), rtol=0.05)
    with pytest.raises(ValueError, match="got 'eventnet'"):
        exact_latents(make_evae(coding="eventnet"), WINDOWS)


def test_every_form_but_the_coarse_ones_gives_the_default_latent():
    forms = {(form.knob, form.setting): form.encode for form in default_encodings(make_evae(time_bins=1024))}
    latents = {key: np.stack([encode(window) for window in WINDOWS]) for key, encode in forms.items()}
    default = latents["default", ""]
    exact = [("chunks", text) for text in ("1", "2", "5", "20", "per event")] + [("newest events", "500")]
    for key in (*exact, *UNCHANGED):
        assert np.array_equal(latents[key], default), key
    assert np.abs(latents["torch", "plain network"] - default).max() < 2e-6
    for key in [("precision", "int8"), ("time bins", "16"), ("newest events", "250")]:
        assert not np.array_equal(latents[key], default), key
    events, start_us, window_us = WINDOWS[-1]
    newest = forms["default", ""]((events[-250:], start_us, window_us))
    assert np.array_equal(latents["newest events", "250"][-1], newest)


def test_more_chunks_cost_more():
    wanted = ("", "per event")
    forms = [one for one in default_encodings(make_evae()) if one.setting in wanted]
    costs = costs_us(forms, (WINDOWS[-1:], WINDOWS[2:3]), rounds=3)
    assert costs.shape == (2, 2)
    assert (costs[1] > 5 * costs[0]).all()
    assert costs[1, 0] > 3 * costs[1, 1]  # 300 events against 40


def test_what_is_explained_follows_the_latents_that_are_given():
    evae = make_evae(target="occupancy")
    batch = batch_windows(WINDOWS, evae.grid)
    own = evae(batch)[1]
    assert explained(evae, batch, own) == pytest.approx(explained(evae, batch), abs=1e-6)
    assert explained(evae, batch, own + 5.0) != pytest.approx(explained(evae, batch), abs=1e-3)
    targets = event_targets(batch, "occupancy")
    error = (reconstruct(evae(batch)[0], "occupancy") - targets).square().sum()
    total = (targets - targets.mean(0)).square().sum()
    assert explained(evae, batch) == pytest.approx(float(1 - error / total), abs=1e-6)


def test_only_what_computes_the_same_as_the_default_repeats_its_timing():
    rows = [
        make_row(),
        make_row("chunks", setting="1"),
        make_row("chunks", setting="2"),
        make_row("newest events", setting=str(MAX_EVENTS)),
        make_row("time bins", setting="1024", error=0.02),  # of a model of other bins
        make_row("context", setting="1024"),
    ]
    assert repeats(rows) == [rows[0], rows[1], rows[3]]


def test_costs_are_read_as_they_were_written(tmp_path):
    rows = [make_row(), make_row("torch", cost=1234.5), make_row("time bins", setting="16", error=1 / 3)]
    write_csv(tmp_path / "costs.csv", COST_FIELDS, [cost_values(row) for row in rows])
    assert read_costs(tmp_path / "costs.csv") == rows


def test_the_figure_of_costs_has_no_line_and_its_axis_of_shares_begins_at_zero():
    rows = [make_row(), make_row("time bins", setting="16", cost=8.0, error=0.5)]
    rows += [make_row("context", cost=cost, share=share) for cost, share in ((4.0, 0.19), (9.0, 0.2))]
    left, right = plot_encoding_costs(rows).axes
    joined = [line for panel in (left, right) for line in panel.get_lines() if line.get_linestyle() != "None"]
    assert [list(line.get_ydata()) for line in joined] == [[0, 0]]  # of the axis
    assert right.get_ylim()[0] <= 0


def test_the_published_costs_are_those_of_the_page():
    page = " ".join((REPOSITORY / "docs" / "encoder.md").read_text().split())
    with (REPOSITORY / "docs" / "data" / "encoder_costs.csv").open() as file:
        rows = {(row["knob"], row["setting"]): row for row in csv.DictReader(file)}
    usual, network = rows["default", ""], rows["torch", "plain network"]
    alike = [row for key, row in rows.items() if key in UNCHANGED]
    assert {row["error_max"] for row in alike} == {usual["error_max"]} == {network["error_max"]}
    step, dense = ([int(row[column]) for row in alike] for column in ("step_us", "dense_us"))
    assert f"{min(step)} to {max(step)} us for a control step, {min(dense)} to {max(dense)} us for" in page
    ratios = [int(network["step_us"]) / min(step), int(network["dense_us"]) / min(dense)]
    assert f"{min(ratios):.0f} to {max(ratios):.0f} times as fast as the network" in page
    newest = rows["newest events", "500"]["explained"]
    assert f"falls from {float(usual['explained']):.1%}"[:-1] in page
    assert f"to {float(newest):.1%}".replace("%", " %") in page


def test_a_row_becomes_text_and_columns():
    outcome = {"step_us": 60.4, "error_max": 0.0123, "explained": 0.234}
    row = Measured("precision", "int16", 250.0, 0.001, outcome)
    assert cost_cells(row, 25_000.0) == ("precision", "int16", "60", "250", "100", "0.1", "1.2", "23.4")
    assert cost_cells(make_row(error=12.5), 10.0)[5:7] == ("1,250", "2,500")
    others = {name: [value] for name, value in outcome.items()}
    assert columns([row]) == {"setting": ["precision int16"], "cost_us": [250.0], "error": [0.001], **others}


@pytest.mark.system
def test_the_job_leaves_tables_and_figures_and_reads_its_trainings_again(tmp_path, monkeypatch):
    monkeypatch.setattr(encoder_costs, "TIME_BINS", (16, 64))
    words = "collect.num_steps=300", "collect.num_validation_steps=60", "trade_encoder.windows=4"
    words += "model.context=32", "pretrain.iterations=2", "pretrain.batch_windows=4"
    values = compose("+exp=bytestream", "budget=smoke", "job=trade_encoder", *words)
    config = parse({**values, "runs_dir": str(tmp_path / "runs")})
    metrics = trade_encoder.run(config)
    folder = locate_run(config).path / "trade"
    assert {path.stem for path in folder.glob("*.png")} == {"inference"}
    lines = [line.split("|") for line in (folder / "inference.md").read_text().splitlines()[2:]]
    assert [line[1].strip() for line in lines].count("newest events") == 5
    assert lines[0][1].strip() == "default"
    assert len(read_costs(folder / "inference.csv")) == len(lines)
    assert metrics["perf/encode_step_us"] > 0


def test_a_policy_without_such_an_encoder_is_refused_before_anything_is_written(tmp_path):

    config = small_config(tmp_path, job="trade_encoder")
    complex_codes = dataclasses.replace(config.model, coding="eventnet")
    for model, rule in (
        (
            DenseModel(name="event_columns", stack=3, hidden=[64, 64]),
            "event_columns has no encoder of single",
        ),
        (complex_codes, r"model\.coding: must be additive or none.*got 'eventnet'"),
    ):
        with pytest.raises(ConfigError, match=rule):
            trade_encoder.run(dataclasses.replace(config, model=model))
    assert not list(tmp_path.iterdir())
