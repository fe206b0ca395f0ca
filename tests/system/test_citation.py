"""What docs/citation.md and CITATION.cff say is what packages, pyproject.toml and the changelog say."""

import contextlib
import importlib.metadata
import re
import tomllib
from pathlib import Path

import yaml
from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
CITATION = yaml.safe_load((ROOT / "CITATION.cff").read_text())
PAGE = (ROOT / "docs" / "citation.md").read_text()
ROWS = re.findall(r"^\| (.+) \| (.+) \|$", PAGE[PAGE.index("| package | licence |") :], re.MULTILINE)[1:]
LICENCES = {package: licence for packages, licence in ROWS for package in packages.split(", ")}
FAMILIES = {
    "BSD": r"\bBSD\b", "MIT": r"\bMIT\b|Permission is hereby granted", "Apache": r"\bApache\b",
    "Boost": r"\bBSL-1\.0\b", "Python Software Foundation": r"Python Software Foundation", "MPL": r"\bMPL\b",
    "LGPL": r"\bLGPL\b",
}  # fmt: skip


def said_by(package: str) -> str:
    """What an installed package says of its licence: in its metadata, or else in its licence file."""
    about = importlib.metadata.metadata(package)
    names = "License-Expression", "License", "Classifier"
    said = [text for name in names for text in about.get_all(name, [])]
    said = [text for text in said if text and ("::" not in text or text.startswith("License"))]
    files = [file for file in importlib.metadata.files(package) or [] if file.name.startswith("LICENSE")]
    return "\n".join(said or [files[0].read_text()])


def test_every_package_that_the_project_names_has_one_row():
    extras = PROJECT["optional-dependencies"].values()
    named = {Requirement(text).name for texts in (PROJECT["dependencies"], *extras) for text in texts}
    assert sorted(package for packages, _ in ROWS for package in packages.split(", ")) == sorted(named)


def test_the_licence_of_a_row_is_what_the_package_says():
    for package, licence in LICENCES.items():
        claimed = {family for family in FAMILIES if re.search(rf"\b{family}\b", licence)}
        assert claimed, package
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            said = said_by(package)
            assert {family for family in claimed if not re.search(FAMILIES[family], said)} == set(), package


def test_the_citation_names_this_version_its_day_its_licence_and_the_paper():
    assert CITATION["version"] == PROJECT["version"]
    assert CITATION["license"] == PROJECT["license"]
    released = re.search(r"^## (\S+) \((.+)\)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert released.groups() == (CITATION["version"], CITATION["date-released"])
    (paper,) = CITATION["references"]
    (title,) = re.findall(r"^  title\s+= \{(.+)\}", PAGE, re.MULTILINE)
    assert paper["title"] == title
    names = re.search(r"author\s+= \{(.+)\}", PAGE)[1].split(" and ")
    assert names == [f"{author['family-names']}, {author['given-names']}" for author in paper["authors"]]
    assert paper["identifiers"][0]["value"] in PAGE.replace(" ", "")
