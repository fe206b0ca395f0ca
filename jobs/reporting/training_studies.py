"""Pages of planned studies of trainings: the plan stands, what is below it is written anew."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

from matplotlib.figure import Figure

from jobs.analysis.tables import save_plot
from jobs.evaluation.sweep_report import SweepFacts
from jobs.reporting import camera_rates, encoder_seeds, paper_recipe, two_groups
from jobs.reporting.breaks import SweptEpisodes
from jobs.reporting.planned_page import made_text, write_below_plan
from jobs.reporting.sweep_data import read_data, read_sweep, write_data


class TrainingStudy(NamedTuple):
    """What is published of a study.

    Attributes:
        text: What its results say, as Markdown; it is given the folder of published data, too.
        draw: Its figure.
        shows: What the figure is of.
        caption: What is seen in it.
    """

    text: Callable[[SweepFacts, SweptEpisodes, Path], str]
    draw: Callable[[SweepFacts, SweptEpisodes], Figure]
    shows: str
    caption: str


SETS = "ppo_event_set"
SETS_GROUPS = two_groups.Groups("event_set", "bytestream")
# Name of the experiment, of its page, and of its data.
STUDIES = {
    encoder_seeds.ENCODERS: TrainingStudy(
        lambda about, episodes, _: encoder_seeds.results_text(about, episodes),
        encoder_seeds.draw,
        "Mean success of every training by encoder and seed of PPO, and what success differs by",
        "Left: a cell is one training, its mean success under all conditions. Right: the standard deviations "
        "of the table below.",
    ),
    camera_rates.CAMERAS: TrainingStudy(
        lambda about, episodes, _: camera_rates.results_text(about, episodes),
        camera_rates.draw,
        "Success against control rate for trainings by either camera at three rates",
        "A marker is one training, set a little aside of its rate, a line the mean of the three; dotted: the "
        "rate at which they were trained. Blue: `pixels`, red: `frames`, green: trained by `frames`, "
        "evaluated by `pixels`.",
    ),
    SETS: TrainingStudy(
        lambda about, episodes, _: two_groups.results_text(SETS_GROUPS, about, episodes),
        partial(two_groups.draw, SETS_GROUPS),
        "Success of every training under each condition, by a frozen encoder and by a network over sets",
        "A small marker is one training, a stroke the mean of its group.",
    ),
    paper_recipe.PAPER: TrainingStudy(
        paper_recipe.results_text,
        partial(two_groups.draw, paper_recipe.RECIPES),
        "Success of every training under each condition, by our recipe and by the paper's",
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
    text, figure = _text(docs / "data", name, about, episodes), STUDIES[name].draw(about, episodes)
    write_data(docs / "data", name, study, episodes)
    save_plot(docs / "images" / f"{name}.png", figure)
    return write_below_plan(docs / f"{name}.md", text)


def published_text(data: Path, name: str) -> str:
    """What stands below the plan of a published study."""
    return _text(data, name, *read_data(data, name))


def draw_study(data: Path, name: str) -> Figure:
    """The figure of a published study."""
    return STUDIES[name].draw(*read_data(data, name))


def _text(data: Path, name: str, about: SweepFacts, episodes: SweptEpisodes) -> str:
    study = STUDIES[name]
    table = f"[`data/{name}_episodes.csv.gz`](data/{name}_episodes.csv.gz)"
    files = f"{table}, [`_trainings.csv`](data/{name}_trainings.csv)"
    parts = (
        made_text(about, episodes),
        f"![{study.shows}](images/{name}.png)",
        study.caption,
        study.text(about, episodes, data),
        f"Data: {files}.",
    )
    return "\n" + "\n\n".join(parts) + "\n"
