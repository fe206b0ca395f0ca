"""Pages of planned studies of trainings: the plan stands, what is below it is written anew."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from matplotlib.figure import Figure

from jobs.analysis.tables import save_plot
from jobs.evaluation.sweep_report import SweepFacts
from jobs.reporting import camera_rates, encoder_seeds, sets_study
from jobs.reporting.breaks import SweptEpisodes
from jobs.reporting.planned_page import made_text, write_below_plan
from jobs.reporting.sweep_data import read_data, read_sweep, write_data


class TrainingStudy(NamedTuple):
    """What is published of a study.

    Attributes:
        text: What its results say, as Markdown.
        draw: Its figure.
        shows: What the figure is of.
        caption: What is seen in it.
    """

    text: Callable[[SweepFacts, SweptEpisodes], str]
    draw: Callable[[SweepFacts, SweptEpisodes], Figure]
    shows: str
    caption: str


# Name of the experiment, of its page, and of its data.
STUDIES = {
    encoder_seeds.ENCODERS: TrainingStudy(
        encoder_seeds.results_text,
        encoder_seeds.draw,
        "Mean success of every training by encoder and seed of PPO, and what success differs by",
        "Left: a cell is one training, its mean success under all conditions. Right: the standard deviations "
        "of the table below.",
    ),
    camera_rates.CAMERAS: TrainingStudy(
        camera_rates.results_text,
        camera_rates.draw,
        "Success against control rate for trainings by either camera at three rates",
        "A marker is one training, set a little aside of its rate, a line the mean of the three; dotted: the "
        "rate at which they were trained. Blue: `pixels`, red: `frames`, green: trained by `frames`, "
        "evaluated by `pixels`.",
    ),
    sets_study.SETS: TrainingStudy(
        sets_study.results_text,
        sets_study.draw,
        "Success of every training under each condition, by a frozen encoder and by a network over sets",
        "A small marker is one training, a stroke the mean of its group.",
    ),
}


def write_training_study(study: Path, docs: Path, name: str) -> Path:
    """Write the results below the plan, the figure and the data.

    Args:
        study: The folder that the study has left in its run folder.
        docs: Where the page is, or goes; figure and data into `images` and `data`.
        name: One of `STUDIES`.

    Returns:
        The page.

    Raises:
        ConfigError: If an earlier version wrote the study.
        RunError: If a file of the study is damaged.
        ValueError: If the study lacks a training or a rate that is compared.
    """
    about, episodes = read_sweep(study)
    text, figure = _text(name, about, episodes), STUDIES[name].draw(about, episodes)
    write_data(docs / "data", name, study, episodes)
    save_plot(docs / "images" / f"{name}.png", figure)
    return write_below_plan(docs / f"{name}.md", text)


def published_text(data: Path, name: str) -> str:
    """What stands below the plan of a published study."""
    return _text(name, *read_data(data, name))


def draw_study(data: Path, name: str) -> Figure:
    """The figure of a published study."""
    return STUDIES[name].draw(*read_data(data, name))


def _text(name: str, about: SweepFacts, episodes: SweptEpisodes) -> str:
    study = STUDIES[name]
    data = f"[`data/{name}_episodes.csv.gz`](data/{name}_episodes.csv.gz)"
    files = f"{data}, [`_trainings.csv`](data/{name}_trainings.csv)"
    parts = (
        made_text(about, episodes),
        f"![{study.shows}](images/{name}.png)",
        study.caption,
        study.text(about, episodes),
        f"Data: {files}.",
    )
    return "\n" + "\n\n".join(parts) + "\n"
