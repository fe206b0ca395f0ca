"""What a user should choose: settings as rows, a verdict for each by a stated rule, a page about them."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple, get_args

from jobs.analysis.statistics import Estimate
from jobs.analysis.tables import Summary, markdown_table
from jobs.analysis.tables import metrics as flown_metrics
from jobs.studies.front_plots import Panel, pareto
from jobs.studies.replays import Measured

DEFAULT, EXACT = "default", "most exact"
ENCODER_KNOBS = ("precision", "time bins", "newest events")  # they change no event
CAMERA_KNOB = "memory"  # another camera, not a coarser simulation of the same
MARGIN = 0.1  # of success: what may be lost
RULE = (
    "A setting is *as good* as the default if the 95 % interval of its success minus the default's, on the "
    f"same corridors (Newcombe's for pairs), lies above -{100 * MARGIN:.0f} points; *worse* if it lies "
    "below 0; else *undecided*: more flights would tell (`trade.trials`). A front (e: event error, a: other "
    "actions, s: success) holds what no other setting beats in that and in speed."
)
HEADINGS = (
    "Knob", "Setting", "Steps/s", "Event error [%]", "Latent error [% of sd]", "Other action [%]", "Flights",
    "Success [%]", "Success - default [points]", "Distance [m]", "Verdict", "Front",
)  # fmt: skip
Verdict = Literal["default", "as good", "worse", "undecided"]


class Row(NamedTuple):
    """One setting.

    Attributes:
        knob: What is varied.
        setting: To what.
        measured: Cost and errors on the recorded flights.
        flown: Success and distance on the held-out corridors.
        difference: Of success, to the default on the same corridors.
    """

    knob: str
    setting: str
    measured: Measured
    flown: Summary
    difference: Estimate

    @property
    def name(self) -> str:
        """Knob and setting in one, such as "precision int8"; the knob is not said twice."""
        return self.setting if self.knob in self.setting else f"{self.knob} {self.setting}".strip()

    @property
    def steps_per_s(self) -> float:
        """Environment steps a second on one core, with the policy's choice."""
        return 1e6 / self.measured.step_us

    @property
    def event_error(self) -> float | None:
        """None of a setting that changes no event."""
        return None if self.knob in ENCODER_KNOBS else self.measured.event_error


def verdict(row: Row) -> Verdict:
    """By `RULE`."""
    if row.knob == DEFAULT:
        return "default"
    low, high = row.difference.interval or (-1.0, 1.0)
    if low > -MARGIN:
        return "as good"
    return "worse" if high < 0.0 else "undecided"


def fronts(rows: Sequence[Row]) -> dict[str, list[int]]:
    """Places of the rows on each Pareto front, by rising cost: of event error, other actions and success."""
    costs = [row.measured.step_us for row in rows]
    known = [place for place, row in enumerate(rows) if row.event_error is not None]
    by_error = pareto([(costs[place], rows[place].measured.event_error) for place in known])
    others = [(cost, row.measured.other_action) for cost, row in zip(costs, rows, strict=True)]
    failures = [(cost, -row.flown.success) for cost, row in zip(costs, rows, strict=True)]
    return {"e": [known[place] for place in by_error], "a": pareto(others), "s": pareto(failures)}


def panels(rows: Sequence[Row]) -> list[Panel]:
    """What the figure shows over the cost: event error, other actions, success."""
    front = fronts(rows)
    nan = float("nan")
    errors = [nan if row.event_error is None else 100 * row.event_error for row in rows]
    others = [100 * row.measured.other_action for row in rows]
    success = [100 * row.flown.success for row in rows]
    intervals = [tuple(100 * end for end in row.flown.success_interval) for row in rows]
    return [
        Panel("Events that differ [%]", errors, None, front["e"]),
        Panel("Steps with another action [%]", others, None, front["a"]),
        Panel("Flights that reach the goal [%]", success, intervals, front["s"]),
    ]


def lines(rows: Sequence[Row]) -> list[tuple[str, ...]]:
    """The rows as text, one word per heading."""
    front = fronts(rows)
    return [
        (
            row.knob,
            row.setting,
            f"{row.steps_per_s:,.0f}",
            event_text(row),
            short(100 * row.measured.latent_error),
            short(100 * row.measured.other_action),
            str(row.flown.episodes),
            success_text(row),
            "" if row.knob == DEFAULT else difference_text(row),
            distance_text(row.flown),
            verdict(row),
            " ".join(name for name, places in front.items() if place in places),
        )
        for place, row in enumerate(rows)
    ]


def event_text(row: Row) -> str:
    """Event error [%]; "-" where no event changes."""
    return "-" if row.event_error is None else short(100 * row.event_error)


def success_text(row: Row) -> str:
    """Success [%] with its Wilson interval."""
    low, high = row.flown.success_interval
    return f"{100 * row.flown.success:.0f} [{100 * low:.0f}, {100 * high:.0f}]"


def difference_text(row: Row) -> str:
    """Difference of success to the default [points] with its interval."""
    value, (low, high) = row.difference.value, row.difference.interval or (-1.0, 1.0)
    return f"{100 * value:+.0f} [{100 * low:+.0f}, {100 * high:+.0f}]"


def distance_text(flown: Summary) -> str:
    """Mean distance [m] with its bootstrap interval, where there is one."""
    ends = "" if flown.distance_interval is None else " [{:.1f}, {:.1f}]".format(*flown.distance_interval)
    return f"{flown.distance_m:.1f}{ends}"


