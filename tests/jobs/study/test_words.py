import dataclasses

import pytest

from jobs.config.config import parse
from jobs.study.plan import axes_of, same_simulations
from jobs.study.words import TITLES, WORDS, condition_text
from tests.support.configs import compose

STUDIES = (
    "robustness",
    "taught_claims",
    "encoder_seeds",
    "camera_rates",
    "ablation",
    "memory_seconds",
    "hold",
)


@pytest.mark.parametrize("study", STUDIES)
def test_every_condition_has_words_of_its_own_that_name_no_key(study):
    config = parse(compose(f"+exp={study}"))
    axes = axes_of(config.own.scene, config.own.axes)
    assert set(axes) <= set(WORDS)
    differ = set(same_simulations(dataclasses.replace(config.env, scene=config.own.scene), axes).values())
    texts = [condition_text(at) for at in differ]
    assert len(set(texts)) == len(texts)
    assert not any("_" in text for text in texts)


def test_an_axis_without_words_is_named():
    assert condition_text(("env.speed", 30.0)) == "env.speed 30"
    assert condition_text(("sensor_noise", 7.0)) == "shot noise of 7 Hz"
    assert condition_text(("background_activity", 0.05)) == "5 % false events"


def test_titles_are_those_of_axes_that_have_words():
    assert set(TITLES) <= set(WORDS)
