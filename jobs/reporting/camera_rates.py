"""How much of what policies lose at other control rates is the paper's two-frame camera.

The study `+exp=camera_rates` trains by both cameras at three rates; docs/camera_rates.md has its plan.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from jobs.analysis.plots import BLUE, GREEN, MUTED, RED, tidy
from jobs.analysis.statistics import CONFIDENCE, Difference, crossed_difference, crossed_mean, holm
from jobs.analysis.tables import estimate_text, markdown_table
from jobs.evaluation.group_stats import CHANGE, RATE, episode_values
from jobs.evaluation.sweep_report import SweepFacts
from jobs.reporting.breaks import SweptEpisodes

CAMERAS = "camera_rates"  # name of the experiment, and of what is published of it
PIXELS, FRAMES = "pixels", "frames"  # cameras; a group is one of them and the rate of training
# Axes: rates by the own camera, and by `PIXELS`. With nothing changed each training has the rate of its own.
OWN, REPLACED = "control_hz", "pixels"
HEAD = ("Trained by", "at [Hz]", "At its rate [%]", "At all rates [%]", "Loss by rates [points]")
TESTS = ("Trained at [Hz]", "Measure", "`frames` minus `pixels` [points]", "p (Holm)")


class Group(NamedTuple):
    """Success of the trainings by one camera at one rate, bool (trainings, corridors) each.

    Attributes:
        own: Control rate [Hz] -> by its own camera.
        replaced: The same by `PIXELS` in its place.
    """

    own: Mapping[int, np.ndarray]
    replaced: Mapping[int, np.ndarray]


def groups_of(about: SweepFacts, episodes: SweptEpisodes) -> dict[tuple[int, str], Group]:
    """Rate of training [Hz] and camera -> what its trainings do.

    Args:
        about: What made the study.
        episodes: Of the study.

    Raises:
        ValueError: A camera was not trained, or not evaluated, at a rate at which another was trained.
    """
    found = {}
    for name in about["groups"]:
        camera, hz = name.removesuffix("hz").split("_")
        swept = {at: episode_values(own, "success") for (at, group), own in episodes.items() if group == name}
        own = {int(float(rate)): values for (axis, rate), values in swept.items() if axis == OWN}
        replaced = {int(float(rate)): values for (axis, rate), values in swept.items() if axis == REPLACED}
        found[int(hz), camera] = Group(dict(sorted(own.items())), dict(sorted(replaced.items())))
    trained = sorted({hz for hz, _ in found})
    every = {(hz, camera): set(trained) for hz in trained for camera in (FRAMES, PIXELS)}
    lacking = [key for key, rates in every.items() if key not in found or not rates <= set(found[key].own)]
    if lacking:
        raise ValueError(f"each camera must be trained and evaluated at {trained} Hz; lacking: {lacking}")
    return dict(sorted(found.items()))


def measures(group: Group, hz: int) -> dict[str, np.ndarray]:
    """What is tested of a group trained at a rate, by name (trainings, corridors)."""
    at_own = group.own[hz].astype(float)
    return {
        "success at its rate": at_own,
        "loss by rates": at_own - np.mean(list(group.own.values()), axis=0),
    }


def compared(groups: Mapping[tuple[int, str], Group]) -> list[tuple[int, str, Difference, float]]:
    """Rate of training, measure, `FRAMES` minus `PIXELS`, and its p; all are one family after Holm."""
    found = []
    for hz in sorted({hz for hz, _ in groups}):
        frames, pixels = (measures(groups[hz, camera], hz) for camera in (FRAMES, PIXELS))
        for name, bounds in zip(frames, (RATE, CHANGE), strict=True):
            found.append((hz, name, crossed_difference(frames[name], pixels[name], bounds)))
    adjusted = holm([1.0 if one.p is None else one.p for *_, one in found])
    return [(*one, p) for one, p in zip(found, adjusted, strict=True)]


def results_text(about: SweepFacts, episodes: SweptEpisodes) -> str:
    """What the results say, as Markdown: the tests, and the measures of each group."""
    groups = groups_of(about, episodes)
    tests = compared(groups)
    certain = sum(p < 1.0 - CONFIDENCE for *_, p in tests)
    lines = [(f"{hz}", name, estimate_text(one, 100, "+.0f"), f"{p:.2g}") for hz, name, one, p in tests]
    return "\n\n".join(
        [
            f"Of {len(tests)} comparisons of the cameras {certain or 'none'} "
            f"{'are' if certain > 1 else 'is'} certain after Holm.",
            markdown_table(TESTS, lines, 2).rstrip("\n"),
            markdown_table(HEAD, [_row(*name, one) for name, one in groups.items()], 1).rstrip("\n"),
            "Means with 95 % intervals by trainings and corridors, each alone.",
            "Success [%] at each rate: the mean, in brackets each training; -: not evaluated.",
            _by_rates(groups),
        ]
    )


def _row(hz: int, camera: str, group: Group) -> tuple[str, ...]:
    """The measures of a group as a row under `HEAD`."""
    at_own, loss = measures(group, hz).values()
    everywhere = np.mean(list(group.own.values()), axis=0)
    means = [estimate_text(crossed_mean(values, RATE), 100, ".0f") for values in (at_own, everywhere)]
    return (f"`{camera}`", f"{hz}", *means, estimate_text(crossed_mean(loss, CHANGE), 100, "+.0f"))


def _by_rates(groups: Mapping[tuple[int, str], Group]) -> str:
    """Success at every rate, also by `PIXELS` in place of `FRAMES`, as a table."""
    rates = sorted({rate for group in groups.values() for rate in group.own})
    lines = []
    for (hz, camera), group in groups.items():
        seen = {camera: group.own} if camera == PIXELS else {camera: group.own, PIXELS: group.replaced}
        for by, swept in seen.items():
            cells = [_each_text(swept[rate]) if rate in swept else "-" for rate in rates]
            lines.append((f"`{camera}`", f"{hz}", f"`{by}`", *cells))
    head = ("Trained by", "at [Hz]", "Evaluated by", *(f"{rate} Hz" for rate in rates))
    return markdown_table(head, lines, 3).rstrip("\n")


def _each_text(values: np.ndarray) -> str:
    """Success of trainings (trainings, corridors): mean and each [%]."""
    each = ", ".join(f"{100 * rate:.0f}" for rate in values.mean(axis=1))
    return f"{100 * values.mean():.0f} ({each})"


def draw(about: SweepFacts, episodes: SweptEpisodes) -> Figure:
    """Draw success against control rate, a panel for each rate of training, a dot for each training."""
    groups = groups_of(about, episodes)
    trained = sorted({hz for hz, _ in groups})
    figure = Figure(figsize=(3.4 * len(trained), 3.4), layout="constrained")
    panels = figure.subplots(1, len(trained), sharey=True, squeeze=False)[0]
    for panel, hz in zip(panels, trained, strict=True):
        pixels, frames = groups[hz, PIXELS], groups[hz, FRAMES]
        for label, colour, marker, aside, curve in (
            ("pixels", BLUE, "o", 0.96, pixels.own),
            ("frames", RED, "s", 1.0, frames.own),
            ("frames, then seen by pixels", GREEN, "^", 1.04, frames.replaced),
        ):
            rates = np.array(list(curve)) * aside
            success = 100 * np.array([values.mean(axis=1) for values in curve.values()])
            panel.plot(rates, success.mean(axis=1), color=colour, lw=1.4, label=label)
            panel.plot(rates, success, marker, color=colour, ms=3.5, alpha=0.7)
        panel.axvline(hz, color=MUTED, lw=0.8, ls=":")
        panel.set_xscale("log")
        panel.set_xticks(list(pixels.own), [f"{rate}" for rate in pixels.own])
        panel.xaxis.set_minor_locator(NullLocator())
        panel.set_xlabel("Control rate [Hz]")
        panel.set_title(f"Trained at {hz} Hz", loc="left", fontsize=10)
        tidy(panel)
    panels[0].set(ylabel="Success [%]", ylim=(-3, 103))
    panels[-1].legend(frameon=False, fontsize=8)
    return figure
