import dataclasses

import numpy as np
import pytest

from jobs.run.folder import locate_run
from models.encoder.evae import EventVAE
from models.encoder.event_batch import EventBatch
from research import codings
from research.codings import percent, spread, squeezed
from tests.support.configs import small_config


def test_ages_are_squeezed_in_place():
    evae = EventVAE(width=4, height=4, context=8, time_bins=100)
    batch = EventBatch(evae.grid, np.zeros(100, np.int32), np.arange(100, dtype=np.int32), np.array([0, 100]))
    old, new = squeezed(batch, 0.9, 1.0), squeezed(batch, 0.0, 0.2)
    assert np.bincount(old.bin).tolist() == 10 * [10]
    assert np.bincount(new.bin).tolist() == 80 * [0] + 20 * [5]
    assert (np.diff(old.bin) >= 0).all()
    assert np.array_equal(squeezed(batch, 0.0, 1.0).bin, batch.bin)
    assert np.array_equal(old.code, batch.code)


def test_a_spread_is_students_interval_of_the_mean():
    mean, half = spread([0.1, 0.2, 0.3])
    assert mean == pytest.approx(0.2)
    assert half == pytest.approx(4.303 * 0.1 / np.sqrt(3), rel=1e-3)
    assert np.isnan(spread([0.1])[1])
    assert (percent((0.123, 0.04)), percent(spread([0.1]))) == ("12 ± 4", "10")


@pytest.mark.system
@pytest.mark.slow
def test_it_leaves_a_table_and_pictures(tmp_path, monkeypatch):
    monkeypatch.setattr(codings, "CODING_CONTEXT", 16)
    monkeypatch.setattr(codings, "CONTEXTS", (16, 32))
    config = small_config(tmp_path, job="codings")
    config = dataclasses.replace(
        config,
        model=dataclasses.replace(config.model, context=32),
        collect=dataclasses.replace(config.collect, num_steps=300, num_validation_steps=60),
        pretrain=dataclasses.replace(config.pretrain, iterations=2, batch_windows=4),
        own=dataclasses.replace(config.own, iterations=1, seeds=2, windows=4),
    )
    metrics = codings.run(config)
    folder = locate_run(config).path / "trade"
    pictures = {"coding", "coding_pictures", "contexts", "embedding", "interpolation", "scenes"}
    assert {path.stem for path in folder.glob("*.png")} == pictures
    assert (folder / "coding.md").read_text().count("±") == 3 * 7
    assert {f"evae/explained_r2_{coding}_dense" for coding in codings.CODINGS} <= metrics.keys()
    assert len(list((folder / "encoders").glob("*.safetensors"))) == 2 + 2 * 3 - 1

    def refuse(*arguments):
        raise AssertionError("trained again")

    monkeypatch.setattr("research.trials.train_short", refuse)
    assert codings.run(config) == metrics
