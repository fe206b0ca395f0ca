"""Write the page that recommends settings: a row per setting, with a verdict by a stated rule."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from jobs.analysis.statistics import Difference, Estimate, Interval, holm
from jobs.analysis.tables import estimate_metrics, estimate_text, markdown_table, percent_text, short
from jobs.measure.measured import name_of
from jobs.run.provenance import Provenance
from jobs.run.templates import render

TEMPLATE = Path(__file__).with_name("trade_page.md.j2")  # also states the rule for the verdicts
DEFAULT, EXACT = "default", "most exact"
ENCODER_KNOBS = ("precision", "time bins", "newest events")  # these do not change events
CAMERA_KNOB = "memory"  # a different camera, not a coarser simulation of the same one
OTHER_CAMERAS = ("the paper's camera",)  # combined settings with a different camera
MARGIN = 0.1  # acceptable loss of success
ALL = "all"  # group name for all trainings together in the published settings
SETTING_FIELDS = (
    "scene", "knob", "setting", "policies", "trainings", "episodes", "steps_per_s",
    "speed", "speed_low", "speed_high", "event_error", "latent_error", "other_action",
    "success_rate", "success_low", "success_high", "difference", "difference_low", "difference_high",
    "verdict", "front",
)  # fmt: skip
Verdict = Literal["default", "as good", "worse", "undecided"]


class TradeFacts(Provenance):
    """Provenance of a trade: command, commit, machine and date, policies and corridors."""

    run: str
    command: str
    date: str
    policies: Mapping[str, int]  # group -> trainings
    scenes: Sequence[str]
    met: Mapping[str, Sequence[str]]  # group -> settings of fidelity that its trainings drew
    action: str
    trials: int
    pyrender_trials: int
    replays: int
    failed: Mapping[str, str]  # setting -> why it was not evaluated


class Outcome(NamedTuple):
    """Results of trainings under a setting in a scene.

    Attributes:
        trainings: Number of trainings.
        episodes: Number of episodes of all trainings.
        success: Success rate.
        difference: Difference of success to the default setting, paired by training and corridor.
        other_action: Share of steps with a different action than on converged events.
    """

    trainings: int
    episodes: int
    success: Estimate
    difference: Difference
    other_action: float


class TradedSetting(NamedTuple):
    """One setting of the simulator or the encoder in one scene.

    Attributes:
        scene: Name of the scene.
        knob: Name of the varied knob.
        setting: Value of the knob.
        step_us: Median process time of an environment step including the policy's choice [us].
        speed: Speed relative to the default, with an interval over repeated timings.
        event_error: Error against converged events.
        latent_error: Root mean square error, in standard deviations of the exact latents.
        outcomes: Group -> results of its trainings; `ALL` -> results of all trainings.
    """

    scene: str
    knob: str
    setting: str
    step_us: float
    speed: Estimate
    event_error: float
    latent_error: float
    outcomes: Mapping[str, Outcome]

    @property
    def name(self) -> str:
        """Return knob and setting as one text, such as "precision int8", without repeating the knob."""
        return name_of(self.knob, self.setting)

    @property
    def steps_per_s(self) -> float:
        """Return the environment steps per second on one core, including the policy's choice."""
        return 1e6 / self.step_us

    @property
    def known_error(self) -> float | None:
        """Return the event error; None for a setting that does not change events."""
        return None if self.knob in ENCODER_KNOBS else self.event_error

    @property
    def together(self) -> Outcome:
        """Return the result of all trainings together."""
        return self.outcomes[ALL]


def verdicts(rows: Sequence[TradedSetting]) -> list[Verdict]:
    """Return a verdict for each row by the rule stated on the page; all `rows` form one family of tests."""
    tested = [row.together.difference.p for row in rows if row.knob != DEFAULT]
    adjusted = iter(holm([1.0 if p is None else p for p in tested]))
    return [_verdict(row, 1.0 if row.knob == DEFAULT else next(adjusted)) for row in rows]


def _verdict(row: TradedSetting, p: float) -> Verdict:
    if row.knob == DEFAULT:
        return "default"
    difference = row.together.difference
    low, _ = difference.interval or (-1.0, 1.0)
    worst = min(outcome.difference.value for outcome in row.outcomes.values())
    if low > -MARGIN and worst > -MARGIN:
        return "as good"
    return "worse" if difference.value < 0.0 and p < 0.05 else "undecided"


