"""Copy finished studies, trades and replay pages into docs/ of this folder.

Run: python -m platform.launch +exp=report
Expect: seconds. For the newest run of each study that has marks on a page in docs, or for the run folder
`resume`: data in docs/data, figures in docs/images, and new text between the study's marks on all pages. A
study without a page gets docs/NAME.md. Also the newest trade as docs/trade.md with its plot, and the newest
replay page as docs/replay.html.
"""

import dataclasses
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from PIL import Image
from pydantic.dataclasses import dataclass

from core.files import replaced
from envs.config import STRICT
from jobs.analysis.tables import save_plot
from jobs.config.config import Config, ConfigError
from jobs.run.files import RunError, read_json, write_atomic
from jobs.run.progress import console
from jobs.study.computed import Study, compute, published
from jobs.study.doses import measure_doses, read_doses, write_doses
from jobs.study.page import figures, fill, marked, new_page, part
from jobs.study.results import (
    FOLDERS,
    Results,
    check_whole,
    joined,
    publish,
    read_published,
    read_results,
)
from jobs.study.spec import read_study
from jobs.study.tables import write_changes, write_estimates, write_tests
from jobs.tools.replay_page import PAGE

DOCS = Path("docs")


@dataclass(frozen=True, config=STRICT)
class Settings:
    """Whether to add the run's trainings to the published trainings of the study instead of replacing them.

    This lets a study be trained over several days or on several machines, seed by seed. All runs must be
    evaluated with the same settings.
    """

    keep: bool


def run(config: Config) -> dict[str, Any]:
    """Write the newest studies, trade and replay page, or those in the run folder `resume`, into docs/.

    Raises:
        ConfigError: There is nothing to write, or a study is incomplete.
    """
    written = [*_copied(config)]
    pages = marked(path.read_text() for path in sorted(DOCS.glob("*.md")))
    named = {name.partition(":")[2] or name for name in pages}
    for name, folder in newest_studies(config).items():
        if config.resume is not None or name in named or not named:  # no marks in docs: a page for each
            written.append(write_study(name, folder, config, DOCS))
    if not written:
        where = config.resume or config.runs_dir
        commands = " or ".join(f"python -m platform.launch +exp={exp}" for exp in ("robustness", "trade"))
        raise ConfigError(f"resume: no finished study or trade in {where!r}: run {commands}")
    for page in written:
        console.print(f"Written: {page}", markup=False)
    return {}


def _runs(config: Config) -> list[Path]:
    return list(Path(config.runs_dir).glob("*")) if config.resume is None else [Path(config.resume)]


def _newest(found: Collection[Path]) -> Path | None:
    return max(found, key=lambda path: path.stat().st_mtime_ns, default=None)


def newest_studies(config: Config) -> dict[str, Path]:
    """Return study -> folder of its newest finished run; only runs in `resume` if it is given."""
    found: dict[str, list[Path]] = {}
    for run_ in _runs(config):
        for file in (run_ / folder / "about.json" for folder in FOLDERS):
            if file.is_file():
                found.setdefault(str(read_json(file).get("exp", "robustness")), []).append(file)
    newest = {name: _newest(files) for name, files in found.items()}
    return {name: file.parent for name, file in newest.items() if file is not None}


def write_study(name: str, folder: Path, config: Config, docs: Path) -> Path:
    """Publish a study: its data, its figures and its parts on all pages.

    Args:
        name: Name of the study, whose file is conf/exp/NAME.yaml.
        folder: The study's folder in its run folder.
        config: The experiment; event errors are measured in its simulation.
        docs: Folder of the pages, with data and figures below.

    Returns:
        The first page that shows the study.

    Raises:
        ConfigError: The study is incomplete, or was written by an earlier version.
        RunError: One of its files is damaged.
    """
    said, data, doses = read_study(name), docs / "data", []
    results = results_of(name, folder, data if config.own.keep else None)
    if said.get("doses"):
        env = dataclasses.replace(config.env, scene=results.facts["scene"], split="eval")
        doses = measure_doses(said, results, env)
    study = compute(name, said, results, doses, data)
    drawn = figures(study)  # an error here must leave data, figures and pages unchanged
    publish(data, name, results)
    if doses:
        write_doses(data / f"{name}_doses.csv", doses)
        study = study._replace(doses=read_doses(data / f"{name}_doses.csv"))
    write_values(data, study)
    write_figures(docs / "images", drawn)
    pages = {page: page.read_text() for page in sorted(docs.glob("*.md"))}
    shown = [page for page, text in pages.items() if name in marked([text])]
    if not shown:
        shown = [docs / f"{name}.md"]
        pages[shown[0]] = new_page(name)
    for page in shown:
        write_atomic(
            page, fill(pages[page], lambda at, what: part(study if at == name else study_of(data, at), what))
        )
    return shown[0]


