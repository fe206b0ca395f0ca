"""What a representation of events tells an agent: bearing and proximity of the obstacles ahead.

Run: python -m platform.launch +exp=probe
Expect: beyond the run's own encoder 32 short trainings, an hour on one core, and their probes, a
quarter of an hour; the trainings are kept in the run folder, so that a killed job goes on. One table and one
figure, in the run folder under `probe/` and in MLflow.
"""

import dataclasses
import functools
import re
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from envs.config import Split
from jobs.analysis.plots import GRID, INK, MUTED
from jobs.analysis.tables import draw_figure, publish_table
from jobs.config.config import Config, ConfigError
from jobs.run.folder import Run, finish, locate_run, open_run
from jobs.run.progress import progress
from jobs.studies.encoder.trials import kept, trial_settings
from jobs.studies.probe.dataset import (
    ALARM_M,
    CELLS,
    ProbeData,
    cells,
    columns,
    fly_and_look,
    latents,
    nothing,
    stacked,
)
from jobs.studies.probe.readout import Interval, Scores, probe, scores
from jobs.tracking.tracker import open_tracker
from jobs.training.pretrain import encoder_file, prepare_encoder
from models.encoder.evae import EventVAE
from models.encoder.weights import load_encoder
from models.kinds import KINDS

OWN = "run's encoder"
TARGET_COLOURS = {"occupancy": "#2563eb", "signed": "#d97706", "aged": "#059669", "counts": "#db2777"}
LEVEL_COLOURS = ("#9ca3af", "#6b7280", "#374151", "#111827")


class Form(NamedTuple):
    """A representation.

    Attributes:
        name: As the table says it.
        represent: ProbeData -> float32 (N, D), one function per training.
        place: Latent size and target of an event VAE trained here, or None.
    """

    name: str
    represent: Sequence[Callable[[ProbeData], np.ndarray]]
    place: tuple[int, str] | None = None


class Row(NamedTuple):
    """What one representation tells.

    Attributes:
        form: Which.
        numbers: How many it has for each step.
        scores: Of each number of steps that are read together.
    """

    form: Form
    numbers: int
    scores: dict[int, Scores]


def run(config: Config) -> dict[str, Any]:
    """Make the run's encoder if there is none yet, then probe it and its rivals.

    Raises:
        ConfigError: The policy has no event VAE.
    """
    name = locate_run(config).config.model.name
    if not KINDS[name].encoder:
        raise ConfigError(
            f"model: {name} has no event VAE to probe; choose bytestream, bytestream_xy or event_image_vae"
        )
    folder = open_run(config)
    config = folder.config
    with open_tracker(config, folder) as tracker:
        prepare_encoder(config, folder, tracker)
        own, _ = load_encoder(encoder_file(folder))
        flown = fly_both(config)
        rows = measure(config, forms(config, folder, own), *flown)
        title = (
            f"Proximity read from each representation [%], and error of the bearing of what is within "
            f"{ALARM_M:g} m; {len(np.unique(flown[1].flight))} flights, 95 % intervals"
        )
        shown = config.model.stack
        lines = [cells_of(row, shown) for row in rows]
        publish_table(folder, tracker, "probe/table", title, headings(rows[0], shown), lines)
        tracker.table("probe/results", as_columns(rows))
        draw_figure(folder, tracker, "probe/probe", probe_figure(rows))
        read = {f"evae/probe_r2_{key(row)}": row.scores[shown].network[0] for row in rows}
        turned = {f"evae/probe_bearing_deg_{key(row)}": row.scores[shown].bearing_deg[0] for row in rows}
        tracker.log(0, read)
        tracker.log(0, turned)
    figures = {name: value for name, value in (read | turned).items() if np.isfinite(value)}
    return finish(folder, "probe", figures)


def fly_both(config: Config) -> tuple[ProbeData, ProbeData]:
    """Flights to fit the probes to, and flights through validation corridors to judge them by."""
    env = dataclasses.replace(config.env, observation="events")
    sizes: dict[Split, int] = {
        "train": config.probe.num_steps,
        "validation": config.probe.num_validation_steps,
    }
    with progress("Fly and look", sum(sizes.values()), "steps") as advance:
        train, held_out = (
            fly_and_look(dataclasses.replace(env, split=split), steps, config.seed, advance)
            for split, steps in sizes.items()
        )
    return train, held_out


def forms(config: Config, folder: Run, own: EventVAE) -> list[Form]:
    """The representations to compare; the event VAEs among them are trained, or read if they were before."""
    grid, settings = own.grid, config.probe
    compared = [Form("nothing", [nothing]), Form("image columns", [functools.partial(columns, grid=grid)])]
    for across in CELLS:
        counted = functools.partial(cells, grid=grid, across=across)
        compared.append(Form(f"{across} x {across} cells", [counted]))
    compared.append(Form(OWN, [functools.partial(latents, evae=own)]))
    for target in settings.targets:
        for latent in settings.latents:
            models = [trained(config, folder, latent, target, seed) for seed in range(settings.seeds)]
            represent = [functools.partial(latents, evae=evae) for evae in models]
            compared.append(Form(f"{target}, latent {latent}", represent, (latent, target)))
    return compared