def on_front(rows: Sequence[TradedSetting]) -> list[bool]:
    """Mark the settings of a scene that no other beats by being as exact and significantly faster."""
    return [
        row.known_error is not None
        and not any(
            other.known_error is not None
            and other.known_error <= row.event_error
            and _ends(other.speed)[0] > _ends(row.speed)[1]
            for other in rows
        )
        for row in rows
    ]


def _ends(speed: Estimate) -> Interval:
    """Return the interval of a speed; 0 to infinity for a single timing."""
    return speed.interval or (0.0, float("inf"))


def setting_values(rows: Sequence[TradedSetting]) -> list[dict[str, str]]:
    """Return the published values as `SETTING_FIELDS` -> text: a line per setting and group, and for all."""
    fronts = [front for own in by_scene(rows) for front in on_front(own)]
    found = []
    for row, verdict, front in zip(rows, verdicts(rows), fronts, strict=True):
        for group, outcome in row.outcomes.items():
            numbers = (
                outcome.trainings, outcome.episodes, row.steps_per_s,
                row.speed.value, *_ends(row.speed),
                row.known_error, row.latent_error, outcome.other_action,
                outcome.success.value, *(outcome.success.interval or (0.0, 1.0)),
                outcome.difference.value, *(outcome.difference.interval or (-1.0, 1.0)),
            )  # fmt: skip
            words = ["" if number is None else f"{float(number):.10g}" for number in numbers]
            values = (row.scene, row.knob, row.setting, group, *words, verdict, "yes" if front else "no")
            found.append(dict(zip(SETTING_FIELDS, values, strict=True)))
    return found


def by_scene(rows: Sequence[TradedSetting]) -> list[list[TradedSetting]]:
    """Group the rows by scene."""
    scenes = dict.fromkeys(row.scene for row in rows)
    return [[row for row in rows if row.scene == scene] for scene in scenes]


def headings(groups: Sequence[str]) -> tuple[str, ...]:
    """Return the headings of a scene's table."""
    costs = ("Knob", "Setting", "Steps/s", "Speed [times the default's]")
    errors = ("Event error [%]", "Latent error [% of sd]", "Other action [%]")
    reached = [f"{word} `{group}`" for group in groups for word in ("Success [%]", "- default [points]")]
    return (*costs, *errors, *reached, "All - default [points]", "Verdict")


def trade_lines(rows: Sequence[TradedSetting], groups: Sequence[str]) -> list[tuple[str, ...]]:
    """Return the rows as texts under `headings`; all rows form one family for the verdicts."""
    return [
        (
            row.knob,
            row.setting,
            f"{row.steps_per_s:,.0f}",
            estimate_text(row.speed, 1, ".2f"),
            "-" if row.known_error is None else short(100 * row.known_error),
            short(100 * row.latent_error),
            short(100 * row.together.other_action),
            *(text for group in groups for text in _reached(row, group)),
            "" if row.knob == DEFAULT else points_text(row.together.difference),
            verdict,
        )
        for row, verdict in zip(rows, verdicts(rows), strict=True)
    ]


def _reached(row: TradedSetting, group: str) -> tuple[str, str]:
    outcome = row.outcomes.get(group)
    if outcome is None:
        return "-", "-"
    return percent_text(outcome.success), "" if row.knob == DEFAULT else points_text(outcome.difference)


def points_text(difference: Difference) -> str:
    """Return a difference of rates with its interval as text [points]."""
    return estimate_text(difference, 100, "+.0f")


def trade_metrics(row: TradedSetting, group: str = ALL) -> dict[str, float]:
    """Return the metrics of a row under the tracker's names, without values that are NaN."""
    outcome = row.outcomes[group]
    values = {
        "perf/env_steps_per_second": row.steps_per_s,
        **estimate_metrics("perf/speed_ratio", row.speed),
        "evae/latent_error": row.latent_error,
        "eval/other_action": outcome.other_action,
        **estimate_metrics("eval/success_rate", outcome.success),
        **estimate_metrics("eval/success_difference", outcome.difference),
    }
    if row.known_error is not None:
        values["sim/event_error"] = row.known_error
    return {name: value for name, value in values.items() if value == value}


