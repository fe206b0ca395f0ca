"""What a soak has to say: the faults and what followed, rounds, trends of memory, what was left behind."""

import dataclasses
from collections import defaultdict
from collections.abc import Sequence

from jobs.analysis.tables import markdown_table
from tests.soak.workload import Round


@dataclasses.dataclass(frozen=True)
class Event:
    """One fault that was injected.

    Attributes:
        minute: When.
        fault: Which.
        outcome: What followed, in a few words.
        seconds: From the end of the fault until all affected jobs had new results; None: they did not.
        well: Whether that is what must follow.
    """

    minute: float
    fault: str
    outcome: str
    seconds: float | None
    well: bool


@dataclasses.dataclass(frozen=True)
class Summary:
    """All that is reported of a soak.

    Attributes:
        slopes: Role -> trend of its memory [MB/h]; None where no process lived long enough.
        findings: What must not be, one line each.
        facts: Other numbers worth knowing, one line each.
    """

    minutes: float
    seed: int
    events: Sequence[Event]
    rounds: Sequence[Round]
    slopes: dict[str, float | None]
    findings: Sequence[str]
    facts: Sequence[str]


def fault_table(events: Sequence[Event]) -> str:
    """Fault, times, outcomes, and seconds until the jobs went on."""
    by_fault: dict[str, list[Event]] = defaultdict(list)
    for event in events:
        by_fault[event.fault].append(event)
    rows = []
    for fault, own in sorted(by_fault.items()):
        outcomes = [event.outcome for event in own]
        counted = [f"{what} ({outcomes.count(what)})" for what in dict.fromkeys(outcomes)]
        seconds = [event.seconds for event in own if event.seconds is not None]
        span = f"{min(seconds):.0f} to {max(seconds):.0f}" if seconds else "-"
        well = sum(event.well for event in own)
        rows.append([fault, str(len(own)), str(well), "; ".join(counted), span])
    head = ("fault", "times", "as it must be", "outcome", "seconds until going on again")
    return markdown_table(head, rows, 4)


def round_table(rounds: Sequence[Round]) -> str:
    """Job, rounds, commands, whether the tables and the policies equal those of the undisturbed round."""
    rows = []
    for lane in dict.fromkeys(one.lane for one in rounds):
        own = [one for one in rounds if one.lane == lane]
        disturbed = own[1:]
        equal = sum(not one.differs for one in disturbed)
        policies = [one.policy_equal for one in disturbed if one.policy_equal is not None]
        commands = sum(one.commands for one in disturbed)
        rows.append([
            lane, str(len(disturbed)), str(commands), f"{equal} of {len(disturbed)}",
            f"{sum(policies)} of {len(policies)}" if policies else "-",
            f"{own[0].seconds:.0f}", f"{max((one.seconds for one in disturbed), default=0):.0f}",
        ])  # fmt: skip
    head = ("job", "disturbed rounds", "commands given", "tables equal", "policy equal",
            "seconds undisturbed", "longest")  # fmt: skip
    return markdown_table(head, rows, 1)


def markdown(summary: Summary) -> str:
    """The whole report."""
    well = sum(event.well for event in summary.events)
    slopes = [
        [role, "-" if slope is None else f"{slope:+.0f}"] for role, slope in sorted(summary.slopes.items())
    ]
    parts = [
        f'`make test-soak ARGS="minutes={summary.minutes:g} seed={summary.seed}"`: '
        f"{len(summary.events)} faults, {well} ended as they must.",
        round_table(summary.rounds),
        fault_table(summary.events),
        markdown_table(("memory of", "trend within a process [MB/h]"), slopes, 1),
        "\n".join(f"- {line}" for line in [*summary.facts, *summary.findings]),
    ]
    return "\n\n".join(part.strip() for part in parts if part.strip()) + "\n"
