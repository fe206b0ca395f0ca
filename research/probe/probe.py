"""Probe representations of events: how well they encode bearing and proximity of the obstacles ahead.

Run: python -m platform.launch +exp=probe
Expect: after the run's own encoder, 32 short trainings (an hour on one core) and their probes (a quarter
of an hour). The trainings are stored in the run folder, so that a killed job resumes. One table and one
plot, in the run folder under `probe/` and in MLflow.
"""

import dataclasses
import functools
import re
from collections.abc import Callable, Sequence
from typing import Annotated, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from pydantic import Field
from pydantic.dataclasses import dataclass

from envs.config import STRICT, Split
from jobs.analysis.colours import BROWN, COLOURS, CYAN, GREYS, INK, MUTED, VIOLET
from jobs.analysis.plots import tidy
from jobs.analysis.tables import publish_plot, publish_table
from jobs.config.config import Config, ConfigError
from jobs.config.schema import Count
from jobs.run.folder import Run, finish, locate_run, open_run
from jobs.run.progress import progress
from jobs.tracking.tracker import open_tracker
from jobs.training.collect import knows_truth
from jobs.training.pretrain import encoder_file, prepare_encoder
from models.encoder.evae import EventVAE
from models.encoder.weights import load_encoder
from models.kinds import KINDS, Latent, Stack, Target
from research.probe.dataset import (
    ALARM_M,
    CELLS,
    ProbeData,
    cell_features,
    column_features,
    latents,
    nothing,
    record_probe_data,
    stacked,
)
from research.probe.readout import Interval, Scores, probe, scores
from research.trials import kept, trial_settings

OWN = "run's encoder"
# Colour and dashes [points] of each representation without a latent size; the targets have other colours.
LEVEL_LOOKS = (
    (GREYS[0], (0, (6, 3))),  # nothing
    (BROWN, (0, (2, 2))),  # image columns
    (CYAN, (0, (6, 2, 1, 2))),  # few cells
    (VIOLET, (0, (10, 2))),  # many cells
    (INK, (0, (1, 2))),  # the run's encoder
)


@dataclass(frozen=True, config=STRICT)
class Settings:
    """Settings of the probes: number of steps, and the event VAEs to train."""

    num_steps: Count
    num_validation_steps: Count
    iterations: Count
    seeds: Count
    latents: Annotated[list[Latent], Field(min_length=1, max_length=8)]
    targets: Annotated[list[Target], Field(min_length=1, max_length=5)]
    stacks: Annotated[list[Stack], Field(min_length=1, max_length=8)]


class Representation(NamedTuple):
    """A representation of events.

    Attributes:
        name: Name in the table.
        represent: Functions ProbeData -> float32 (N, D), one per training.
        place: Latent size and target of an event VAE trained here, or None.
    """

    name: str
    represent: Sequence[Callable[[ProbeData], np.ndarray]]
    place: tuple[int, str] | None = None


class ProbeResult(NamedTuple):
    """The scores of one representation.

    Attributes:
        representation: The representation.
        numbers: Size of the representation of a step [-].
        scores: Number of steps read together -> scores.
    """

    representation: Representation
    numbers: int
    scores: dict[int, Scores]


def run(config: Config) -> dict[str, float]:
    """Train the run's encoder if there is none yet, then probe it and its rivals; return the metrics.

    Raises:
        ConfigError: The policy has no event VAE.
    """
    name = locate_run(config).config.model.name
    if not KINDS[name].encoder:
        raise ConfigError(
            f"model: {name} has no event VAE to probe; choose bytestream, bytestream_xy or event_image_vae"
        )
    if "proximity" in config.own.targets and not knows_truth(locate_run(config).config):
        rule = "must not hold proximity unless model.target=proximity, which records it"
        raise ConfigError(f"probe.targets: {rule}, got {config.own.targets}")
    folder = open_run(config)
    config = folder.config
    with open_tracker(config, folder) as tracker:
        prepare_encoder(folder, tracker)
        own, _ = load_encoder(encoder_file(folder))
        train, held_out = record_both(config)
        rows = probe_representations(config, representations(folder, own), train, held_out)
        title = (
            f"Proximity read from each representation [%], and error of the bearing of obstacles within "
            f"{ALARM_M:g} m; {len(np.unique(held_out.episode))} episodes, 95 % intervals"
        )
        shown = config.model.stack
        lines = [result_cells(row, shown) for row in rows]
        publish_table(folder, tracker, "probe/table", title, headings(rows[0], shown), lines)
        tracker.table("probe/results", result_columns(rows))
        publish_plot(folder, tracker, "probe/probe", plot_probes(rows))
        read = {f"evae/probe_r2_{key(row)}": row.scores[shown].network[0] for row in rows}
        turned = {f"evae/probe_bearing_deg_{key(row)}": row.scores[shown].bearing_deg[0] for row in rows}
        tracker.log(0, read)
        tracker.log(0, turned)
    metrics = {name: value for name, value in (read | turned).items() if np.isfinite(value)}
    return finish(folder, "probe", metrics)


