import dataclasses
import itertools

import pytest

from envs.config import EnvConfig
from jobs.config.conditions import axis_points
from jobs.config.config import parse
from jobs.config.env_keys import env_with
from jobs.rollout.met import met
from jobs.rollout.policies import find_study_policies
from jobs.rollout.tasks import text_of
from jobs.run.files import read_json
from jobs.run.folder import locate_run
from jobs.run.provenance import REPOSITORY
from jobs.study.doses import read_doses
from jobs.study.plan import plan_study
from jobs.study.results import read_published
from tests.support.configs import compose

NOMINAL = EnvConfig(scene="poles_eval")
NEVER_MET = ("texture_change", "shape_change", "dynamic")


def was_met(conditions, changes):
    return met(conditions, EnvConfig(), NOMINAL, env_with(NOMINAL, changes))


@pytest.mark.parametrize(
    ("conditions", "changes", "expected"),
    [
        ([{}], {}, False),
        ([{}], {"env.scene": "poles"}, True),
        ([{}], {"env.scene": "poles_dense"}, False),
        ([{"faults.sparsity": [0.1, 0.5]}], {"faults.sparsity": 0.2}, True),
        ([{"faults.sparsity": [0.1, 0.5]}], {"faults.sparsity": 0.6}, False),
        ([{"faults.sparsity": {"low": 0.1, "high": 0.5}}], {"faults.sparsity": 0.5}, True),
        ([{"env.layout.num_obstacles": [60, 90]}], {"env.scene": "poles_dense"}, True),
        ([{"env.scene": "texture_change"}], {"env.scene": "texture_change"}, True),
        ([{"env.layout.shape": ["box", "cone"]}], {"env.scene": "shape_change"}, False),
        ([{"camera.memory": "frame"}], {"camera.memory": "frame"}, True),
        ([{}, {"faults.sparsity": 0.3}], {"faults.sparsity": 0.2}, True),
        ([{"faults.sparsity": 0.3}], {"faults.sparsity": 0.2}, False),  # no episode has less
        ([{"env.control_hz": 60}, {"env.control_hz": 300}], {"env.control_hz": 45}, False),
    ],
)
def test_a_cell_is_met_where_one_condition_may_draw_all_that_distinguishes_it(conditions, changes, expected):
    assert was_met(conditions, changes) is expected


def test_what_a_training_always_had_it_has_met():
    for delay_ms in (50.0, 25.0):
        late = env_with(NOMINAL, {"env.action_delay_ms": delay_ms})
        assert met([{}], EnvConfig(action_delay_ms=50.0), NOMINAL, late) is (delay_ms == 50.0)


def test_what_two_conditions_meet_one_by_one_is_not_met_together():
    one, two = {"faults.sparsity": 0.5}, {"env.control_hz": 45.0}
    assert was_met([one, two], one)
    assert was_met([one, two], two)
    assert not was_met([one, two], one | two)
    assert was_met([one | two], one | two)


def test_what_a_sweep_tests_as_unseen_never_occurs_in_the_training_that_holds():
    """Other textures on their surfaces, other shapes, what moves; and no level of a sensor that is swept."""
    config, swept_axes = parse(compose("+exp=bytestream_hold")), parse(compose("+exp=robustness")).own.axes
    for conditions in (config.train.conditions, config.collect.conditions):
        for scene in NEVER_MET:
            assert not met(conditions, config.env, NOMINAL, dataclasses.replace(NOMINAL, scene=scene))
        for axis in swept_axes.values():
            for key in axis.keys() - {"fidelity.tolerance", "env.time_limit_s"}:
                swept = {point[key] for point in axis_points(axis)} - {value_of(NOMINAL, key), "poles"}
                drawn = itertools.chain(*(drawn_of(condition, key) for condition in conditions))
                assert not swept & set(drawn), key


def test_the_published_tables_mark_what_the_shipped_policies_drew():
    """In the sweep for every group; the study of doses marks false events by the same rule."""
    facts = read_json(REPOSITORY / "docs" / "data" / "robustness_about.json")
    named = f"study.policies=[{','.join(facts['groups'])}]"
    config = parse(compose("+exp=robustness", named, f"study.trials={facts['trials']}"))
    plan = plan_study(config, find_study_policies(config, locate_run(config)))
    assert sorted([at[0], text_of(at[1]), group] for at, group in plan.met) == facts["met"]
    assert ["background_activity", "0.05", "bytestream_robust"] in facts["met"]
    doses = read_doses(REPOSITORY / "docs" / "data" / "dose_response_doses.csv")
    dosed = read_published(REPOSITORY / "docs" / "data", "dose_response").met
    false = [one for one in doses if one.condition[0] == "invented"]
    assert {(one.condition, group) for one in false for group in one.met_by} == dosed


def value_of(env, key):
    for name in key.removeprefix("env.").split("."):
        env = getattr(env, name)
    return env


def drawn_of(condition, key):
    value = condition.get(key, [])
    return value if isinstance(value, list) else [value]
