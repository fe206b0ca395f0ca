"""Search for the best settings of a training (Optuna's TPE; ASHA: Li et al. 2020).

Run: python -m platform.launch +exp=search model=event_columns
Expect: each trial is a training on one core; trials run in parallel on all cores. In the run folder under
`tune-HASH/`: every measurement, a figure of all curves and a table; in MLflow a child run for each trial. All
trials are measured in the same validation corridors, which training and evaluation do not use. To resume a
stopped search, run the same command again.
"""

import dataclasses
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import optuna
from matplotlib.figure import Figure
from pydantic import Field
from pydantic.dataclasses import dataclass
from ray import tune
from ray.tune.schedulers import ASHAScheduler
from ray.tune.search.optuna import OptunaSearch

from envs.config import STRICT, settings_hash
from jobs.analysis.colours import BLUE, GREYS, INK
from jobs.analysis.plots import tidy
from jobs.analysis.tables import publish_plot, publish_table
from jobs.config.conditions import Searched
from jobs.config.config import Config, ConfigError
from jobs.config.schema import Count
from jobs.run.files import append_json_lines, json_lines, read_json_lines, write_atomic
from jobs.run.folder import Run, finish, finished, locate_run, open_run
from jobs.run.progress import console, progress
from jobs.run.ray_cluster import fit, start_ray, storage
from jobs.tools.search.space import (
    encoder_facts,
    extremes,
    read_settings,
    sampled,
    search_space,
    space_errors,
    with_settings,
)
from jobs.tools.search.trial import Files, SearchTrial
from jobs.tracking.child_runs import ChildRun, write_child_runs
from jobs.tracking.tracker import Tracker, open_tracker
from jobs.training.inputs import check_inputs, prepare_inputs
from jobs.training.train import TrainingError, can_continue, relayed_to, run_config, stopped
from models.policy.policy import ENCODER_FILES, NETWORKS

REDUCTION = 3  # one in so many trials continues beyond each rung of ASHA
METRIC = "distance_m"  # success stays 0 for long, and cannot rank trials early
HEADINGS = ("trial", "settings", "steps", "distance [m]", "success [%]")
Row = dict[str, Any]  # one measurement: trial, env_steps, settings, distance_m, success_rate, metrics


@dataclass(frozen=True, config=STRICT)
class Settings:
    """The settings to search, and the budget of the trials.

    Attributes:
        space: Key -> a list of values, or a range as in `jobs.config.conditions`.
        trials: Number of trainings to start; most are stopped early.
        report_steps: Environment steps between measurements; no trial is stopped before the first one.
        episodes: Validation corridors of each measurement.
    """

    space: Annotated[dict[str, Searched], Field(min_length=1)]
    trials: Count
    report_steps: Count
    episodes: Count


def run(config: Config) -> dict[str, float]:
    """Run or resume the search; return the best trial's measurement.

    Raises:
        ConfigError: A key cannot be searched, or one of its values is invalid.
        TrainingError: No trial reached a measurement.
    """
    errors = list(dict.fromkeys(space_errors(locate_run(config).config)))
    if errors:
        raise ConfigError("\n".join(errors))
    check_inputs(config)
    folder = open_run(config)
    config = folder.config
    name = place_name(config.own)
    with open_tracker(config, folder, key=name) as tracker:
        tracker.tags({"kind": "tune"})
        files = _inputs(folder, tracker)
        begun = earlier_trials(folder, config.own)
        rows = search(config, folder.path / name, files, tracker, begun)
        best = report(folder, name, rows, tracker)
        console.print(tracker.dashboard())
    figures = {key: float(best[key]) for key in ("distance_m", "success_rate", "env_steps")}
    return finish(folder, name, figures)


def _inputs(folder: Run, tracker: Tracker) -> Files:
    """Return name -> content of the shared encoder, if there is one, and of the initial policy, if any.

    If the space changes the encoder, the result is empty, and each trial trains its own encoder.
    """
    config = folder.config
    facts = encoder_facts(config)
    points = [{key: value} for key, values in config.own.space.items() for value in extremes(values)]
    if facts is not None and any(encoder_facts(with_settings(config, point)) != facts for point in points):
        console.print("The space changes the encoder: each trial collects and pretrains its own.")
        return {}
    encoder = prepare_inputs(folder, tracker)
    files = [] if encoder is None else [encoder.with_name(name) for name in ENCODER_FILES]
    files += [folder.init / NETWORKS] if config.train.init is not None else []
    return {file.name: file.read_bytes() for file in files}


