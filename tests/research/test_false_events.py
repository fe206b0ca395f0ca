from pathlib import Path

import numpy as np
import pytest

from envs.events import EVENT
from jobs.config.config import ConfigError, parse
from jobs.study.trainings import published_policies
from models.policy import load_policy
from models.policy.features import Step
from research import false_events
from research.false_events import KINDS, NAME, POLICIES, compare, respond, table_of, write_copy, wrong
from tests.support.configs import compose

PAGE = Path(__file__).parents[2] / "docs" / "pooling.md"
SHAPE = (64, 64)


def make_step(rng, count=400, start_us=5000):
    events = np.zeros(count, EVENT)
    events["t"] = np.sort(rng.integers(start_us + 1, start_us + 5001, count))
    events["x"], events["y"] = rng.integers(0, 64, (2, count))
    events["p"] = rng.choice([-1, 1], count)
    return Step(events, start_us, 5000)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture(scope="module")
def copies(tmp_path_factory):
    """One training of the study by each reading, loaded."""
    source, folder = POLICIES / f"{NAME}-s0", tmp_path_factory.mktemp("copies")
    return {
        reading: load_policy(
            source if reading == "maximum" else write_copy(source, folder / reading, rank, support)
        )
        for reading, (rank, support) in false_events.READINGS.items()
    }


def test_a_copy_reads_the_same_weights_otherwise(copies):
    first = copies["maximum"]
    for name, (rank, support) in false_events.READINGS.items():
        other = copies[name]
        np.testing.assert_array_equal(other.encoder.features, first.encoder.features)
        for part, value in first.networks.state_dict().items():
            assert value.equal(other.networks.state_dict()[part])
        assert (other.encoder.pool_rank, other.env_fields.get("filter_support", 0)) == (rank, support)


def test_the_study_takes_each_copy_as_the_variant_it_is_named_for(tmp_path, monkeypatch):
    """Its manifest says the rank and the filter of the variant: the study refuses others."""
    config = parse(compose("+exp=false_events", f"study.published={tmp_path}/VARIANT", "study.seeds=[0,1]"))
    monkeypatch.setattr(false_events, "TRAININGS", config.own.seeds)
    written = false_events.write_copies(POLICIES, tmp_path)
    places = {place.resolve() for place in published_policies(config).values()}
    assert places == {*written, *(POLICIES / f"{NAME}-s{k}" for k in (0, 1))}
    write_copy(POLICIES / f"{NAME}-s1", tmp_path / "second-s1", rank=3, support=0)
    with pytest.raises(ConfigError, match=r"second-s1 has pool_rank: 3 there, 2 here"):
        published_policies(config)


def test_the_third_largest_value_forgets_two_outliers_and_the_filter_a_single_one(copies, rng):
    """One invented event raises a maximum; it can lift the third largest only to the second."""
    steps = [make_step(rng, start_us=5000 * place) for place in range(3)]
    one = [step._replace(events=wrong("one invented", step, SHAPE, rng)) for step in steps]
    features = {
        name: [respond(copies[name], flight).features for flight in (steps, one)]
        for name in ("maximum", "second", "third")
    }
    for clean, changed in features.values():
        assert (changed >= clean).all()
        assert (changed > clean).any()
    for below, above in (("second", "maximum"), ("third", "second")):
        assert (features[below][1] <= features[above][0]).all()


@pytest.mark.parametrize("kind", KINDS)
def test_wrong_events_change_what_their_kind_says(kind, rng):
    step = make_step(rng, 5000)
    events, after = step.events, wrong(kind, step, SHAPE, rng)
    assert (np.diff(after["t"]) >= 0).all()
    assert ((after["t"] > step.start_us) & (after["t"] <= step.start_us + step.window_us)).all()
    assert max(after["x"].max(), after["y"].max()) < 64
    before = {row.tobytes() for row in events}
    kept = sum(row.tobytes() in before for row in after) / len(events)
    share = len(after) / len(events)
    if kind == "one invented":
        assert len(after) == len(events) + 1
    elif kind == "invented":
        assert share == pytest.approx(1 + 2 * 0.1 / 0.9, abs=0.03)
        assert kept >= 1.0
    elif kind == "lost":
        assert share == pytest.approx(1 - 2 * 0.1 / 1.1, abs=0.03)
        assert kept == share
    else:
        moved = {name: np.flatnonzero(after[name] != events[name]) for name in EVENT.names}
        names = {"flipped": {"p"}, "displaced": {"x", "y"}}[kind]
        assert {name for name, places in moved.items() if places.size} == names
        changed = np.unique(np.concatenate([*moved.values()]))
        assert changed.size / len(events) == pytest.approx(0.1, abs=0.02)
        steps = np.abs(after["x"].astype(int) - events["x"]) | np.abs(after["y"].astype(int) - events["y"])
        assert steps.max() <= 1


def test_nothing_wrong_moves_nothing(copies, rng):
    steps = [make_step(rng, start_us=5000 * place) for place in range(4)]
    one, again = (respond(copies["filter_1"], steps) for _ in range(2))
    assert set(compare(one, again).values()) == {0.0}


def test_the_page_shows_the_means_of_the_measured_trainings():
    rows = false_events.read_rows(false_events.FILE)
    assert {int(row["training"]) for row in rows} == set(range(10))
    assert table_of(rows).strip() in PAGE.read_text()
