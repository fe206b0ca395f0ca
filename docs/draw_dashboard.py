"""Draw the pages of docs/dashboard.md from a filled store.

Run from the repository root: python -m docs.draw_dashboard [mlflow.db]
Needs Chromium and a store with a sweep, an evaluated training and a registered `bytestream`. Writes
docs/images/dashboard_*.png with the newest of each.
"""

import io
import sys
import tempfile
import time
from pathlib import Path

from PIL import Image

from docs.browser import Browser, served
from jobs.tracking.pages import run_address, view_address
from jobs.tracking.tracker import open_store

IMAGES = Path(__file__).resolve().parent / "images"
SETTLE_S = 6.0
DRAWN = "document.querySelectorAll('.js-plotly-plot .scatterlayer .trace').length > 3"
# Texts of MLflow's buttons that unfold a part of a page.
FOLDED = {"sweep": ["Show more"], "training": ["Show more"], "model": ["Inputs (4)", "Outputs (5)"]}


def main() -> None:
    """Open each page, unfold its text, and save a screenshot."""
    store = Path(sys.argv[1] if len(sys.argv) > 1 else "mlflow.db").resolve()
    uri = f"sqlite:///{store}"
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile,
        served(uri, Path(sys.executable).parent) as address,
    ):
        browser = Browser(Path(profile), 1500, 1100)
        for name, (place, shown) in pages(uri).items():
            browser.open(f"{address}/{place}", shown)
            for text in FOLDED.get(name, []):
                browser.click(text)
            if name == "charts":
                browser.wait(DRAWN, "the charts")
            time.sleep(SETTLE_S)
            picture = Image.open(io.BytesIO(browser.picture())).convert("RGB")
            picture.save(IMAGES / f"dashboard_{name}.png", optimize=True)
        browser.close()


def pages(uri: str) -> dict[str, tuple[str, str]]:
    """Name -> address of each page, and a text that appears once it is loaded."""
    client, experiment = open_store(uri, "evade")
    newest = {}
    for kind, search in {
        "sweep": "tags.kind = 'sweep'",
        "training": "metrics.`eval/success_rate` >= 0 and tags.kind = 'run'",
    }.items():
        found = client.search_runs(
            [experiment], search, order_by=["attributes.start_time DESC"], max_results=1
        )
        newest[kind] = found[0].info.run_id
    # A policy on events, whose signature docs/dashboard.md describes.
    versions = client.search_model_versions("name LIKE 'evade-bytestream%'")
    version = max(versions, key=lambda version: version.creation_timestamp)
    model = f"#/models/{version.name}/versions/{version.version}?workflowType=machine_learning"
    return {
        "runs": (view_address(experiment, "results"), "train/success_rate"),
        "sweep": (run_address(experiment, newest["sweep"]), "Description"),
        "charts": (view_address(experiment, f"charts-{newest['sweep']}"), "_success"),
        "training": (run_address(experiment, newest["training"]), "Description"),
        "model": (model, "Schema"),
    }


if __name__ == "__main__":
    main()
