"""Each column of the published data is explained, each file is named, and each figure without data."""

import csv
import gzip
import re

import pytest

from docs.from_data import other_figures, studies, study_figures
from jobs.rollout.policies import PRETRAINED
from jobs.run.provenance import REPOSITORY

DOCS = REPOSITORY / "docs"
PAGE = (DOCS / "data.md").read_text()
OF_STUDIES = ("episodes.csv.gz", "about.json", *(f"{name}.csv" for name in (
    "trainings", "estimates", "changes", "tests", "doses"
)))  # fmt: skip
OTHERS = r"learning|scene_\w+|concept_\w+"  # that the page tells of in a sentence


def columns(file):
    with gzip.open(file, "rt") if file.suffix == ".gz" else file.open() as stream:
        return next(csv.reader(stream))


def test_every_column_of_every_table_has_its_row_and_every_row_its_column():
    files = [*(DOCS / "data").rglob("*.csv"), *(DOCS / "data").rglob("*.csv.gz"), PRETRAINED / "curves.csv"]
    assert len(files) > 15
    with (DOCS / "data" / "columns.csv").open() as file:
        rows = list(csv.DictReader(file))
    known = [row["column"] for row in rows]
    assert all(row["meaning"] for row in rows)
    assert sorted(known) == sorted({name for file in files for name in columns(file)})


def test_every_file_is_told_of():
    table = PAGE.split("| file | a row is |")[1].split("\n\n")[0]
    names = {f"{path.name}/" if path.is_dir() else path.name for path in (DOCS / "data").iterdir()}
    told = set(re.findall(r"`(?:models/pretrained/)?([\w.]+/?)`", table))
    studies = {name.partition("_episodes.")[0] for name in names if "_episodes." in name}
    told |= {f"{study}_{part}" for study in studies for part in OF_STUDIES}
    assert names - told == set()


@pytest.mark.slow
def test_a_figure_is_drawn_from_the_data_or_named_as_one_that_cannot_be():
    pages = [page.read_text() for page in DOCS.glob("*.md")]
    linked = {name for page in pages for name in re.findall(r"images/(\w+)\.png", page)}
    table = PAGE.split("\n## Figures without data\n")[1].split("\n## ")[0]
    first_cells = [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]
    named = {name for cell in first_cells for name in re.findall(r"`(\w+)`", cell)}
    drawn = {*study_figures(studies(DOCS)), *other_figures(DOCS / "data")}
    assert named & drawn == set()
    assert {name for name in linked - named - drawn if not re.fullmatch(OTHERS, name)} == set()
    assert named <= linked
