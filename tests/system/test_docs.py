"""Commands, names, links and code on the pages are those of the code."""

import importlib
import re
import shlex
import sys
from pathlib import Path

import imageio_ffmpeg
import nbformat
import numpy as np
import pydantic
import pytest
from PIL import Image

from docs.keys import HEAD, kinds, row, tables
from docs.run_notebooks import execute
from envs.events import EVENT
from envs.recordings import write_events
from jobs.config.algorithms import AlgoConfig, RLlibConfig
from jobs.config.command_line import hydra_words
from jobs.config.config import keys_of_jobs, known_keys, parse
from jobs.config.env_keys import fields_of
from jobs.rollout.policies import PRETRAINED
from tests.support.configs import compose
from tests.support.filled_store import fill
from tests.support.started import ROOT, said

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
# `+exp=NAME` or `evade NAME`, and words behind it, up to what ends a command on a page.
WORD = r"(?:'[^']*'|\"[^\"]*\"|[^\s`#|;)'\"])+"
WORDS = rf"(?:[ \t]+(?=[\w.~+'\"]+[=.]){WORD})*"
LAUNCHED = re.compile(rf"(?<!\w)(\+exp=[a-z_]+{WORDS})|(?:^|`|\n)evade ([a-z][a-z_]+{WORDS})")
MADE = {"bytestream": "+exp=bytestream", "sweep-robustness": "+exp=robustness", "demo": "+exp=demo"}
ARGS = re.compile(r"make (bytestream|sweep-robustness|demo)(?: train=true)? ARGS=\"([^\"]*)\"")
NAMES = re.compile(r"`((?:envs|models|jobs)(?:\.\w+)+)`")
LINKS = re.compile(r"\]\((?!https?:)([^)\s#]*)(?:#([^)\s]+))?\)")
FILES = re.compile(r"`((?:tests|envs|models|jobs|conf|docker|platform)/[\w/.]+\.(?:py|yaml|json|csv))`")
BLOCKS = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
# What a page takes for granted: its blocks run one after the other, in a folder as `folder` makes it.
GRANTED = {
    "dashboard.md": "import numpy, pandas\n"
    "events = pandas.DataFrame(numpy.array([[100, 1, 2, 1], [9000, 3, 4, -1]]), columns=list('txyp'))",
    "recordings.md": "from envs.recordings import read_events\n"
    "events, width, height = read_events('street.raw').events, 1280, 720",
}
LIMITS = (("at least", True, -1), ("above", False, -1), ("at most", True, 1), ("below", False, 1))
NUMBER = r"([-\d.,e]*\d)"


def commands() -> list[str]:
    """The words of each command of the launcher that a page shows, once."""
    found: dict[str, None] = {}
    for page in PAGES:
        text = page.read_text().replace("\\\n", " ")
        found |= dict.fromkeys((match[1] or match[2]).strip() for match in LAUNCHED.finditer(text))
        found |= dict.fromkeys(f"{MADE[target]} {words}" for target, words in ARGS.findall(text))
    # tests/system/test_plugins.py gives those with a plug-in; a reader calibrates the camera `mine`, and has
    # the world.
    own = [
        words
        for words in found
        if "plugins=" not in words and not words.startswith("scene") and "world.csv" not in words
    ]
    return [words.replace("camera=mine ", "camera=dvs128 ") for words in own]


def exists(name: str) -> bool:
    """Whether a dotted name is a module, or an attribute that a module leads to."""
    parts = name.split(".")
    for length in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:length]))
        except ModuleNotFoundError:
            continue
        for attribute in parts[length:]:
            fields = getattr(found, "__dataclass_fields__", {})
            if not hasattr(found, attribute) and attribute not in fields:
                return False
            found = getattr(found, attribute, None)
        return True
    return False


