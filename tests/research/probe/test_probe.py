import dataclasses
import json
from typing import get_args

import numpy as np
import pytest

from jobs.analysis.colours import COLOURS
from jobs.config.config import ConfigError
from jobs.run.folder import locate_run
from models.kinds import DenseModel, Target
from research.probe import probe
from research.probe.probe import (
    LEVEL_LOOKS,
    ProbeResult,
    Representation,
    plot_probes,
    result_columns,
)
from research.probe.readout import Scores
from tests.support.configs import small_config


def small_probe(tmp_path, **changes):
    config = small_config(tmp_path, job="probe")
    parts = {
        "env": {"time_limit_s": 0.1},
        "model": {"context": 32},
        "collect": {"num_steps": 300, "num_validation_steps": 60},
        "pretrain": {"iterations": 2, "batch_windows": 4},
        "own": {"num_steps": 120, "num_validation_steps": 60, "iterations": 1, "seeds": 2} | changes,
    }
    replaced = {name: dataclasses.replace(getattr(config, name), **own) for name, own in parts.items()}
    return dataclasses.replace(config, **replaced)


def make_row(name="signed, latent 8", place=(8, "signed"), share=0.5):
    told = Scores((0.1, 0.05, 0.2), (share, share - 0.1, share + 0.1), (7.0, 6.0, 9.0))
    return ProbeResult(Representation(name, [], place), 8, {1: told, 3: told})


@pytest.mark.system
@pytest.mark.slow
def test_the_job_leaves_a_table_and_a_figure_and_trains_nothing_twice(tmp_path, monkeypatch):
    config = small_probe(tmp_path, latents=[4], targets=["occupancy", "signed", "aged", "counts"])
    metrics = probe.run(config)
    folder = locate_run(config).path / "probe"
    assert (folder / "probe.png").stat().st_size > 10_000
    names = {file.stem for file in (folder / "encoders").glob("*.safetensors")}
    targets = ("occupancy", "signed", "aged", "counts")
    assert names == {f"{target}-4-s{seed}-1" for target in targets for seed in (0, 1)}
    _, _, *rows = (line.split("|")[1:-1] for line in (folder / "table.md").read_text().splitlines())
    assert {row[0].strip(): int(row[1]) for row in rows} == {
        "nothing": 1, "image columns": 128, "8 x 8 cells": 128, "16 x 16 cells": 512,
        "run's encoder": config.model.latent, **{f"{target}, latent 4": 4 for target in targets},
    }  # fmt: skip
    assert {"evae/probe_r2_runs_encoder", "evae/probe_r2_counts_latent_4"} <= set(metrics)
    assert metrics["evae/probe_r2_nothing"] <= 0

    def refuse(*arguments):
        raise AssertionError("trained again")

    monkeypatch.setattr("research.trials.train_short", refuse)
    assert probe.run(config) == metrics
    with pytest.raises(AssertionError, match="trained again"):
        probe.run(dataclasses.replace(config, own=dataclasses.replace(config.own, iterations=2)))


def test_a_policy_without_an_event_vae_is_refused_before_anything_is_written(tmp_path):
    model = DenseModel(name="event_columns", stack=3, hidden=[64, 64])
    config = dataclasses.replace(small_config(tmp_path, job="probe"), model=model)
    with pytest.raises(ConfigError, match="event_columns has no event VAE to probe"):
        probe.run(config)
    assert not list(tmp_path.iterdir())


def test_a_row_becomes_columns_of_a_file():
    table = result_columns([make_row()])
    assert table["representation"] == ["signed, latent 8, 1 step", "signed, latent 8, 3 steps"]
    assert (table["numbers"], table["network_low"]) == ([8, 24], [0.4, 0.4])
    assert table["bearing_deg_high"] == [9.0, 9.0]
    json.dumps(table)


def test_the_figure_has_a_line_for_each_target_and_a_level_for_the_rest():
    names = ("nothing", "image columns", "8 x 8 cells", "16 x 16 cells", "run's encoder")
    rows = [make_row(name, None, 0.1 * place) for place, name in enumerate(names)]
    rows += [make_row("", (size, target)) for target in ("aged", "counts") for size in (8, 32)]
    figure = plot_probes(rows)
    assert len(figure.axes) == 4
    _, labels = figure.axes[0].get_legend_handles_labels()
    assert sorted(labels) == sorted((*names, "aged", "counts"))
    levels = {line.get_label(): line for line in figure.axes[0].lines if line.get_label() in names}
    assert np.allclose(levels["16 x 16 cells"].get_ydata(), 30)
    assert list(levels) == list(names)
    colours = {line.get_color() for line in levels.values()}
    assert len(colours - {COLOURS[one] for one in get_args(Target)}) == 5
    assert len({dashes for _, dashes in LEVEL_LOOKS}) == 5  # told apart without colours too
