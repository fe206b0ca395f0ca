import csv
from pathlib import Path

from research import coverage
from research.coverage import SPREADS, change_coverage, true_rate

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "statistics.md").read_text()


def percent(mean, spread):
    """A true rate as the page says it."""
    return f"{100 * true_rate(mean, spread):.0f}"


def test_the_page_says_the_true_rates_at_each_spread():
    *first, last = (percent(1.5, spread) for spread in SPREADS)
    assert f"the true rates are {', '.join(first)} and {last} %" in PAGE
    mean_3 = f"a true rate of {percent(3, 0)} % where seeds agree, and of {percent(3, 3)} % at a spread of 3"
    assert mean_3 in PAGE


def test_the_page_says_what_looking_early_costs_as_its_rows_do():
    with (DOCS / "data" / "stopping.csv").open() as file:
        rows = [(row["decided_once_percent"], row["decided_shared_percent"]) for row in csv.DictReader(file)]
    losses = [1 - int(shared) / int(once) for once, shared in rows]
    assert len(losses) == 4
    assert 0.32 < min(losses) < max(losses) < 0.45
    assert "cost a third to four in ten of the decisions" in " ".join(PAGE.split())


def test_intervals_of_a_change_hold_zero_where_nothing_changes(monkeypatch):
    """Of eight trainings and seven corridors; halved intervals hold it in less than nine of ten."""
    monkeypatch.setattr(coverage, "STUDIES", 200)
    assert 0.95 <= change_coverage(8, 7, 1.5, 1.0) <= 1.0
    whole = coverage.crossed_mean

    def halved(values, limits):
        found = whole(values, limits)
        low, high = found.interval or (0.0, 0.0)
        return type("Halved", (), {"interval": ((3 * low + high) / 4, (low + 3 * high) / 4)})

    monkeypatch.setattr(coverage, "crossed_mean", halved)
    assert change_coverage(8, 7, 1.5, 1.0) < 0.9
