"""The texts of MLflow's pages for the experiment and for each run, and the views of the runs.

These are texts and plain values; `jobs.tracking.tracker` writes them. MLflow shows pictures in their full
size and folds long text, so a run's page shows small copies (`page/` among its artifacts) and starts
with a one-line summary.
"""

import base64
import io
import json
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from PIL import Image

from jobs.config.registry import JOBS

WORKFLOW = "workflowType=machine_learning"  # unless an address says so, MLflow opens pages for chat models
# MLflow's own names of a page's text, a run's colour in charts, and stored views.
NOTE, COLOUR, VIEW_TAG = "mlflow.note.content", "mlflow.runColor", "mlflow.sharedViewState"
MAX_CHARACTERS = 8000  # of a run's page; MLflow cuts longer ones without a message
PAGE_WIDTH = 860  # pixels of a picture between MLflow's side panels on a screen of 1600
PREVIEWS = "page"

METRICS = {  # metric: description, format
    "eval/success_rate": ("success in held-out corridors", "{:.0%}"),
    "eval/distance_m": ("distance without collision", "{:.1f} m"),
    "train/success_rate": ("success in training", "{:.0%}"),
    "evae/explained_loss_step": ("reconstruction explained by the latent", "{:.0%}"),
    "sweep/conditions": ("", "{:.0f} conditions"),
    "sweep/groups": ("", "{:.0f} groups of policies"),
    "sweep/episodes": ("", "{:.0f} episodes"),
}
FIRST = ("eval/", "sweep/control_hz.", "sweep/contrast_threshold.", "sweep/sparsity.",
         "sweep/background_activity.", "sweep/", "train/")  # fmt: skip
# A run that failed or was interrupted is not a result; a running one is shown.
NOT_ENDED_EARLY = "attributes.status != 'FAILED' and attributes.status != 'KILLED'"
COLUMNS = {  # view: name, filter, columns; the first column orders the runs
    "results": ("Results", f"tags.kind = 'run' and {NOT_ENDED_EARLY}", (
        "metrics.`eval/success_rate`", "metrics.`eval/distance_m`", "metrics.`train/success_rate`",
        "metrics.`sim/event_error`", "params.`exp`", "params.`seed`", "params.`train.env_steps`",
    )),
    "sweeps": ("Sweeps", f"tags.kind = 'sweep' and {NOT_ENDED_EARLY}", (
        "metrics.`sweep/conditions`", "metrics.`sweep/groups`", "metrics.`sweep/episodes`", "tags.`groups`",
    )),
}  # fmt: skip
CURVES = ("train/success_rate", "train/distance_m")  # of trainings, over environment steps
READING = """
| job | what its runs hold |
|---|---|
{kinds}

A row of **Results** is a run folder, without those that failed or were interrupted: its page begins with
its metrics and holds the resolved settings (Parameters), commit and host (Tags), and tables and films
(Artifacts). Of a **sweep**, the page shows the plots with 95 % intervals; below it lie a run for each
condition and group, named `axis=value group`, and a run for each group, whose metrics `sweep/AXIS_success`
are curves with the axis as their step. **Model registry**, on the left, has the trained policies: a model
for each group, a version for each training.

Success is the fraction of episodes that reach the goal at 100 m, distance the way without a
collision. `sim/event_error` is how far the simulated events are from exact ones, `fidelity.tolerance`
what was asked.
"""


def run_address(experiment_id: str, run_id: str, file: str = "") -> str:
    """Return the address of a run's page, or of one of its artifacts, relative to the dashboard."""
    path = f"/artifacts/{file}" if file else ""
    return f"#/experiments/{experiment_id}/runs/{run_id}{path}?{WORKFLOW}"


def view_address(experiment_id: str, key: str) -> str:
    """Return the address of a stored view of the experiment's runs, as a table or as charts."""
    mode = "&compareRunsMode=CHART" if key.startswith("charts") else ""
    return f"#/experiments/{experiment_id}/runs?{WORKFLOW}&viewStateShareKey={key}{mode}"


