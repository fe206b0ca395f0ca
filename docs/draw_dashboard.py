"""Draw the picture of docs/dashboard.md from a filled store.

Run from the repository root: python -m docs.draw_dashboard [mlflow.db]
Needs Chromium and a store with a sweep. Writes docs/images/dashboard_charts.png with the newest.
"""

import io
import sys
import tempfile
import time
from pathlib import Path

from PIL import Image

from docs.browser import Browser, served
from jobs.tracking.pages import view_address
from jobs.tracking.tracker import open_store

IMAGES = Path(__file__).resolve().parent / "images"
SETTLE_S = 6.0
DRAWN = "document.querySelectorAll('.js-plotly-plot .scatterlayer .trace').length > 3"


def main() -> None:
    """Open the charts of the newest sweep, and save a screenshot."""
    store = Path(sys.argv[1] if len(sys.argv) > 1 else "mlflow.db").resolve()
    uri = f"sqlite:///{store}"
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile,
        served(uri, Path(sys.executable).parent) as address,
    ):
        browser = Browser(Path(profile), 1500, 1100)
        browser.open(f"{address}/{charts(uri)}", "_success")
        browser.wait(DRAWN, "the charts")
        time.sleep(SETTLE_S)
        picture = Image.open(io.BytesIO(browser.picture())).convert("RGB")
        picture.save(IMAGES / "dashboard_charts.png", optimize=True)
        browser.close()


def charts(uri: str) -> str:
    """Return the address of the charts of the newest sweep."""
    client, experiment = open_store(uri, "evade")
    found = client.search_runs(
        [experiment], "tags.kind = 'sweep'", order_by=["attributes.start_time DESC"], max_results=1
    )
    return view_address(experiment, f"charts-{found[0].info.run_id}")


if __name__ == "__main__":
    main()
