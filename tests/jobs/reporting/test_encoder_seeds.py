import numpy as np
import pytest

from jobs.config.conditions import NOMINAL
from jobs.reporting.encoder_seeds import MEAN, by_encoder, results_text, spread_rows
from jobs.reporting.sweep_data import read_sweep
from tests.support.episodes import flights
from tests.support.sweep_folders import write_ablation

AT, OTHER = (NOMINAL, "poles_eval"), ("control_hz", "45")


def crossed(won, at=AT):
    """Episodes of a study with so many of 20 at the goal, by encoder and seed of PPO."""
    episodes = {(at, "own"): {seed: flights(won[seed][seed]) for seed in range(3)}}
    for encoder in range(3):
        others = {seed: flights(won[encoder][seed]) for seed in range(3) if seed != encoder}
        episodes[at, f"encoder_{encoder}"] = others
    return episodes


def test_each_training_stands_in_the_row_of_its_encoder_and_the_column_of_its_seed():
    won = [[2, 4, 6], [8, 10, 12], [14, 16, 18]]
    np.testing.assert_allclose(by_encoder(crossed(won))[AT], np.array(won) / 20)


def test_what_the_encoder_alone_decides_is_said_of_the_encoders():
    mean, row = spread_rows(by_encoder(crossed([[2, 2, 2], [10, 10, 10], [18, 18, 18]])))
    assert mean == (MEAN, "50", "40", "0", "0", "-", "0")
    assert row[1:] == mean[1:]


def test_the_tests_of_conditions_are_corrected_together_and_those_of_the_mean_apart():
    won = [[2, 5, 6], [9, 10, 12], [14, 13, 18]]
    alone = spread_rows(by_encoder(crossed(won)))
    both = spread_rows(by_encoder(crossed(won) | crossed(won, OTHER)))
    assert both[0] == alone[0]
    encoder, seed = float(alone[1][3]), float(alone[1][5])
    assert encoder < 2 * seed
    assert float(both[1][3]) == pytest.approx(2 * encoder, rel=0.1)
    assert float(both[1][5]) == pytest.approx(2 * seed, rel=0.1)


@pytest.mark.parametrize(
    ("failed", "certain"),
    [
        (lambda encoder, seed: 3 * encoder, "by their encoder, for certain"),
        (lambda encoder, seed: 3 * seed, "by their seed of PPO, for certain"),
        (lambda encoder, seed: 2 * encoder + seed, "by their encoder and their seed of PPO"),
        (lambda encoder, seed: 3 * ((2 * encoder + 3 * seed) % 5), "neither by their encoder nor"),
    ],
)
def test_the_page_names_what_decides(failed, certain, tmp_path):
    def lost(group, axis, value, seed):
        return failed(seed if group == "own" else int(group[-1]), seed)

    text = results_text(*read_sweep(write_ablation(tmp_path, "encoder_seeds", lost)))
    assert certain in text
    assert "the 25 trainings" in text


def test_a_study_that_lacks_a_training_is_refused():
    episodes = crossed([[2, 4, 6], [8, 10, 12], [14, 16, 18]])
    del episodes[AT, "encoder_1"][2]
    with pytest.raises(ValueError, match=r"missing: \[\(1, 2\)\]"):
        by_encoder(episodes)