class Choice(NamedTuple):
    """One setting in all scenes: its rows, and their common verdict.

    Attributes:
        rows: One for each scene.
        verdict: The verdict of the scenes if they agree; else "worse" if so in any scene, or "undecided".
    """

    rows: tuple[TradedSetting, ...]
    verdict: Verdict

    @property
    def name(self) -> str:
        """Return `TradedSetting.name`."""
        return self.rows[0].name

    @property
    def speed(self) -> float:
        """Return the geometric mean over the scenes of the speed relative to the default."""
        return float(np.exp(np.mean([np.log(row.speed.value) for row in self.rows])))

    @property
    def is_faster(self) -> bool:
        """Whether the setting is significantly faster than the default in every scene."""
        return all(_ends(row.speed)[0] > 1.0 for row in self.rows)


def choices(rows: Sequence[TradedSetting]) -> list[Choice]:
    """Return the settings that are present in all scenes, in the order of the rows."""
    found: dict[tuple[str, str], list[tuple[TradedSetting, Verdict]]] = {}
    for row, verdict in zip(rows, verdicts(rows), strict=True):
        found.setdefault((row.knob, row.setting), []).append((row, verdict))
    whole = [own for own in found.values() if len(own) == len(by_scene(rows))]
    return [Choice(tuple(row for row, _ in own), _joined([verdict for _, verdict in own])) for own in whole]


def _joined(several: Sequence[Verdict]) -> Verdict:
    if len(set(several)) == 1:
        return several[0]
    return "worse" if "worse" in several else "undecided"


class Advice(NamedTuple):
    """Settings to choose, and settings to avoid.

    Attributes:
        fastest: The fastest setting as good as the default, with the same camera; None: none is faster.
        coarsest: The setting with the largest event error among the default and settings as good, with the
            same camera.
        encoder: The fastest encoder setting as good as the default; None: none is faster.
        cameras: Settings with a different camera.
        worse: Settings that significantly reduce success.
        undecided: Settings without a decision.
    """

    fastest: Choice | None
    coarsest: Choice
    encoder: Choice | None
    cameras: list[Choice]
    worse: list[Choice]
    undecided: list[Choice]


def advise(rows: Sequence[TradedSetting]) -> Advice:
    """Choose among the settings by their verdicts."""
    every = choices(rows)
    cameras = [
        one for one in every if one.rows[0].knob == CAMERA_KNOB or one.rows[0].setting in OTHER_CAMERAS
    ]
    same = [one for one in every if one.verdict in ("default", "as good") and one not in cameras]
    faster = [one for one in same if one.is_faster]
    return Advice(
        fastest=max(faster, key=lambda one: one.speed, default=None),
        coarsest=max(same, key=lambda one: max(row.known_error or 0.0 for row in one.rows)),
        encoder=max(
            (one for one in faster if one.rows[0].knob in ENCODER_KNOBS),
            key=lambda one: one.speed,
            default=None,
        ),
        cameras=cameras,
        worse=[one for one in every if one.verdict == "worse"],
        undecided=[one for one in every if one.verdict == "undecided"],
    )


def trade_page(about: TradeFacts, rows: Sequence[TradedSetting]) -> str:
    """Return the page: advice, plot, the settings named in the advice, and how they were evaluated.

    Args:
        about: Provenance of the numbers.
        rows: All rows, scene by scene; in each scene the default first, the most exact setting last.
    """
    advice = advise(rows)
    return render(
        TEMPLATE,
        about=about,
        **advice._asdict(),
        count=sum(row.knob != DEFAULT for row in rows),
        margin=f"{100 * MARGIN:.0f}",
        points_text=points_text,
        short=short,
        table=advice_table(advice, choices(rows)),
    )


def advice_table(advice: Advice, every: Sequence[Choice]) -> str:
    """Return a table of the default, the settings named in the advice, and the most exact setting."""
    best = [advice.fastest, advice.encoder, advice.coarsest]
    named = [*best, *advice.cameras, *advice.worse, *advice.undecided]
    shown = [one for one in every if one in named or one in (every[0], every[-1])]
    scenes = [row.scene for row in every[0].rows]
    columns = ("speed", "events that differ [%]", "success [points]")
    head = ("setting", *(f"{column}, `{scene}`" for scene in scenes for column in columns), "verdict")
    lines = [
        (one.name, *(text for row in one.rows for text in _scene_texts(row)), one.verdict) for one in shown
    ]
    return markdown_table(head, lines)


def _scene_texts(row: TradedSetting) -> tuple[str, str, str]:
    error = "-" if row.known_error is None else short(100 * row.known_error)
    change = "" if row.knob == DEFAULT else points_text(row.together.difference)
    return estimate_text(row.speed, 1, ".2f"), error, change
