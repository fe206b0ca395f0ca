"""Facts of the pages that went stale before are those of the files that decide them."""

import csv
import functools
import gzip
import json
import re
import subprocess
import tomllib

import imageio_ffmpeg
import numpy as np
import pandas as pd
import pytest

from docs.draw_films import FAILURES, FILMS, SMALL
from docs.tables import DATA, ROOT

VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
FILES = [*(ROOT / "docker").glob("*"), ROOT / "docs" / "deploy.md"]


def test_images_and_the_citation_carry_the_version():
    tags = {tag for path in FILES for tag in re.findall(r"evade:(\d[\w.]*)", path.read_text())}
    assert tags == {VERSION}
    (cited,) = re.findall(r"version = \{(.+?)\}", (ROOT / "docs" / "citation.md").read_text())
    assert cited == VERSION
    assert f"`v{VERSION}`" in (ROOT / "CHANGELOG.md").read_text()
    assert f"value: v{VERSION}\n" in (ROOT / "CITATION.cff").read_text()


@functools.cache
def about(film):
    """What ffmpeg says of a film of the gallery."""
    return next(imageio_ffmpeg.read_frames(str(ROOT / "docs" / "films" / f"{film}.mp4")))


def page_of(name):
    """A page without its line breaks."""
    return " ".join((ROOT / "docs" / name).read_text().split())


def test_every_film_of_the_gallery_is_there_and_plays_at_ten_frames_a_second():
    films = {*FILMS, *FAILURES}
    assert set(re.findall(r'src="(\w+)\.mp4"', page_of("watch.md") + page_of("vehicles.md"))) == films
    assert {about(name)["fps"] for name in films} == {10}


def test_the_demo_of_the_first_page_is_four_times_slower_than_the_flight():
    """1,123 steps of 5 ms are 5.6 s; the film's title names the factor."""
    (steps,) = re.findall(r"goal after ([\d,]+) control steps", page_of("start.md"))
    assert abs(about("poles")["duration"] - 4 * int(steps.replace(",", "")) * 0.005) < 0.5


@pytest.mark.parametrize(
    ("name", "slower", "steps", "step_s"),
    [("fails_dense_25hz", 2, 102, 0.04), ("fails_late", 4, 786, 0.005), ("crash", 4, 144, 0.005)],
)
def test_a_failure_lasts_as_its_title_says_and_its_last_frame_stays(name, slower, steps, step_s):
    assert 0.15 < about(name)["duration"] - slower * steps * step_s < 0.5


def test_the_pages_count_the_episodes_of_the_replay_page():
    text = (ROOT / "docs" / "replay.html").read_text()
    data, _ = json.JSONDecoder().raw_decode(text[text.index('{"choices"') :])
    names, page = data["choices"]["policy"], page_of("watch.md")
    goals = [sum(one["ends"] == "goal" for one in data["episodes"] if one["policy"] == place)
             for place in range(len(names))]  # fmt: skip
    own = len(data["episodes"]) // len(names)
    assert f"holds {len(data['episodes'])} recorded episodes of `{names[0]}` and `{names[1]}`" in page
    assert f"`{names[0]}` reaches the goal in {goals[0]} of its {own} episodes, `{names[1]}` in all" in page
    assert goals[1] == own


def test_the_pages_count_the_episodes_that_the_file_has():
    with gzip.open(DATA / "hold_episodes.csv.gz", "rt", newline="") as file:
        count = sum(1 for _ in csv.DictReader(file))
    assert f"All {count:,} episodes" in page_of("train.md")


def test_the_best_seed_of_half_of_the_corridors_is_as_good_in_the_other_half_as_the_page_says():
    episodes = pd.read_csv(DATA / "ppo_claims_episodes.csv.gz").query("Group == 'bytestream'")

    def rates(half: pd.DataFrame) -> pd.Series:
        by_condition = half.groupby(["Training", "Axis", "Value"])["success"].mean()
        return 100 * by_condition.groupby("Training").mean()

    halves = [rates(episodes[episodes.seed < 14]), rates(episodes[episodes.seed >= 14])]
    found = [
        (round(judged[chosen.idxmax()]), round(judged.mean())) for chosen, judged in (halves, halves[::-1])
    ]
    told = re.findall(r"reaches (\d+) % .*? is (\d+) %.*?exchanged: (\d+) and (\d+) %", page_of("train.md"))
    assert found == [tuple(map(int, told[0][:2])), tuple(map(int, told[0][2:]))]


def test_a_small_film_lasts_as_long_and_ends_as_its_source(tmp_path):
    fps, frames = 50, 108
    grey = np.linspace(20, 235, frames).astype(np.uint8)
    source = imageio_ffmpeg.write_frames(str(tmp_path / "a.mp4"), (64, 64), fps=fps, macro_block_size=1)
    source.send(None)
    for value in grey:
        source.send(np.full((64, 64, 3), value, np.uint8).tobytes())
    source.close()
    ffmpeg = imageio_ffmpeg.get_ffmpeg_exe()
    words = [ffmpeg, "-v", "error", "-y", "-i", str(tmp_path / "a.mp4"), *SMALL, str(tmp_path / "b.mp4")]
    subprocess.run(words, check=True)
    reader = imageio_ffmpeg.read_frames(str(tmp_path / "b.mp4"))
    about_it = next(reader)
    shown = [np.frombuffer(frame, np.uint8).mean() for frame in reader]
    assert about_it["fps"] == 10
    assert frames / fps <= len(shown) / 10 <= frames / fps + 0.45
    assert abs(shown[-1] - grey[-1]) < 6
