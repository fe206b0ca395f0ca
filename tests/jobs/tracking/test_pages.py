import dataclasses
import sys
from pathlib import Path

import pytest

from docs.browser import CHROMIUM, Browser, served
from jobs.config.registry import JOBS
from jobs.run.provenance import REPOSITORY
from jobs.tracking.pages import (
    MAX_CHARACTERS,
    PAGE_WIDTH,
    Page,
    chart_view,
    experiment_note,
    packed_view,
    preview,
    run_address,
    run_note,
    usual_views,
    view_address,
)
from jobs.tracking.store import dashboard_command, server_command
from jobs.tracking.tracker import open_store
from tests.support.filled_store import fill
from tests.support.stores import place_store

PAGE = Page(
    experiment_id="1",
    run_id="abc",
    params={"exp": "robustness", "budget": "short", "seed": "0", "fidelity.tolerance": "0.05"},
    tags={"job": "evaluate", "commit": "c0ffee", "host": "box", "cpus": "2", "python": "3.11"},
    metrics={"eval/success_rate": 0.9, "eval/success_rate_low": 0.8, "eval/success_rate_high": 0.95},
    files=["sweep/crashes/a.mp4", "page/sweep/world.png", "page/sweep/control_hz.png"],
    tables={"sweep/table.md": "| a |"},
    views={"charts-abc": "Sweep abc: charts"},
)


def test_a_runs_page_begins_with_what_it_is_and_shows_figures_before_tables():
    note = run_note(PAGE)
    order = (
        f"**{JOBS['evaluate'].summary}", "90% [80%, 95%]", "charts-abc", "sweep/crashes/a.mp4",
        "page/sweep/control_hz.png&run_uuid=abc", "page/sweep/world.png", "`c0ffee`", "0.05", "| a |",
    )  # fmt: skip
    assert sorted(map(note.index, order)) == list(map(note.index, order))


def test_a_table_that_would_be_cut_is_linked_instead():
    note = run_note(dataclasses.replace(PAGE, tables={"big.md": "x" * MAX_CHARACTERS, "small.md": "| b |"}))
    assert len(note) < MAX_CHARACTERS
    assert "Table: [big.md]" in note
    assert note.endswith("| b |")


def test_a_page_with_room_for_one_table_links_the_others_within_the_limit():
    lengths = range(4_000, MAX_CHARACTERS, 7)
    tables = [{"one.md": "x" * length, "two.md": "y" * 500, "three.md": "z" * 500} for length in lengths]
    notes = [run_note(dataclasses.replace(PAGE, tables=own)) for own in tables]
    assert max(map(len, notes)) < MAX_CHARACTERS
    assert {note.count("xxx") > 0 for note in notes} == {False, True}
    assert all("three.md" in note for note in notes)


def test_the_experiments_first_line_leads_to_the_newest_sweep():
    views = {"results": "Results", "charts-1": "Sweep 1: charts", "charts-2": "Sweep 2: charts"}
    views |= {"table-2": "T"}
    tags = {
        f"mlflow.sharedViewState.{key}": packed_view(name, chart_view("", []), now_ms)
        for now_ms, (key, name) in enumerate(views.items())
    }
    first = experiment_note("1", tags).splitlines()[0]
    assert view_address("1", "results") in first
    assert view_address("1", "charts-2") in first
    assert "charts-1" not in first


def test_runs_that_ended_early_do_not_stand_among_results(tmp_path):
    place_store(tmp_path / "mlflow.db")
    client, experiment = open_store(f"sqlite:///{tmp_path / 'mlflow.db'}", "evade")
    for status in ("RUNNING", "FINISHED", "FAILED", "KILLED"):
        for kind in ("run", "sweep"):
            run = client.create_run(experiment, tags={"kind": kind}, run_name=f"{kind} {status}")
            client.update_run(run.info.run_id, status=status)
    for key, name, state in usual_views():
        found = {run.info.run_name for run in client.search_runs([experiment], state["searchFilter"])}
        kind = "sweep" if key == "sweeps" else "run"
        assert found == {f"{kind} RUNNING", f"{kind} FINISHED"}, name


