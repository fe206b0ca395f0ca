import pytest

from jobs.config.config import parse
from jobs.evaluation.sweep_plan import axes_of
from jobs.reporting.words import TITLES, WORDS, condition_text
from tests.support.configs import compose


@pytest.mark.parametrize("sweep", ["robustness", "taught_claims", "encoder_seeds"])
def test_every_condition_has_words_of_its_own_that_name_no_key(sweep):
    axes = axes_of(parse(compose("+exp=robustness", f"sweep={sweep}")).sweep)
    assert set(axes) <= set(WORDS)
    every = [condition_text(axis, value) for axis, points in axes.items() for value in points]
    assert len(set(every)) > len(axes)
    assert not any("_" in text for text in every if "poles_eval" not in text)


def test_an_axis_without_words_is_named():
    assert condition_text("env.speed", "30") == "env.speed 30"
    assert condition_text("sensor_noise", "7") == "shot noise of 7 Hz"
    assert condition_text("background_activity", "0.05") == "5 % false events"


def test_titles_are_those_of_axes_that_have_words():
    assert set(TITLES) <= set(WORDS)