def place_name(own: Settings) -> str:
    """Return the name of a search's folder in its run folder; "tune" is an earlier name of the job."""
    return f"tune-{settings_hash(dataclasses.asdict(own))[:8]}"


class Earlier(NamedTuple):
    """A finished search with fewer trials and otherwise equal settings, which this search continues."""

    trials: int = 0
    rows: Sequence[Row] = ()


def earlier_trials(folder: Run, own: Settings) -> Earlier:
    """Return the largest finished search with fewer trials and otherwise equal settings, or none."""
    for trials in range(own.trials - 1, 0, -1):
        name = place_name(dataclasses.replace(own, trials=trials))
        file = folder.path / name / "results.jsonl"
        if finished(folder, name) is not None and file.is_file():
            return Earlier(trials, read_json_lines(file))
    return Earlier()


def search(config: Config, place: Path, files: Files, tracker: Tracker, begun: Earlier) -> list[Row]:
    """Run the missing trials; return all measurements of all trials, in order of arrival."""
    start_ray(config.cluster, place.parent)
    place.mkdir(exist_ok=True)
    file = place / "results.jsonl"
    if begun.trials and not file.is_file():
        console.print(f"Continues a finished search: {begun.trials} of {config.own.trials} trials are there.")
        write_atomic(file, json_lines(begun.rows))
    rows: list[Row] = read_json_lines(file)
    known, total = {(row["trial"], row["env_steps"]) for row in rows}, config.own.trials
    with progress("Tune", total, "trials", done=len({row["trial"] for row in rows})) as advance:

        def listen(result: Mapping[str, Any]) -> None:
            row = measurement(result)
            if (row["trial"], row["env_steps"]) in known:
                return
            new = row["trial"] not in {one["trial"] for one in rows}
            known.add((row["trial"], row["env_steps"]))
            rows.append(row)
            append_json_lines(file, [row])
            write_child_runs(tracker, "trial", [child_run(of_trial(rows, row["trial"]))])
            advance(int(new), note=f"{row['trial']}: {row['distance_m']:.1f} m at {row['env_steps']:,} steps")

        with relayed_to(listen):
            results = fit(_tuner(config, place, files, begun))
    if not rows and results.errors:
        raise TrainingError(stopped(results.errors[0]))
    return rows


def _tuner(config: Config, place: Path, files: Files, begun: Earlier) -> tune.Tuner:
    """Return Tune's search: restored if the folder has one, else new."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    path, most = storage(config.cluster, place), config.train.env_steps
    trial = tune.with_resources(tune.with_parameters(SearchTrial, base=config, files=files), {"cpu": 1})
    if can_continue(path, place):
        return tune.Tuner.restore(path, trial, resume_unfinished=True, resume_errored=True)
    scheduler = ASHAScheduler(
        time_attr="env_steps",
        grace_period=min(config.own.report_steps, most),
        max_t=most,
        reduction_factor=REDUCTION,
    )
    return tune.Tuner(
        trial,
        param_space=search_space(config.own.space),
        tune_config=tune.TuneConfig(
            metric=METRIC,
            mode="max",
            num_samples=config.own.trials - begun.trials,
            search_alg=_optuna(config, begun),
            scheduler=scheduler,
        ),
        run_config=run_config(path, checkpoint_every=1),
    )


def _optuna(config: Config, begun: Earlier) -> OptunaSearch:
    """Return Optuna's search, initialized with the last measurement of each earlier trial."""
    last = {row["trial"]: row for row in begun.rows}.values()
    if not last:
        return OptunaSearch(seed=config.seed)
    return OptunaSearch(
        seed=config.seed + begun.trials,  # with the same seed it would propose the same trials again
        points_to_evaluate=[sampled(row["settings"], config.own.space) for row in last],
        evaluated_rewards=[row[METRIC] for row in last],
    )