@pytest.mark.parametrize(("given", "kept"), [((2000, 500), (PAGE_WIDTH, 215)), ((400, 300), (400, 300))])
def test_pictures_of_a_page_are_narrowed_and_never_enlarged(tmp_path, given, kept):
    from PIL import Image

    Image.new("RGBA", given).save(tmp_path / "large.png")
    assert preview((tmp_path / "large.png").read_bytes()).size == kept


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """A store with an evaluated training and a sweep; the addresses of their pages by name."""
    place = tmp_path_factory.mktemp("dashboard")
    config, _ = fill(place)
    uri = f"sqlite:///{place / 'mlflow.db'}"
    client, experiment = open_store(uri, config.tracking.experiment)
    (training,) = client.search_runs([experiment], "tags.kind = 'run'")
    (sweep,) = client.search_runs([experiment], "tags.kind = 'sweep'")
    films = [file.path for file in client.list_artifacts(sweep.info.run_id, "sweep/crashes")]
    return uri, {
        "runs": view_address(experiment, "results"),
        "training": run_address(experiment, training.info.run_id),
        "flight": run_address(experiment, training.info.run_id, "eval/episode.mp4"),
        "sweep": run_address(experiment, sweep.info.run_id),
        "charts": view_address(experiment, f"charts-{sweep.info.run_id}"),
        "crash": run_address(experiment, sweep.info.run_id, films[0]),
        "model": "#/models/evade-bytestream/versions/1?workflowType=machine_learning",
    }


@pytest.fixture(scope="module")
def pages(store, tmp_path_factory):
    """Opens a page by its name, in one browser."""
    if CHROMIUM is None:
        pytest.skip("needs Chromium: apt-get install --no-install-recommends chromium")
    uri, addresses = store
    with served(uri, Path(sys.executable).parent) as address:
        browser = Browser(tmp_path_factory.mktemp("profile"))
        try:
            yield browser, {name: f"{address}/{place}" for name, place in addresses.items()}
        finally:
            browser.close()


pictures_shown = (
    "[...document.images].filter(i => i.src.includes('get-artifact') && i.naturalWidth > 0).length"
)


in_browser = pytest.mark.slow  # it opens pages: a minute or more


@in_browser
@pytest.mark.parametrize(
    ("name", "pictures", "words"),
    [
        ("runs", 0, ("Evade: policies that fly by the events", "Results", "Learning curves", "Sweeps",
                     "bytestream-smoke-s0-", "eval/success_rate", "eval/distance_m", "sim/event_error")),
        ("training", 1, ("From nothing to an evaluated policy", "success in held-out corridors", "Commit",
                         "Event error asked: at most 0.05; achieved:", "policy stochastic",
                         "camera.contrast_threshold", "host", "evade-bytestream")),
        ("sweep", 3, ("Policies at other rates and thresholds", "charts", "sweep/control_hz.png",
                      "sweep/sparsity.png", "Success [%] with 95 % intervals", "control_hz=100",
                      "Child runs")),
        ("charts", 0, ("sweep/control_hz_success", "sweep/sparsity_percent_success", "2 matching runs")),
    ],
)  # fmt: skip
def test_a_page_shows_what_it_is_its_figures_settings_and_origin(pages, name, pictures, words):
    browser, at = pages
    text = browser.open(at[name], *words)
    if name == "sweep":
        assert text.index("sweep/control_hz.png") < text.index("Success [%] with 95 % intervals")
    if name == "charts":
        browser.shows("straight")
    assert browser.wait(f"{pictures_shown} >= {pictures}", "the figures")


@in_browser
def test_the_registered_model_shows_its_signature(pages):
    browser, at = pages
    browser.open(at["model"], "evade-bytestream", "Version 1", "events t [us], x, y, p", "eval/success_rate")
    browser.click("Inputs (4)")
    browser.click("Outputs (5)")
    browser.shows("t (required)", "p (required)", "long", "action", "forward", "left", "right", "float")


@in_browser
@pytest.mark.parametrize("name", ["flight", "crash"])
def test_films_play_on_the_artifacts_page(pages, name):
    browser, at = pages
    browser.open(at[name], ".mp4")
    assert browser.wait("document.querySelector('video')?.videoWidth > 0", "the film")


def test_the_store_of_the_repository_is_served_by_make_and_any_by_the_server_itself():
    own = f"sqlite:///{REPOSITORY / 'mlflow.db'}"
    assert dashboard_command(own) == "make mlflow"
    for uri in (own, "sqlite:////elsewhere/m.db"):
        words = server_command(uri).split()
        assert words[words.index("mlflow") : words.index("mlflow") + 2] == ["mlflow", "server"]
        assert words[-1] == uri
    assert dashboard_command("sqlite:////elsewhere/m.db") == server_command("sqlite:////elsewhere/m.db")