def table_view(search: str, columns: Sequence[str]) -> dict[str, object]:
    """Return the state of a table of runs.

    Args:
        search: Filter, such as "tags.kind = 'condition'".
        columns: Columns, such as "metrics.`eval/success_rate`"; the first orders the rows.
    """
    order = {"orderByKey": columns[0], "orderByAsc": False}
    return {"searchFilter": search, **order, "selectedColumns": list(columns)}


def chart_view(search: str, metrics: Sequence[str]) -> dict[str, object]:
    """Return the state of a page of line charts, one for each metric; x is the metric's step."""
    section = {"uuid": "charts", "name": "Charts", "display": True, "isReordered": True}
    cards = [
        {
            "uuid": metric, "type": "LINE", "metricKey": metric, "metricSectionId": "charts",
            "runsCountToCompare": 30, "deleted": False, "isGenerated": False, "xAxisKey": "step",
            "displayPoints": True, "range": {}, "lineSmoothness": 0, "scaleType": "linear",
            "xAxisScaleType": "linear",
        }
        for metric in metrics
    ]  # fmt: skip
    # In order of time, MLflow would show the parent runs, with these runs folded below.
    order = {"orderByKey": f"metrics.`{metrics[0]}`" if metrics else "", "orderByAsc": False}
    return {
        "searchFilter": search, **order, "compareRunCharts": cards, "compareRunSections": [section],
        "isAccordionReordered": True, "runsHiddenMode": "SHOW_ALL", "hideEmptyCharts": True,
    }  # fmt: skip


def usual_views() -> Iterator[tuple[str, str, dict[str, object]]]:
    """Return key, name and state of the views that every store has."""
    for key, (name, search, columns) in COLUMNS.items():
        yield key, name, table_view(search, columns)
    yield "charts-learning", "Learning curves", chart_view(f"tags.kind = 'run' and {NOT_ENDED_EARLY}", CURVES)


def packed_view(name: str, state: Mapping[str, object], now_ms: int) -> str:
    """Return a view as MLflow stores it in a tag of the experiment."""
    packed = "deflate;" + base64.b64encode(zlib.compress(json.dumps(state).encode())).decode()
    return json.dumps({"name": name, "createdAt": now_ms, "updatedAt": now_ms, "state": packed})


def stored_views(tags: Mapping[str, str]) -> dict[str, str]:
    """Return key -> name of the views in an experiment's tags, the newest first."""
    views = {
        tag.removeprefix(f"{VIEW_TAG}."): json.loads(value)
        for tag, value in tags.items()
        if tag.startswith(VIEW_TAG)
    }
    newest = sorted(views.items(), key=lambda item: -item[1]["createdAt"])
    return {key: view["name"] for key, view in newest}


def experiment_note(experiment_id: str, tags: Mapping[str, str]) -> str:
    """Return the text above the table of runs. Its first line, always shown, links to the views."""
    views = stored_views(tags)
    usual = [key for key, *_ in usual_views() if key in views]
    newest = [key for key in views if key not in usual][:2]  # of the newest sweep
    links = " · ".join(f"[{views[key]}]({view_address(experiment_id, key)})" for key in (*usual, *newest))
    kinds = "\n".join(f"| `{name}` | {job.summary} |" for name, job in JOBS.items())
    title = "**Evade**: policies that fly by the events of an event camera."
    return f"{title} Open {links}\n{READING.format(kinds=kinds)}"


@dataclass(frozen=True)
class Page:
    """The content of a run's page.

    Attributes:
        experiment_id: MLflow's id of the experiment.
        run_id: MLflow's id of the run.
        params: The resolved settings.
        tags: Job, commit, host and more.
        metrics: Newest values.
        files: Paths of all artifacts.
        tables: Path -> text of the Markdown artifacts.
        views: Key -> name of the stored views of this run.
    """

    experiment_id: str
    run_id: str
    params: Mapping[str, str]
    tags: Mapping[str, str]
    metrics: Mapping[str, float]
    files: Sequence[str]
    tables: Mapping[str, str]
    views: Mapping[str, str]