def short(value: float) -> str:
    """A number with two digits that count, whole from 10 on."""
    return f"{value:,.0f}" if abs(value) >= 10 else f"{value:.2g}"


def metrics(row: Row) -> dict[str, float]:
    """The figures of a row under the names that trackers know; what was not measured is left out."""
    low, high = row.difference.interval or (float("nan"), float("nan"))
    values = flown_metrics(row.flown) | {
        "perf/env_steps_per_second": row.steps_per_s,
        "evae/latent_error": row.measured.latent_error,
        "eval/other_action": row.measured.other_action,
        "eval/success_difference": row.difference.value,
        "eval/success_difference_low": low,
        "eval/success_difference_high": high,
    }
    if row.event_error is not None:
        values["sim/event_error"] = row.event_error
    return {name: value for name, value in values.items() if value == value}


def page(about: Mapping[str, Any], rows: Sequence[Row]) -> str:
    """The page: what was flown, figure, table, what to choose; every number is a row's.

    Args:
        about: See `jobs.studies.trade.trade.about`.
        rows: The default first, the most exact last.
    """
    table = markdown_table(HEADINGS, lines(rows), 2)
    parts = [
        "# How exact it must be",
        opening(about),
        "![Speed against event error, other actions and success](images/trade.png)",
        "## What to choose",
        RULE,
        "\n".join(f"- {line}" for line in advice(rows)),
        "## Every setting",
        table,
    ]
    parts += [f"Not flown: {name}: {reason}." for name, reason in about["failed"].items()]
    return "\n\n".join(part.strip() for part in parts) + "\n"


def opening(about: Mapping[str, Any]) -> str:
    """What was flown and measured, by which command, at which commit, on which machine."""
    return (
        f"Made on {about['date']} by `{about['command']}` at commit {about['commit']} on `{about['host']}` "
        f"({about['cpus']} CPUs), run `{about['run']}`.\n\n"
        f"One policy, `{about['policy']}` ({about['action']} actions), flies the same held-out corridors of "
        f"`{about['scene']}` under settings of the simulator and of its encoder, one changed at a time. "
        f"{about['replays']} recorded flights are flown again under each: steps per second (one core, "
        "simulation, encoder and policy, one vehicle), events that differ from the converged ones, error of "
        "the latent, in deviations, against float64 with exact time on converged events, and steps at which "
        "the policy chooses another action than on these. Intervals are 95 %."
    )


def advice(rows: Sequence[Row]) -> list[str]:
    """What the rows say, a sentence or two each; the default is the first, the most exact the last."""
    default, exact = rows[0], rows[-1]
    found = {name: [row for row in rows if verdict(row) == name] for name in get_args(Verdict)}
    good = found["default"] + found["as good"]
    same = [row for row in good if row.knob != CAMERA_KNOB]
    said = [_fastest(_fast(same), default), _exact(exact, default)]
    coarsest = max(same, key=lambda row: row.event_error or 0.0)
    said.append(
        f"**Events may differ.** Of the settings as good as the default, it included, {coarsest.name} has "
        f"the largest event error: {event_text(coarsest)} %."
    )
    cameras = [row for row in rows if row.knob == CAMERA_KNOB]
    if cameras:
        named = "; ".join(
            f"{row.name}: {event_text(row)} % of the events differ, success {difference_text(row)} points, "
            f"{verdict(row)}"
            for row in cameras
        )
        said.append(
            f"**Another camera** is no coarser simulation of this one, and not advised for it. {named}."
        )
    encoders = [row for row in good if row.knob in ENCODER_KNOBS]
    if encoders:
        fastest = _fast(encoders)
        said.append(
            f"**Of the encoder's settings** the fastest as good as the default is {fastest.name}: "
            f"{ratio(fastest, default)} the default's speed, latent error "
            f"{short(100 * fastest.measured.latent_error)} % against "
            f"{short(100 * default.measured.latent_error)} %."
        )
    if found["worse"]:
        named = "; ".join(f"{row.name} ({difference_text(row)})" for row in found["worse"])
        said.append(f"**Leave alone** what costs success [points]: {named}.")
    if found["undecided"]:
        named = "; ".join(row.name for row in found["undecided"])
        said.append(f"**Undecided** with so many flights: {named}.")
    return [
        *said,
        "All this is of one policy, trained with the default, in one scene; a policy trained with another "
        f"setting may bear it better. Of {len(rows) - 1} verdicts a few may be chance.",
    ]


def _fast(rows: Sequence[Row]) -> Row:
    return min(rows, key=lambda row: row.measured.step_us)


def _fastest(fastest: Row, default: Row) -> str:
    if fastest is default:
        return "**To fly fast**, keep the default: no faster setting is known to be as good."
    return (
        f"**To fly fast**, choose {fastest.name}, the fastest setting as good as the default: "
        f"{fastest.steps_per_s:,.0f} steps/s, {ratio(fastest, default)} the default's speed; success "
        f"{success_text(fastest)} % against {success_text(default)} %; another action than on converged "
        f"events in {short(100 * fastest.measured.other_action)} % of the steps."
    )


def _exact(exact: Row, default: Row) -> str:
    return (
        f"**The default** differs in {event_text(default)} % of the events from the most exact simulation, "
        f"which runs at {ratio(exact, default)} its speed, and chooses another action in "
        f"{short(100 * default.measured.other_action)} % of the steps. By success the most exact is "
        f"{verdict(exact)} ({difference_text(exact)} points)."
    )


def ratio(row: Row, default: Row) -> str:
    """Speed as a multiple of the default's."""
    return f"{row.steps_per_s / default.steps_per_s:.2g} times"