def anchors(page: Path) -> set[str]:
    """The names of a page's headings, as GitHub and MyST make them."""
    headings = re.findall(r"^#{1,4} (.+)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("command", commands())
def test_a_command_on_a_page_makes_a_checked_configuration(command):
    words = [word for word in shlex.split(command) if not word.startswith(("runs_dir=", "resume="))]
    assert parse(compose(*hydra_words(words))).exp


def test_every_link_leads_to_a_file_and_a_heading_that_are_there():
    generated = set(kinds())  # sections of docs/keys.md, which the schema gives
    broken, count = [], 0
    for page in [*PAGES, ROOT / "SECURITY.md", ROOT / "CHANGELOG.md"]:
        for target, anchor in LINKS.findall(page.read_text()):
            file, count = (page.parent / target if target else page), count + 1
            known = (
                not anchor or anchor in (anchors(file) if file.suffix == ".md" else ()) or anchor in generated
            )
            if not (file.exists() and known):
                broken.append((page.name, target, anchor))
    assert broken == []
    assert count > 150


def test_names_and_files_on_the_pages_are_there():
    names = {name for page in PAGES for name in NAMES.findall(page.read_text())}
    files = {path for page in PAGES for path in FILES.findall(page.read_text()) if "NAME" not in path}
    files -= {"conf/camera/mine.yaml"}  # a reader's calibration writes it
    assert min(len(names), len(files)) > 20
    assert sorted(name for name in names if not exists(name)) == []
    assert sorted(path for path in files if not (ROOT / path).exists()) == []


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 100


def test_every_key_has_a_row_that_says_what_it_is():
    said = {key: row(key, *about) for keys in kinds().values() for key, about in keys.items()}
    groups = {name for key in said for name in [key.partition(".")[0]] if "." in key}
    models = {key for key in known_keys() if key.startswith("model.")}
    of_jobs = {*keys_of_jobs()}
    of_rllib = {
        f"algo.{key}" for key in {*fields_of(RLlibConfig)} - {*fields_of(AlgoConfig)}
    }  # conf/algo/dqn.yaml
    assert set(known_keys()) - groups - models - of_rllib == set(said) - of_jobs - {
        key for key in said if key.startswith("model.")
    }
    assert of_jobs <= set(said)
    assert [key for key, cells in said.items() if not (cells.meaning and cells.allowed)] == []
    assert {len(line.split(" | ")) for line in tables().splitlines() if line.startswith("| `")} == {len(HEAD)}


def test_the_bounds_of_a_key_are_those_that_the_schema_enforces():
    def taken(kind: object, value: float) -> bool:
        try:
            pydantic.TypeAdapter(kind).validate_python(value)
        except pydantic.ValidationError:
            return False
        return True

    count = 0
    for keys in kinds().values():
        for key, (kind, _) in keys.items():
            cells, whole = row(key, kind), "whole number" in row(key, kind).allowed
            if cells.allowed.startswith("list"):
                continue
            for word, inside, way in LIMITS:
                for text in re.findall(f"{word} {NUMBER}", cells.allowed):
                    bound = int(text.replace(",", "")) if whole else float(text.replace(",", ""))
                    beyond = bound + way if whole else bound + way * max(abs(bound), 1e-9) * 1e-3
                    assert (taken(kind, bound), taken(kind, beyond)) == (inside, False), (key, text)
                    count += 1
    assert count > 60


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the files that the pages name: a run, recordings, a video, images, results."""
    place = tmp_path_factory.mktemp("pages")
    fill(place)
    (place / "runs" / "NAME").mkdir()
    (place / "runs" / "NAME" / "policy").symlink_to(PRETRAINED / "bytestream_hold-s0")
    rng, count = np.random.default_rng(0), 60_000
    events = np.zeros(count, EVENT)
    events["t"], events["p"] = np.sort(rng.integers(0, 50_000, count)), 1
    events["x"], events["y"] = rng.integers(0, 240, count), rng.integers(0, 180, count)
    rows = [f"{one['t'] * 1e-6:.6f} {one['x']} {one['y']} {one['p']}" for one in events[:1000]]
    (place / "events.txt").write_text("\n".join(rows) + "\n")
    events["x"] += 520  # in the middle of a larger sensor
    events["y"] += 270
    write_events(place / "street.raw", events, 1280, 720)
    film = imageio_ffmpeg.write_frames(str(place / "ride.mp4"), (64, 64), fps=25)
    film.send(None)
    for _ in range(8):
        film.send(rng.integers(0, 255, (64, 64, 3), np.uint8).tobytes())
    film.close()
    for name in ("slider_depth", "renders"):
        (place / name).mkdir()
        for n in range(3):
            Image.fromarray(rng.integers(0, 255, (64, 64), np.uint8)).save(place / name / f"{n}.png")
    (place / "slider_depth" / "images.txt").write_text("".join(f"{n * 0.04} {n}.png\n" for n in range(3)))
    return place


@pytest.mark.system
def test_the_python_on_each_page_runs(folder):
    blocks = {page.name: BLOCKS.findall(page.read_text()) for page in PAGES}
    pages = {name: "\n".join([GRANTED.get(name, ""), *own]) for name, own in blocks.items() if own}
    assert len(pages) > 5
    # In one process, which imports everything once; a traceback names the page.
    run = (
        f"for name, code in {pages!r}.items(): exec(compile(code, name, 'exec'), {{'__name__': '__main__'}})"
    )
    said(sys.executable, "-c", run, cwd=folder)


@pytest.mark.system
@pytest.mark.parametrize(
    "path",
    [path if path.stem == "events" else pytest.param(path, marks=pytest.mark.slow) for path in NOTEBOOKS],
    ids=lambda path: path.stem,
)
def test_a_notebook_runs_and_draws_what_it_shows(path):
    def drawn(book: nbformat.NotebookNode) -> list[int]:
        outputs = [cell.outputs for cell in book.cells if cell.cell_type == "code"]
        return [sum("image/png" in one.get("data", {}) for one in own) for own in outputs]

    assert drawn(execute(path)) == drawn(nbformat.read(path, nbformat.NO_CONVERT))


@pytest.mark.system
def test_the_site_builds_without_a_warning(tmp_path):
    site = tmp_path / "html"
    words = ("-q", "-W", "--keep-going", "-b", "html", "docs")
    assert said(sys.executable, "-m", "sphinx", *words, site) == ""
    assert (site / "replay.html").read_bytes() == (ROOT / "docs" / "replay.html").read_bytes()
