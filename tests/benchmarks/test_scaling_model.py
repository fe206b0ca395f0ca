import pytest

from benchmarks.scaling_model import (
    BANDWIDTH,
    CORES,
    STEPS,
    Costs,
    Measured,
    as_plain,
    conditions_per_s,
    from_plain,
    iteration_s,
    plot_scaling,
)
from jobs.run.files import read_json, write_json
from jobs.run.provenance import REPOSITORY

COSTS = Costs(4e-4, 1e-4, 2000.0, 1e5, 2.5, 0.02)
MEASURED = Measured(
    2, COSTS, {(1, 0): 1999.0, (1, 1): 1800.0, (1, 2): 3000.0, (2, 4): 3100.0}, {1: 0.4, 2: 0.7, 4: 0.5}
)


def test_what_was_measured_is_read_as_it_was_written(tmp_path):
    write_json(tmp_path / "scaling.json", as_plain(MEASURED, "a test"))
    found = from_plain(read_json(tmp_path / "scaling.json"))
    assert (found.cores, found.costs, found.rates) == (2, COSTS, MEASURED.rates)
    assert found.sweeps == pytest.approx(MEASURED.sweeps)


def test_only_sampling_is_shared_by_cores_and_weights_go_to_each():
    one, ten = iteration_s(COSTS, 1), iteration_s(COSTS, 10)
    assert one[0] == pytest.approx(10 * ten[0])
    assert one[1] == ten[1] == pytest.approx(STEPS * COSTS.learn_s)
    assert ten[2] - one[2] == pytest.approx(9 * COSTS.weight_bytes / BANDWIDTH)


def test_conditions_grow_with_cores_until_the_driver_is_busy():
    rates = [conditions_per_s(COSTS, cores) for cores in (1, 2, 100, 200, 1000)]
    assert rates == pytest.approx([0.4, 0.8, 40.0, 50.0, 50.0])


def test_what_no_measurement_could_test_is_drawn_apart():
    for axes in plot_scaling(MEASURED).axes:
        lines = {str(line.get_label()): line for line in axes.get_lines()}
        assert max(lines["model"].get_xdata()) == 2
        beyond = lines["extrapolated beyond 2 cores"]
        assert (min(beyond.get_xdata()), max(beyond.get_xdata())) == (2, max(CORES))
        assert beyond.get_linestyle() == "--"
        points = [line for label, line in lines.items() if label.startswith("measured")]
        marked = {
            (count, line.get_markerfacecolor() == "none") for line in points for count in line.get_xdata()
        }
        assert marked == {(1, False), (2, False), (4, True)}  # hollow: shared cores


def test_the_page_tells_what_the_model_and_the_points_are():
    published = from_plain(read_json(REPOSITORY / "docs" / "data" / "scaling.json"))
    page = " ".join((REPOSITORY / "docs" / "deploy.md").read_text().split())
    rates = [STEPS / sum(iteration_s(published.costs, cores)) for cores in (1, 2, 10, 100)]
    for rate, where in zip(rates, ("1 core", "2 (", "10,", "100."), strict=True):
        assert f"{round(rate, -2):,.0f}{' steps/s' if where == '1 core' else ''} on {where}" in page
    measured = [rate for (nodes, runners), rate in published.rates.items() if nodes == 1 and runners <= 2]
    assert all(f"{value:,.0f}" in page for value in measured)
    assert all(f"{3600 * published.sweeps[cores]:,.0f}" in page for cores in (1, 2))
    assert f"(model: {2 * 3600 / published.costs.cell_s:,.0f})" in page
    assert f"at about {3600 / published.costs.trial_s:,.0f} the driver" in page
