import dataclasses

import pytest
from hypothesis import given
from hypothesis import strategies as st

from envs.config import EnvConfig
from envs.event_error import measure_event_error
from jobs.config.config import parse
from jobs.config.env_keys import env_with
from jobs.measure import trade_simulator
from jobs.measure.measured import pareto
from jobs.measure.trade_simulator import step_costs_us
from jobs.run.folder import locate_run
from tests.support.configs import compose

POINTS = st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9)), min_size=1, max_size=12)


@given(POINTS)
def test_the_front_is_what_nothing_beats_in_both(points):
    front = pareto(points)

    def beaten(point):
        return any(
            other != point and all(a <= b for a, b in zip(other, point, strict=True)) for other in points
        )

    assert {points[place] for place in front} == {point for point in points if not beaten(point)}
    assert [points[place] for place in front] == sorted(points[place] for place in front)


@given(POINTS)
def test_what_is_beaten_within_the_noise_is_beaten_by_what_is_more_exact_alone(points):
    twice = [*points, *((1.04 * cost, error) for cost, error in points)]
    front = [twice[place] for place in pareto(twice, 0.05)]
    assert front
    for cost, error in front:
        assert not any(other < error and price <= 1.05 * cost for price, other in twice)
    both = {(cost, error) for cost, error in points if (1.04 * cost, error) in front}
    assert both <= set(front)  # what differs by noise alone is not told apart


def test_more_renders_cost_more():
    once, often = (env_with(EnvConfig(), {"fidelity.max_step_m": step_m}) for step_m in (1.0, 0.002))
    costs = step_costs_us([once, often], steps=10, rounds=3)
    assert costs[1] > 3 * costs[0] > 0


@pytest.mark.system  # for its length
def test_the_job_leaves_tables_and_figures_and_a_second_run_replaces_them(tmp_path, monkeypatch):
    knobs = {"renders": [{"renders": 1}, {"renders": 3}], "encoding": [{"camera.encoding": "linear8"}]}
    monkeypatch.setattr(trade_simulator, "KNOBS", knobs)
    own = {"scenes": "[poles]", "control_hz": "[200.0]", "flights": 1, "steps": 3, "rounds": 1}
    words = [f"trade_simulator.{name}={value}" for name, value in own.items()]
    values = compose("+exp=trade_simulator", "budget=smoke", *words)
    config = parse({**values, "runs_dir": str(tmp_path / "runs")})
    metrics = trade_simulator.run(config)
    assert trade_simulator.run(config).keys() == metrics.keys()
    folder = locate_run(config).path / "trade"
    made = {path.name for path in folder.iterdir()}
    assert made == {"poles.md", "poles.png", "memory.md", "memory.png"}
    rows = [row.split("|") for row in (folder / "poles.md").read_text().splitlines()[2:]]
    assert [row[1].strip() for row in rows] == ["default", "renders", "renders", "encoding"]
    few, many = (float(row[6]) for row in rows[1:3])  # looks at columns count too
    assert 1.0 <= few < 3.0 <= many
    assert 0.0 < metrics["sim/event_error_poles"] < 1.0
    exact = measure_event_error(dataclasses.replace(config.env, split="validation"), 1, 1)
    assert metrics["sim/events_per_second_reference_200_hz"] == pytest.approx(200.0 * exact.events[0])
    assert metrics["sim/events_per_second_reference_200_hz"] > metrics["sim/events_per_second_legacy_200_hz"]
