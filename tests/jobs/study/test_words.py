import dataclasses

import pytest

from jobs.config.config import parse
from jobs.study.plan import axes_of, same_simulations
from jobs.study.words import TITLES, WORDS, condition_text
from tests.support.configs import compose


@pytest.mark.parametrize("study", ["robustness", "taught_claims", "encoder_seeds", "camera_rates", "hold"])
def test_every_condition_has_words_of_its_own_that_name_no_key(study):
    config = parse(compose(f"+exp={study}"))
    axes = axes_of(config.own.scene, config.own.axes)
    assert set(axes) <= set(WORDS)
    assert set(TITLES) <= set(WORDS)
    differ = set(same_simulations(dataclasses.replace(config.env, scene=config.own.scene), axes).values())
    texts = [condition_text(at) for at in differ]
    assert len(set(texts)) == len(texts)
    assert not any("_" in text for text in texts)