def record_both(config: Config) -> tuple[ProbeData, ProbeData]:
    """Record episodes to fit the probes to, and others in validation corridors to judge them by."""
    env = dataclasses.replace(config.env, observation="events")
    sizes: dict[Split, int] = {
        "train": config.own.num_steps,
        "validation": config.own.num_validation_steps,
    }
    with progress("Record probe data", sum(sizes.values()), "steps") as advance:
        train, held_out = (
            record_probe_data(dataclasses.replace(env, split=split), steps, config.seed, advance)
            for split, steps in sizes.items()
        )
    return train, held_out


def representations(folder: Run, own: EventVAE) -> list[Representation]:
    """Return the representations to compare; train their event VAEs, or read those trained before."""
    grid, settings = own.grid, folder.config.own
    compared = [
        Representation("nothing", [nothing]),
        Representation("image columns", [functools.partial(column_features, grid=grid)]),
    ]
    for across in CELLS:
        counted = functools.partial(cell_features, grid=grid, across=across)
        compared.append(Representation(f"{across} x {across} cells", [counted]))
    compared.append(Representation(OWN, [functools.partial(latents, evae=own)]))
    for target in settings.targets:
        for latent in settings.latents:
            models = [trained(folder, latent, target, seed) for seed in range(settings.seeds)]
            represent = [functools.partial(latents, evae=evae) for evae in models]
            compared.append(Representation(f"{target}, latent {latent}", represent, (latent, target)))
    return compared


def trained(folder: Run, latent: int, target: str, seed: int) -> EventVAE:
    """Return a briefly trained event VAE of a latent size and target; equal seeds give equal windows."""
    config, iterations = folder.config, folder.config.own.iterations
    file = folder.path / "probe" / "encoders" / f"{target}-{latent}-s{seed}-{iterations}.safetensors"
    settings = trial_settings(config, {"latent": latent, "target": target})
    return kept(folder, file, settings, seed, iterations)


def probe_representations(
    config: Config, compared: Sequence[Representation], train: ProbeData, held_out: ProbeData
) -> list[ProbeResult]:
    """Fit the probes to every representation, for every number of steps read together."""
    stacks = sorted({*config.own.stacks, config.model.stack})
    rows = []
    fits = len(stacks) * sum(len(one.represent) for one in compared)
    with progress("Probe", fits, "fits") as advance:
        for one in compared:
            features = [[represent(part) for part in (train, held_out)] for represent in one.represent]
            found = {}
            for stack in stacks:
                errors = []
                for seed, (x, x_held_out) in enumerate(features):
                    inputs = stacked(x, train.episode, stack), stacked(x_held_out, held_out.episode, stack)
                    errors.append(probe(inputs[0], train, inputs[1], held_out, seed))
                    advance(1, note=one.name)
                found[stack] = scores(errors, held_out)
            rows.append(ProbeResult(one, features[0][0].shape[1], found))
    return rows


def headings(row: ProbeResult, shown: int) -> tuple[str, ...]:
    """Return the headings of the table, which shows ridge and bearing only for `shown` steps."""
    networks = [f"Network, {_steps(stack)}" for stack in row.scores]
    linear, bearing = f"Ridge, {_steps(shown)}", f"Bearing, {_steps(shown)} [deg]"
    return "Representation", "Numbers a step", linear, *networks, bearing


