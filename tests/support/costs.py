"""What quick tests cost: a list of the slowest at the end of a run, and a check of all (`make test-costs`).

A host may be three times as slow as another, so seconds fail no test. A cost is processor time, of the test's
process and of its children that have ended, in units: a fixed piece of work, measured in the same process.
"""

import os
import time

import numpy as np
import pytest
from numba.core import event

NOT_QUICK = ("system", "slow", "faults", "cluster")
LISTED = 10
REPEATS = 3  # of the unit, of which the quickest counts
AGAIN_S = 60.0  # after that the unit is measured again: a processor's speed changes while a suite runs
COST = "cost"  # of a report's properties: processor time [s] and the unit then [s]


class Costs:
    """A plugin of pytest that measures the quick tests.

    Attributes:
        most_units: What a quick test may cost, or the run fails after its last test; None: anything.
        seen: Test -> processor time [s] and units.
    """

    def __init__(self, most_units: float | None) -> None:
        self.most_units = most_units
        self.seen: dict[str, tuple[float, float]] = {}
        self._compiling = Compiling()
        self._unit_s, self._measured_s = 0.0, -AGAIN_S

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item):
        """Measure a test. What numba compiles in it is not the test's: it is compiled once."""
        if any(item.get_closest_marker(name) for name in NOT_QUICK):
            return (yield)
        if time.monotonic() - self._measured_s > AGAIN_S:
            self._unit_s, self._measured_s = unit_s(), time.monotonic()
        self._compiling.spent_s, began_s = 0.0, processor_s()
        with event.install_listener("numba:compile", self._compiling):
            result = yield
        spent_s = processor_s() - began_s - self._compiling.spent_s
        item.user_properties.append((COST, (spent_s, self._unit_s)))
        return result

    def pytest_runtest_logreport(self, report):
        """Collect what a test cost, also where another process ran it."""
        for spent_s, unit in [value for name, value in report.user_properties if name == COST]:
            if report.when == "call":
                self.seen[report.nodeid] = spent_s, spent_s / unit

    def pytest_sessionfinish(self, session, exitstatus):
        """Fail a run that was asked to, and is well but for a test that costs too much."""
        if exitstatus == 0 and self.too_costly():
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter):
        """List the slowest tests, or all that cost too much."""
        slowest = self.too_costly() or sorted(self.seen, key=self.units, reverse=True)[:LISTED]
        if len(self.seen) > 10 * LISTED or self.too_costly():
            limit = "" if self.most_units is None else f", of which a test may take {self.most_units:g}"
            terminalreporter.section(f"processor time of the slowest quick tests: seconds, units{limit}")
            for name in slowest:
                terminalreporter.write_line(f"{self.seen[name][0]:7.2f} {self.units(name):7.0f}  {name}")
            whole = sum(spent_s for spent_s, _ in self.seen.values())
            terminalreporter.write_line(f"{whole:7.0f} all {len(self.seen)} quick tests")

    def too_costly(self) -> list[str]:
        """The tests above the limit, the costliest first."""
        most = float("inf") if self.most_units is None else self.most_units
        return sorted((name for name in self.seen if self.units(name) > most), key=self.units, reverse=True)

    def units(self, name: str) -> float:
        """What a test cost."""
        return self.seen[name][1]


class Compiling(event.Listener):
    """Adds up the processor time of compilations, which lie within each other."""

    def __init__(self):
        self.depth, self.began_s, self.spent_s = 0, 0.0, 0.0

    def on_start(self, event):
        if self.depth == 0:
            self.began_s = processor_s()
        self.depth += 1

    def on_end(self, event):
        self.depth -= 1
        if self.depth == 0:
            self.spent_s += processor_s() - self.began_s


def unit_s() -> float:
    """Processor time of a fixed piece of work, half of it Python's own and half numpy's [s]."""
    spent = []
    for _ in range(REPEATS):
        began_s = processor_s()
        values = np.random.default_rng(0).standard_normal(100_000)
        for _ in range(15):
            np.sort(np.exp(values))
        total = 0
        for number in range(1_200_000):
            total += number & 7
        spent.append(processor_s() - began_s)
    return min(spent)


def processor_s() -> float:
    """Processor time of this process and of its children that have ended [s]."""
    of_children = os.times()
    return time.process_time() + of_children.children_user + of_children.children_system