def trained(config: Config, folder: Run, latent: int, target: str, seed: int) -> EventVAE:
    """An event VAE of that latent size and target, trained briefly; the same seed gives the same windows."""
    iterations = config.probe.iterations
    file = folder.path / "probe" / "encoders" / f"{target}-{latent}-s{seed}-{iterations}.safetensors"
    settings = trial_settings(config, {"latent": latent, "target": target})
    return kept(config, folder, file, settings, seed, iterations)


def measure(config: Config, compared: Sequence[Form], train: ProbeData, held_out: ProbeData) -> list[Row]:
    """Fit the probes to every representation, for every number of steps read together."""
    stacks = sorted({*config.probe.stacks, config.model.stack})
    rows = []
    fits = len(stacks) * sum(len(form.represent) for form in compared)
    with progress("Probe", fits, "fits") as advance:
        for form in compared:
            features = [[represent(part) for part in (train, held_out)] for represent in form.represent]
            told = {}
            for stack in stacks:
                errors = []
                for seed, (x, x_held_out) in enumerate(features):
                    inputs = stacked(x, train.flight, stack), stacked(x_held_out, held_out.flight, stack)
                    errors.append(probe(inputs[0], train, inputs[1], held_out, seed))
                    advance(1, note=form.name)
                told[stack] = scores(errors, held_out)
            rows.append(Row(form, features[0][0].shape[1], told))
    return rows


def headings(row: Row, shown: int) -> tuple[str, ...]:
    """Of the table: ridge and bearing are shown for one number of steps."""
    networks = [f"Network, {_steps(stack)}" for stack in row.scores]
    linear, bearing = f"Ridge, {_steps(shown)}", f"Bearing, {_steps(shown)} [deg]"
    return "Representation", "Numbers a step", linear, *networks, bearing


def cells_of(row: Row, shown: int) -> tuple[str, ...]:
    """A row as text."""
    networks = [_percent(part.network) for part in row.scores.values()]
    bearing, low, high = row.scores[shown].bearing_deg
    turned = f"{bearing:.1f} [{low:.1f}, {high:.1f}]"
    return row.form.name, str(row.numbers), _percent(row.scores[shown].ridge), *networks, turned


def as_columns(rows: Sequence[Row]) -> dict[str, list[Any]]:
    """All scores as columns for a tracker; the first is unique."""
    pairs = [(row, stack) for row in rows for stack in row.scores]
    table: dict[str, list[Any]] = {
        "representation": [f"{row.form.name}, {_steps(stack)}" for row, stack in pairs],
        "numbers": [row.numbers * stack for row, stack in pairs],
    }
    for score in Scores._fields:
        for place, end in enumerate(("", "_low", "_high")):
            table[score + end] = [getattr(row.scores[stack], score)[place] for row, stack in pairs]
    return table


def key(row: Row) -> str:
    """The name of a representation as part of a metric's."""
    return re.sub(r"[^a-z0-9]+", "_", row.form.name.replace("'", ""))


def probe_figure(rows: Sequence[Row]) -> Figure:
    """Proximity read and error of the bearing against the latent size, a column for each number of steps."""
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


def _draw(panel: Axes, rows: Sequence[Row], values: Sequence[Interval]) -> None:
    """A line for each target over the latent sizes, a level for each representation without training."""
    pairs = list(zip(rows, values, strict=True))
    levels = [(row.form.name, value) for row, value in pairs if row.form.place is None]
    for (name, value), colour in zip(levels[:-1], LEVEL_COLOURS, strict=True):
        panel.axhspan(*value[1:], color=colour, alpha=0.08, lw=0)
        panel.axhline(value[0], color=colour, lw=1.2, ls="--", label=name)
    panel.axhline(levels[-1][1][0], color=INK, lw=1.6, ls=":", label=levels[-1][0])
    placed = [(*row.form.place, value) for row, value in pairs if row.form.place is not None]
    targets = list(dict.fromkeys(target for _, target, _ in placed))
    for shift, target in enumerate(targets):
        sizes, points = zip(*((size, value) for size, own, value in placed if own == target), strict=True)
        middle, low, high = np.transpose(points)
        x = np.array(sizes) * 1.04 ** (shift - (len(targets) - 1) / 2)  # so that intervals stand apart
        style: dict[str, Any] = {"marker": "o", "ms": 5, "capsize": 3, "color": TARGET_COLOURS[target]}
        panel.errorbar(x, middle, yerr=(middle - low, high - middle), label=target, **style)
    shown = sorted({size for size, _, _ in placed})
    panel.set_xscale("log", base=2)
    panel.set_xticks(shown, [str(size) for size in shown])
    panel.set_xticks([], minor=True)
    panel.grid(axis="y", color=GRID)
    panel.tick_params(colors=MUTED)
    panel.spines[["top", "right"]].set_visible(False)


def _steps(stack: int) -> str:
    return f"{stack} step" + ("s" if stack > 1 else "")


def _scaled(value: Interval, factor: float) -> Interval:
    return value[0] * factor, value[1] * factor, value[2] * factor


def _percent(value: Interval) -> str:
    middle, low, high = _scaled(value, 100)
    return f"{middle:.0f} [{low:.0f}, {high:.0f}]"