def result_cells(row: ProbeResult, shown: int) -> tuple[str, ...]:
    """Return a text for each of `headings`."""
    networks = [_percent(part.network) for part in row.scores.values()]
    bearing, low, high = row.scores[shown].bearing_deg
    turned = f"{bearing:.1f} [{low:.1f}, {high:.1f}]"
    return row.representation.name, str(row.numbers), _percent(row.scores[shown].ridge), *networks, turned


def result_columns(rows: Sequence[ProbeResult]) -> dict[str, list[str | float]]:
    """Return all scores as columns of a tracker's table; the first column is unique."""
    pairs = [(row, stack) for row in rows for stack in row.scores]
    table: dict[str, list[str | float]] = {
        "representation": [f"{row.representation.name}, {_steps(stack)}" for row, stack in pairs],
        "numbers": [row.numbers * stack for row, stack in pairs],
    }
    for score in Scores._fields:
        for place, end in enumerate(("", "_low", "_high")):
            table[score + end] = [getattr(row.scores[stack], score)[place] for row, stack in pairs]
    return table


def key(row: ProbeResult) -> str:
    """Return the name of a representation as part of a metric's name."""
    return re.sub(r"[^a-z0-9]+", "_", row.representation.name.replace("'", ""))


def plot_probes(rows: Sequence[ProbeResult]) -> Figure:
    """Draw proximity's score and the bearing's error over the latent size, a column per number of steps."""
    stacks = list(rows[0].scores)
    figure = Figure(figsize=(4.2 * len(stacks) + 0.8, 7.2), layout="constrained")
    grid = figure.subplots(2, len(stacks), squeeze=False, sharex=True, sharey="row")
    for column, stack in zip(grid.T, stacks, strict=True):
        _draw(column[0], rows, [_scaled(row.scores[stack].network, 100) for row in rows])
        _draw(column[1], rows, [row.scores[stack].bearing_deg for row in rows])
        column[0].set_title(f"{_steps(stack)} read together", loc="left", fontsize=10)
        column[1].set_xlabel("Latent size")
    grid[0, 0].set_ylabel("Proximity read by the network, R2 [%]")
    grid[1, 0].set_ylabel(f"Error of the bearing within {ALARM_M:g} m [deg]")
    handles, entries = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, entries, loc="outside upper center", ncols=5, frameon=False, fontsize=9)
    return figure


def _draw(panel: Axes, rows: Sequence[ProbeResult], values: Sequence[Interval]) -> None:
    """Draw a line per target over the latent sizes, and a level per representation not trained here."""
    pairs = list(zip(rows, values, strict=True))
    levels = [(row.representation.name, value) for row, value in pairs if row.representation.place is None]
    for (name, value), (colour, dashes) in zip(levels, LEVEL_LOOKS, strict=True):
        if name != OWN:
            panel.axhspan(*value[1:], color=colour, alpha=0.08, lw=0)
        panel.axhline(value[0], color=colour, lw=1.6, ls=dashes, label=name)
    placed = [
        (*row.representation.place, value) for row, value in pairs if row.representation.place is not None
    ]
    targets = list(dict.fromkeys(target for _, target, _ in placed))
    for shift, target in enumerate(targets):
        sizes, points = zip(*((size, value) for size, own, value in placed if own == target), strict=True)
        middle, low, high = np.transpose(points)
        x = np.array(sizes) * 1.04 ** (shift - (len(targets) - 1) / 2)  # so that intervals do not overlap
        spread = (middle - low, high - middle)
        panel.errorbar(
            x, middle, yerr=spread, label=target, marker="o", ms=5, capsize=3, color=COLOURS[target]
        )
    shown = sorted({size for size, _, _ in placed})
    panel.set_xscale("log", base=2)
    panel.set_xticks(shown, [str(size) for size in shown])
    panel.set_xticks([], minor=True)
    panel.tick_params(colors=MUTED)
    tidy(panel, "y")


def _steps(stack: int) -> str:
    return f"{stack} step" + ("s" if stack > 1 else "")


def _scaled(value: Interval, factor: float) -> Interval:
    return value[0] * factor, value[1] * factor, value[2] * factor


def _percent(value: Interval) -> str:
    middle, low, high = _scaled(value, 100)
    return f"{middle:.0f} [{low:.0f}, {high:.0f}]"
