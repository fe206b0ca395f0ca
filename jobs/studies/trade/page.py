"""The page that says which setting to choose: settings as rows, a verdict for each by a stated rule."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

from matplotlib.figure import Figure

from jobs.analysis.statistics import Estimate
from jobs.analysis.tables import (
    Summary,
    estimate_metrics,
    estimate_text,
    markdown_table,
    percent_text,
    short,
    summary_metrics,
)
from jobs.run.provenance import Provenance
from jobs.run.templates import render
from jobs.studies.front_plots import Panel, pareto, plot_choices
from jobs.studies.replays import Measured

TEMPLATE = Path(__file__).with_name("page.md.j2")  # it also states the rule of the verdicts
DEFAULT, EXACT = "default", "most exact"
ENCODER_KNOBS = ("precision", "time bins", "newest events")  # they change no event
CAMERA_KNOB = "memory"  # another camera, not a coarser simulation of the same
MARGIN = 0.1  # of success: what may be lost
HEADINGS = (
    "Knob", "Setting", "Steps/s", "Event error [%]", "Latent error [% of sd]", "Other action [%]", "Episodes",
    "Success [%]", "Success - default [points]", "Distance [m]", "Verdict", "Front",
)  # fmt: skip
SETTING_FIELDS = (
    "knob", "setting", "steps_per_s", "event_error", "latent_error", "other_action", "episodes",
    "success_rate", "success_low", "success_high", "difference", "difference_low", "difference_high",
    "distance_m", "verdict", "front",
)  # fmt: skip
Verdict = Literal["default", "as good", "worse", "undecided"]


class TradeFacts(Provenance):
    """What made the numbers of a trade: command, commit, machine and date, policy and corridors."""

    run: str
    command: str
    date: str
    policy: str
    scene: str
    action: str
    trials: int
    replays: int
    failed: Mapping[str, str]  # setting -> why it was not evaluated


class TradedSetting(NamedTuple):
    """One setting of the simulator or the encoder.

    Attributes:
        knob: What is varied.
        setting: To what.
        measured: Cost and errors on the recorded episodes.
        summary: Success and distance in the held-out corridors.
        difference: Of success, to the default in the same corridors.
    """

    knob: str
    setting: str
    measured: Measured
    summary: Summary
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
        """Event error; None for a setting that changes no event."""
        return None if self.knob in ENCODER_KNOBS else self.measured.event_error

    @property
    def event_text(self) -> str:
        """Event error [%] as text; "-" for a setting that changes no event."""
        return "-" if self.event_error is None else short(100 * self.event_error)

    @property
    def difference_text(self) -> str:
        """Difference of success to the default [points] with its interval, as text."""
        return estimate_text(self.difference, 100, "+.0f")

    @property
    def verdict(self) -> Verdict:
        """The verdict by the rule that the page states."""
        if self.knob == DEFAULT:
            return "default"
        low, high = self.difference.interval or (-1.0, 1.0)
        if low > -MARGIN:
            return "as good"
        return "worse" if high < 0.0 else "undecided"


def fronts(rows: Sequence[TradedSetting]) -> dict[str, list[int]]:
    """Places of the rows on each Pareto front, by rising cost: of event error, other actions and success."""
    costs = [row.measured.step_us for row in rows]
    known = [place for place, row in enumerate(rows) if row.event_error is not None]
    by_error = pareto([(costs[place], rows[place].measured.event_error) for place in known])
    others = [(cost, row.measured.other_action) for cost, row in zip(costs, rows, strict=True)]
    failures = [(cost, -row.summary.success.value) for cost, row in zip(costs, rows, strict=True)]
    return {"e": [known[place] for place in by_error], "a": pareto(others), "s": pareto(failures)}


def setting_values(rows: Sequence[TradedSetting]) -> list[dict[str, str]]:
    """What is published of each setting, by `SETTING_FIELDS`; all that the plot shows."""
    front = fronts(rows)
    found = []
    for place, row in enumerate(rows):
        ends = [row.summary.success.interval or (0.0, 1.0), row.difference.interval or (-1.0, 1.0)]
        numbers = (
            row.steps_per_s, row.event_error, row.measured.latent_error, row.measured.other_action,
            row.summary.episodes, row.summary.success.value, *ends[0], row.difference.value, *ends[1],
            row.summary.distance_m.value,
        )  # fmt: skip
        words = ["" if number is None else f"{float(number):.10g}" for number in numbers]
        letters = "".join(name for name, places in front.items() if place in places)
        values = (row.knob, row.setting, *words, row.verdict, letters)
        found.append(dict(zip(SETTING_FIELDS, values, strict=True)))
    return found


def draw_settings(settings: Sequence[Mapping[str, str]]) -> Figure:
    """Draw what settings cost and give, from their published values (`setting_values`)."""
    named = [(one["knob"], one["setting"], float(one["steps_per_s"])) for one in settings]
    return plot_choices(named, panels(settings))


def panels(settings: Sequence[Mapping[str, str]]) -> list[Panel]:
    """What the plot shows over the cost: event error, other actions, success."""

    def percent(name: str) -> list[float]:
        return [100 * float(one[name] or "nan") for one in settings]

    def front(letter: str) -> list[int]:
        own = [place for place, one in enumerate(settings) if letter in one["front"]]
        return sorted(own, key=lambda place: -float(settings[place]["steps_per_s"]))

    intervals = list(zip(percent("success_low"), percent("success_high"), strict=True))
    return [
        Panel("Events that differ [%]", percent("event_error"), None, front("e")),
        Panel("Steps with another action [%]", percent("other_action"), None, front("a")),
        Panel("Episodes that reach the goal [%]", percent("success_rate"), intervals, front("s")),
    ]


def trade_lines(rows: Sequence[TradedSetting]) -> list[tuple[str, ...]]:
    """The rows as text, one for each of `HEADINGS`."""
    front = fronts(rows)
    return [
        (
            row.knob,
            row.setting,
            f"{row.steps_per_s:,.0f}",
            row.event_text,
            short(100 * row.measured.latent_error),
            short(100 * row.measured.other_action),
            str(row.summary.episodes),
            percent_text(row.summary.success),
            "" if row.knob == DEFAULT else row.difference_text,
            estimate_text(row.summary.distance_m),
            row.verdict,
            " ".join(name for name, places in front.items() if place in places),
        )
        for place, row in enumerate(rows)
    ]


def trade_metrics(row: TradedSetting) -> dict[str, float]:
    """The metrics of a row under the names that trackers know; what was not measured is left out."""
    values = summary_metrics(row.summary) | {
        "perf/env_steps_per_second": row.steps_per_s,
        "evae/latent_error": row.measured.latent_error,
        "eval/other_action": row.measured.other_action,
        **estimate_metrics("eval/success_difference", row.difference),
    }
    if row.event_error is not None:
        values["sim/event_error"] = row.event_error
    return {name: value for name, value in values.items() if value == value}


class Advice(NamedTuple):
    """Which settings to choose, and which not.

    Attributes:
        fastest: The fastest of the default and those as good as it, with the same camera.
        coarsest: The one of these with the largest event error.
        encoder: The fastest setting of the encoder that is as good; None: there is none.
        cameras: Settings that are another camera.
        worse: Settings that are known to cost success.
        undecided: Settings of which too little is known.
    """

    fastest: TradedSetting
    coarsest: TradedSetting
    encoder: TradedSetting | None
    cameras: list[TradedSetting]
    worse: list[TradedSetting]
    undecided: list[TradedSetting]


def advise(rows: Sequence[TradedSetting]) -> Advice:
    """Choose among the settings by their verdicts."""

    def speed(row: TradedSetting) -> float:
        return row.steps_per_s

    good = [row for row in rows if row.verdict in ("default", "as good")]
    same = [row for row in good if row.knob != CAMERA_KNOB]
    return Advice(
        fastest=max(same, key=speed),
        coarsest=max(same, key=lambda row: row.event_error or 0.0),
        encoder=max((row for row in good if row.knob in ENCODER_KNOBS), key=speed, default=None),
        cameras=[row for row in rows if row.knob == CAMERA_KNOB],
        worse=[row for row in rows if row.verdict == "worse"],
        undecided=[row for row in rows if row.verdict == "undecided"],
    )


def trade_page(about: TradeFacts, rows: Sequence[TradedSetting]) -> str:
    """The page: what was evaluated, plot, advice, table; every number is a row's.

    Args:
        about: What made the numbers.
        rows: The default first, the most exact last.
    """
    return render(
        TEMPLATE,
        about=about,
        default=rows[0],
        exact=rows[-1],
        **advise(rows)._asdict(),
        ratio=lambda row: f"{row.steps_per_s / rows[0].steps_per_s:.2g}",
        count=len(rows),
        margin=f"{100 * MARGIN:.0f}",
        percent_text=percent_text,
        short=short,
        table=markdown_table(HEADINGS, trade_lines(rows), 2),
    )
