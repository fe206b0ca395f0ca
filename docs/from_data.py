"""Regenerate the result pages and their figures from docs/data alone, without run folders or a store.

Run from the repository root: python -m docs.from_data [FOLDER]
Fills the marks of every page in docs (`<!-- study NAME PART -->`, see jobs.study.page), writes the estimates
and changes of each study, and draws each figure whose data exist. The output goes to FOLDER (by default docs)
and its folders `data` and `images`. docs/data.md explains the data.
"""

import csv
import sys
from collections.abc import Mapping
from pathlib import Path

from matplotlib.figure import Figure

from benchmarks.scaling_model import from_plain, plot_scaling
from jobs.analysis.plots import plot_learning_curves
from jobs.analysis.tables import write_csv
from jobs.bench.bench_table import entries, heat_map
from jobs.bench.protocol import read_protocol
from jobs.measure.encodings import read_costs
from jobs.measure.measured import Measured
from jobs.measure.plots import draw_settings, plot_costs, plot_encoding_costs
from jobs.rollout.policies import PRETRAINED
from jobs.run.files import read_json, write_atomic
from jobs.study.computed import Study
from jobs.study.page import figures, marked
from jobs.study.report import filled_pages, study_of, write_figures, write_values
from jobs.tools.curves import PublishedTraining, by_reward, published_trainings, read_curves

DOCS = Path(__file__).resolve().parent
# Studies whose pages have no marks: name of the data and of the figure -> study.
UNMARKED = {
    "ablation": "ablation",
    "ablation_more": "ablation",
    "taught": "taught",
    "memory_seconds": "memory_seconds",
}


def studies(docs: Path) -> dict[str, Study]:
    """Return name -> study, for each study that pages show and whose data exist."""
    marks = marked(page.read_text() for page in sorted(docs.glob("*.md")))
    marks += [spec if data == spec else f"{spec}:{data}" for data, spec in UNMARKED.items()]
    named = {mark.partition(":")[2] or mark: mark for mark in marks}
    data = docs / "data"
    return {name: study_of(data, mark) for name, mark in named.items()
            if (data / f"{name}_episodes.csv.gz").is_file()}  # fmt: skip


def study_figures(found: Mapping[str, Study]) -> dict[str, Figure]:
    """Return name -> figure of the studies; in `UNMARKED`, the figure has the name of the data."""
    drawn: dict[str, Figure] = {}
    for name, study in found.items():
        own = figures(study)
        drawn |= {name: next(iter(own.values()))} if name in UNMARKED else own
    return drawn


def other_figures(data: Path) -> dict[str, Figure]:
    """Return name -> figure, for each measurement whose data exist."""
    found: dict[str, Figure] = {}
    if (data / "trade_settings.csv").is_file():
        with (data / "trade_settings.csv").open() as file:
            found["trade"] = draw_settings(list(csv.DictReader(file)))
    if (data / "simulator_costs.csv").is_file():
        with (data / "simulator_costs.csv").open() as file:
            rows = list(csv.DictReader(file))
        measured = [
            Measured(
                row["knob"],
                row["setting"],
                float(row["step_us"]),
                float(row["event_error_percent"]) / 100,
                {},
            )
            for row in rows
        ]
        front = [place for place, row in enumerate(rows) if row["front"] == "1"]
        found["trade_poles"] = plot_costs("poles", measured, front, 0.05)
    if (data / "encoder_costs.csv").is_file():
        found["encoder_inference"] = plot_encoding_costs(read_costs(data / "encoder_costs.csv"))
    if (data / "scaling.json").is_file():
        found["scaling"] = plot_scaling(from_plain(read_json(data / "scaling.json")))
    if any((data / "bench").glob("*.json")):
        protocol = read_protocol()
        found["bench_C"] = heat_map(entries(data / "bench", protocol)["C"], protocol, "C")
    curves = [curve for _, curve in sorted(read_curves(PRETRAINED).items())]
    found["learning"] = plot_learning_curves(by_reward(PRETRAINED, curves))
    return found


def main(docs: Path, target: Path) -> None:
    """Write pages, figures, estimates and changes.

    Args:
        docs: Folder of the pages, with `data`.
        target: Folder for the pages, with `images` for figures and `data` for estimates and changes.
    """
    found = studies(docs)
    drawn = study_figures(found) | other_figures(docs / "data")
    texts = filled_pages(docs)
    (target / "data").mkdir(parents=True, exist_ok=True)
    write_figures(target / "images", drawn)
    for name, text in texts.items():
        write_atomic(target / name, text)
    for study in found.values():
        write_values(target / "data", study)
    write_csv(target / "data" / "trainings.csv", PublishedTraining._fields, published_trainings(PRETRAINED))
    for name in (*texts, *(f"images/{name}.png" for name in drawn)):
        sys.stdout.write(f"{target / name}\n")


if __name__ == "__main__":
    main(DOCS, Path(sys.argv[1]) if len(sys.argv) > 1 else DOCS)
