import numpy as np
import pytest

from jobs.config.conditions import NOMINAL
from jobs.reporting.encoder_seeds import by_encoder, main, spread_rows
from tests.support.episodes import flights

AT = (NOMINAL, "poles_eval")


def crossed(won):
    """Episodes of a study with so many of 20 at the goal, by encoder and seed of PPO."""
    episodes = {(AT, "own"): {seed: flights(won[seed][seed]) for seed in range(3)}}
    for encoder in range(3):
        others = {seed: flights(won[encoder][seed]) for seed in range(3) if seed != encoder}
        episodes[AT, f"encoder_{encoder}"] = others
    return episodes


def test_each_training_stands_in_the_row_of_its_encoder_and_the_column_of_its_seed():
    won = [[2, 4, 6], [8, 10, 12], [14, 16, 18]]
    np.testing.assert_allclose(by_encoder(crossed(won))[AT], np.array(won) / 20)


def test_what_the_encoder_alone_decides_is_said_of_the_encoders():
    row = spread_rows(by_encoder(crossed([[2, 2, 2], [10, 10, 10], [18, 18, 18]])))[0]
    assert row == ("nominal poles_eval", "50", "40", "0", "0", "-", "0")


def test_a_study_that_lacks_a_training_is_refused():
    episodes = crossed([[2, 4, 6], [8, 10, 12], [14, 16, 18]])
    del episodes[AT, "encoder_1"][2]
    with pytest.raises(ValueError, match=r"missing: \[\(1, 2\)\]"):
        by_encoder(episodes)


def test_without_its_episodes_the_program_ends_with_the_rule(tmp_path):
    with pytest.raises(SystemExit, match="must hold the episodes of"):
        main(tmp_path / "none.csv.gz")