def measurement(result: Mapping[str, Any]) -> Row:
    """Return the part of a Tune result to store."""
    kept = {name: result[name] for name in ("env_steps", "distance_m", "success_rate", "metrics")}
    return {"trial": result["trial_id"], "settings": read_settings(result["config"]), **kept}


def of_trial(rows: Sequence[Row], trial: str) -> list[Row]:
    """Return the measurements of one trial, sorted by steps."""
    return sorted((row for row in rows if row["trial"] == trial), key=lambda row: row["env_steps"])


def ranked(rows: Sequence[Row]) -> list[Row]:
    """Return the last measurement of each trial, sorted by trained steps, then by distance, highest first."""
    last = [of_trial(rows, trial)[-1] for trial in dict.fromkeys(row["trial"] for row in rows)]
    return sorted(last, key=lambda row: (row["env_steps"], row["distance_m"]), reverse=True)


def child_run(rows: Sequence[Row]) -> ChildRun:
    """Return a trial as a finished run in MLflow, with its curves over environment steps."""
    settings, curves = rows[-1]["settings"], {}
    for name in ("distance_m", "success_rate"):
        curves[f"tune/{name}"] = {row["env_steps"]: row[name] for row in rows}
    for name in rows[-1]["metrics"]:
        curves[name] = {row["env_steps"]: row["metrics"][name] for row in rows if name in row["metrics"]}
    # MLflow sorts parameters as text, so numbers are logged as metrics too.
    numbers = {
        f"tune/{key}": float(value)
        for key, value in settings.items()
        if isinstance(value, int | float) and not isinstance(value, bool)
    }
    trial, steps = rows[-1]["trial"], {"env_steps": str(rows[-1]["env_steps"])}
    return ChildRun(f"trial {trial}", settings, steps, numbers, curves)


def words(settings: Mapping[str, Any]) -> str:
    """Return settings as arguments of a command line."""
    texts = {
        key: f"{value:.4g}" if isinstance(value, float) else str(value) for key, value in settings.items()
    }
    return " ".join(shlex.quote(f"{key}={text.replace(' ', '')}") for key, text in texts.items())


def report(folder: Run, name: str, rows: Sequence[Row], tracker: Tracker) -> Row:
    """Print, plot and record the trials; return the best."""
    order = ranked(rows)
    lines = [_cells(row) for row in order]
    episodes = folder.config.own.episodes
    caption = (
        f"Means over the same {episodes} validation corridors; the best of many measured so looks too good"
    )
    publish_table(folder, tracker, f"{name}/table", "Trials, the best first", HEADINGS, lines, 2, caption)
    publish_plot(folder, tracker, f"{name}/curves", plot_curves(rows, order))
    best = order[0]
    tracker.log_once(best["env_steps"], {f"tune/{key}": best[key] for key in ("distance_m", "success_rate")})
    console.print(f"Best: {words(best['settings'])}")
    return best


def _cells(row: Row) -> tuple[str, ...]:
    """Return a text for each of `HEADINGS`."""
    figures = f"{row['env_steps']:,}", f"{row['distance_m']:.1f}", f"{100 * row['success_rate']:.0f}"
    return (row["trial"], words(row["settings"]), *figures)


def plot_curves(rows: Sequence[Row], order: Sequence[Row]) -> Figure:
    """Plot each trial's distance over its steps; the best in colour, the others in grey."""
    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    panel = figure.subplots()
    for place, last in reversed(list(enumerate(order))):
        curve = of_trial(rows, last["trial"])
        steps, metres = ([row[name] for row in curve] for name in ("env_steps", "distance_m"))
        best = place == 0
        panel.plot(steps, metres, "o-", ms=3, lw=2 if best else 1, color=BLUE if best else GREYS[0])
    panel.set_title(f"Best: {words(order[0]['settings'])}", loc="left", fontsize=8, color=INK)
    panel.set(xlabel="Environment steps", ylabel="Distance in validation corridors [m]", ylim=(0, None))
    tidy(panel)
    return figure
