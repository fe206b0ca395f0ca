import numpy as np
import pytest

from jobs.config.conditions import NOMINAL
from jobs.reporting.encoder_seeds import MEAN, by_encoder, certain_factors, factors, results_text
from jobs.reporting.sweep_data import read_data, read_sweep
from jobs.run.provenance import REPOSITORY
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
    found = factors(by_encoder(crossed([[2, 2, 2], [10, 10, 10], [18, 18, 18]])))
    assert list(found) == [MEAN, "nothing changed"]
    for one in found.values():
        assert (one.mean, one.encoder_p, one.seed_p) == (50.0, 0.0, None)
        np.testing.assert_allclose(one.spread[:3], (40.0, 0.0, 0.0), atol=1e-6)


def test_the_tests_of_conditions_are_corrected_together_and_those_of_the_mean_apart():
    won = [[2, 5, 6], [9, 10, 12], [14, 13, 18]]
    alone = factors(by_encoder(crossed(won)))
    both = factors(by_encoder(crossed(won) | crossed(won, OTHER)))
    assert both[MEAN] == alone[MEAN]
    one, other = alone["nothing changed"], both["nothing changed"]
    assert one.encoder_p < 2 * one.seed_p
    assert (other.encoder_p, other.seed_p) == pytest.approx((2 * one.encoder_p, 2 * one.seed_p))


@pytest.mark.parametrize(
    ("failed", "certain"),
    [
        (lambda encoder, seed: 3 * encoder, ["encoder"]),
        (lambda encoder, seed: 3 * seed, ["seed of PPO"]),
        (lambda encoder, seed: 2 * encoder + seed, ["encoder", "seed of PPO"]),
        (lambda encoder, seed: 3 * ((2 * encoder + 3 * seed) % 5), []),
    ],
)
def test_what_decides_is_told(failed, certain, tmp_path):
    def lost(group, axis, value, seed):
        return failed(seed if group == "own" else int(group[-1]), seed)

    about, episodes = read_sweep(write_ablation(tmp_path, "encoder_seeds", lost))
    assert certain_factors(factors(by_encoder(episodes))[MEAN]) == certain
    text = results_text(about, episodes)
    assert all(name in text for name in certain)
    assert "the 25 succeed in" in text
    assert "chance over 70 flights makes at most 6." in text


def test_a_study_that_lacks_a_training_is_refused():
    episodes = crossed([[2, 4, 6], [8, 10, 12], [14, 16, 18]])
    del episodes[AT, "encoder_1"][2]
    with pytest.raises(ValueError, match=r"missing: \[\(1, 2\)\]"):
        by_encoder(episodes)


def test_what_other_pages_say_of_the_published_study_is_what_its_data_say():
    _, episodes = read_data(REPOSITORY / "docs" / "data", "encoder_seeds")
    tables = by_encoder(episodes)
    found, mean = factors(tables)[MEAN], 100 * np.mean(list(tables.values()), axis=0)
    assert mean.size == 25
    assert certain_factors(found) == []
    assert found.spread.rest > max(found.spread.rows, found.spread.columns)
    for page in ("index.md", "statistics.md"):
        text = " ".join((REPOSITORY / "docs" / page).read_text().split())
        assert f"keep {mean.min():.0f} to {mean.max():.0f} % over five conditions" in text
