import math

import pytest

from jobs.config.config import ConfigError, as_dict
from jobs.tools.search.space import encoder_facts, read_settings, search_space, space_errors, with_settings
from tests.support.configs import tune_config

WORDS = "budget=smoke", "model=event_columns"


def searching(space: str, *words: str):
    return tune_config(*WORDS, "~search.space", f"+search.space={space}", *words)


def test_what_is_drawn_lies_in_the_space_and_comes_back_as_it_was_written():
    space = {
        "a": [[64, 64], [16], None, "word", 0.5, True],
        "b": {"low": 1, "high": 3},
        "c": {"low": 1e-4, "high": 1e-2, "log": True},
        "d": {"low": 1, "high": 1000, "log": True},
    }
    domains = search_space(space)
    drawn = [read_settings({key: domain.sample() for key, domain in domains.items()}) for _ in range(300)]
    assert all(one["a"] in space["a"] for one in drawn)
    assert {one["b"] for one in drawn} == {1, 2, 3}
    for key in "cd":
        assert all(space[key]["low"] <= one[key] <= space[key]["high"] for one in drawn)
    logs = [math.log10(one["c"]) for one in drawn]
    assert abs(sum(logs) / len(logs) + 3.0) < 0.2  # even in the logarithm: its mean is the middle
    assert all(isinstance(one["d"], int) for one in drawn)


def test_a_trial_differs_from_its_experiment_in_its_settings_alone():
    config = tune_config(*WORDS)
    trial = with_settings(config, {"algo.lr": 5e-4, "model.hidden": [8, 8], "env.layout.num_obstacles": 30})
    assert (trial.algo.lr, trial.model.hidden, trial.env.layout) == (5e-4, [8, 8], {"num_obstacles": 30.0})
    changed = {"algo": {"lr": 5e-4}, "model": {"hidden": [8, 8]}, "env": {"layout": {"num_obstacles": 30.0}}}
    expected = as_dict(config)
    for group, values in changed.items():
        expected[group] = {**expected[group], **values}
    assert as_dict(trial) == expected
    assert with_settings(tune_config(*WORDS, "algo.num_env_runners=2"), {}).algo.num_env_runners == 0


@pytest.mark.parametrize(
    ("space", "message"),
    [
        ("{algo.lrr: [0.1]}", "search.space: algo.lrr: no such key, got 0.1; did you mean algo.lr?"),
        ("{algo.gamma: {low: 0.5, high: 1.5}}", "search.space: algo.gamma: "),
        ("{train.env_steps: [10]}", "search.space: train.env_steps must be the same for all trials"),
        ("{algo.lr: [0.1, -1.0]}", "search.space: algo.lr: Input should be greater than 0"),
    ],
)
def test_what_cannot_be_searched_is_told_before_anything_starts(space, message):
    (error,) = space_errors(searching(space))
    assert error.startswith(message)


@pytest.mark.parametrize("values", ["[]", "3", "{low: 2}", "{low: 0, high: 1, log: true}"])
def test_what_is_no_space_is_refused(values):
    with pytest.raises(ConfigError, match=r"^search\.space\.algo\.lr: must be "):
        searching(f"{{algo.lr: {values}}}")


def test_trials_share_an_encoder_unless_a_setting_changes_it():
    config = tune_config()
    assert list(space_errors(config)) == []
    facts = encoder_facts(config)
    for shared in ({"algo.lr": 0.01}, {"model.hidden": [8]}, {"train.checkpoint_every": 3}):
        assert encoder_facts(with_settings(config, shared)) == facts
    for own in ({"model.latent": 8}, {"camera.contrast_threshold": 0.1}, {"pretrain.lr": 0.01}, {"seed": 5}):
        assert encoder_facts(with_settings(config, own)) != facts
    assert encoder_facts(tune_config(*WORDS)) is None