def run_note(page: Page) -> str:
    """Return the text at the top of a run's page: a summary, pictures and tables."""
    parts = [headline(page), links(page), *pictures(page), made(page)]
    addresses = {path: run_address(page.experiment_id, page.run_id, path) for path in page.tables}
    tables = {path: f"Table: [{path}]({address})" for path, address in addresses.items()}
    used = sum(len(part) + 2 for part in [*parts, *tables.values()])
    for path, text in page.tables.items():
        whole = f"[{path}]({addresses[path]})\n\n{text}"
        longer = len(whole) - len(tables[path])
        if used + longer < MAX_CHARACTERS:
            tables[path], used = whole, used + longer
    return "\n\n".join(part for part in [*parts, *tables.values()] if part)


def headline(page: Page) -> str:
    """Return a one-line summary of the run: job, experiment, seed and main metrics."""
    job = JOBS.get(page.tags.get("job", ""))
    what = job.summary if job else "A run"
    named = ", ".join(page.params[name] for name in ("exp", "budget") if name in page.params)
    metrics = [_metric_text(page, name) for name in METRICS if name in page.metrics]
    seed = page.params.get("seed", "-")
    return f"**{what}** ({named}, seed {seed}): {', '.join(metrics) or 'no metrics yet'}."


def _metric_text(page: Page, name: str) -> str:
    """Return a metric as text, with its interval if there is one."""
    text, form = METRICS[name]
    ends = [page.metrics.get(f"{name}_{side}") for side in ("low", "high")]
    known = [form.format(end) for end in ends if end is not None]
    value = f"{text} {form.format(page.metrics[name])}".strip()
    return value + (f" [{', '.join(known)}]" if len(known) == 2 else "")


def links(page: Page) -> str:
    """Return links to the views of this run and to its films."""
    found = [f"[{name}]({view_address(page.experiment_id, key)})" for key, name in page.views.items()]
    films = [path for path in page.files if path.endswith(".mp4")]
    found += [f"[Film: {path}]({run_address(page.experiment_id, page.run_id, path)})" for path in films]
    return " · ".join(found)


def pictures(page: Page) -> list[str]:
    """Return the small pictures, the most important first, each with a link to the large one."""
    names = [path.removeprefix(f"{PREVIEWS}/") for path in page.files if path.startswith(f"{PREVIEWS}/")]
    return [
        f"![{name}](get-artifact?path={PREVIEWS}/{name}&run_uuid={page.run_id})\n"
        f"[{name}]({run_address(page.experiment_id, page.run_id, name)})"
        for name in sorted(names, key=_place)
    ]


def _place(name: str) -> tuple[int, str]:
    ranks = [rank for rank, start in enumerate(FIRST) if name.startswith(start)]
    return (min(ranks, default=len(FIRST)), name)


def made(page: Page) -> str:
    """Return commit, machine, and the requested and achieved event error."""
    tags = {name: page.tags.get(name, "-") for name in ("commit", "host", "cpus", "python")}
    asked = page.params.get("fidelity.tolerance", "-")
    text = "Commit `{commit}`, host `{host}` ({cpus} CPUs), Python {python}. ".format(**tags)
    achieved = {"": "sim/event_error", " at worst": "sim/event_error_max"}
    found = [f"{page.metrics[name]:.3f}{when}" for when, name in achieved.items() if name in page.metrics]
    return f"{text}Event error asked: at most {asked}; achieved: {', '.join(found) or 'not measured'}."


def preview(picture: bytes) -> Image.Image:
    """Return a copy of a picture that is no wider than a run's page."""
    image = Image.open(io.BytesIO(picture)).convert("RGB")
    image.thumbnail((PAGE_WIDTH, 10 * PAGE_WIDTH))
    return image