def results_of(name: str, folder: Path, data: Path | None) -> Results:
    """Read the results of a study from its run folder, joined with the published ones if `data` is given.

    Raises:
        ConfigError: The study is incomplete or from an earlier version, or the two cannot be joined.
        RunError: One of its files is damaged.
    """
    results = read_results(folder)
    if data is not None:
        if not (data / f"{name}_episodes.csv.gz").is_file():
            rule = "must be false for a study that is not published"
            raise ConfigError(f"report.keep: {rule}, got true for {name}; {data} has no episodes of it")
        results = joined(read_published(data, name), results)
    check_whole(results)
    return results


def filled_pages(docs: Path) -> dict[str, str]:
    """Return name -> text of each page that shows a published study, filled from the data alone."""
    texts = {page: page.read_text() for page in sorted(docs.glob("*.md"))}
    return {
        page.name: fill(text, lambda mark, what: part(study_of(docs / "data", mark), what))
        for page, text in texts.items()
        if marked([text])
    }


def study_of(data: Path, mark: str) -> Study:
    """Compute the published study of a mark, NAME or NAME:DATA."""
    spec, _, own = mark.partition(":")
    return published(data, own or spec, spec)


def write_values(folder: Path, study: Study) -> None:
    """Write every estimate, every change and every test of a study as CSV."""
    write_estimates(folder / f"{study.name}_estimates.csv", study.summaries)
    write_changes(folder / f"{study.name}_changes.csv", study.changes)
    write_tests(folder / f"{study.name}_tests.csv", study.families, study.results)


def write_figures(images: Path, drawn: Mapping[str, Figure]) -> None:
    """Save figures under their names as optimized PNG files."""
    for name, figure in drawn.items():
        picture = images / f"{name}.png"
        save_plot(picture, figure)
        copy_plot(picture, picture)


def copy_plot(picture: Path, target: Path) -> None:
    """Copy a plot as an optimized PNG file, without changing a colour.

    Raises:
        RunError: The plot is damaged.
    """
    try:
        with Image.open(picture) as whole:
            colours = whole.convert("RGB")
    except (OSError, SyntaxError, ValueError) as error:
        raise RunError(f"{picture}: damaged ({error}); run the command that drew it again") from None
    with replaced(target) as part_:
        colours.save(part_, "png", optimize=True)


def _copied(config: Config) -> Iterable[Path]:
    """Copy the newest trade and the newest replay page; yield the written files."""
    for name, write in (("trade", write_trade), ("replay", write_replay)):
        newest = _newest([file for one in _runs(config) if (file := one / name / "about.json").is_file()])
        if newest is not None:
            yield write(newest.parent, DOCS)


def write_trade(trade: Path, docs: Path) -> Path:
    """Copy the page of a trade, its plot and its settings; return the page.

    Args:
        trade: The trade's folder in its run folder.
        docs: Target folder of trade.md; the plot goes into `images`, the settings into `data`.
    """
    copy_plot(trade / "images" / "trade.png", docs / "images" / "trade.png")
    if (trade / "settings.csv").is_file():  # missing in trades of earlier versions
        write_atomic(docs / "data" / "trade_settings.csv", (trade / "settings.csv").read_text())
    write_atomic(docs / "trade.md", (trade / "trade.md").read_text())
    return docs / "trade.md"


def write_replay(replay: Path, docs: Path) -> Path:
    """Copy a replay page from `replay`, its folder in its run folder, into `docs`; return the file."""
    write_atomic(docs / PAGE, (replay / PAGE).read_bytes())
    return docs / PAGE
