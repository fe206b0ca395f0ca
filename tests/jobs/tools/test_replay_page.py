import base64
import dataclasses
import itertools
import json
import re
import zlib
from pathlib import Path

import numpy as np
import pytest

from core.pictures import GREY_OFF, GREY_ON
from docs.browser import CHROMIUM, Browser
from envs.config import FaultsConfig
from jobs.config.config import ConfigError, parse
from jobs.rollout.agents import PolicyAgent, make_agent
from jobs.rollout.episodes import roll_out
from jobs.rollout.policies import read_policy
from jobs.rollout.recorded import record_episode
from jobs.run.folder import locate_run
from jobs.study.report import write_replay
from jobs.tools.replay_page import packed_episode, page_data, pixels, record, run, shown_steps, write_page
from jobs.tracking.tracker import open_store
from models.policy import load_policy
from tests.support.configs import compose
from tests.support.policies import HELD_OUT, save_training

ENV = dataclasses.replace(HELD_OUT, time_limit_s=0.3, faults=FaultsConfig(background_activity=0.25))
NOISE, RATES = (0.0, 0.25), (100.0, 200.0)


@pytest.fixture(scope="module")
def policies(tmp_path_factory):
    """The folders of a policy with a latent, and of one that sees no events."""
    place = tmp_path_factory.mktemp("policies")
    return [save_training(place / name, name, 0, HELD_OUT, name) for name in ("bytestream", "rgb")]


def page_config(tmp_path, policies):
    words = [f"replay_page.policies=[{','.join(policies)}]", "replay_page.scenes=[poles_eval,gates]"]
    words += [f"replay_page.background_activity={[*NOISE]}", f"replay_page.control_hz={[*RATES]}"]
    values = compose("+exp=replay_page", "env.time_limit_s=0.3", "seed=2", *words)
    values["tracking"]["uri"] = f"sqlite:///{tmp_path / 'mlflow.db'}"
    return parse({**values, "runs_dir": str(tmp_path / "runs")})


def ignore(count):
    """Show no progress."""


@pytest.fixture(scope="module")
def page(tmp_path_factory, policies):
    """The configuration, the cells and the data of a page, and its file."""
    config = page_config(tmp_path_factory.mktemp("page"), policies)
    named = map(read_policy, policies)
    cells = list(itertools.product(named, ("poles_eval", "gates"), NOISE, RATES))
    data = page_data(cells, record(config, cells, ignore))
    return config, cells, data, write_page(locate_run(config), data)


def unpacked(one):
    """The columns of a packed episode, read as its docstring says and not as the code writes them."""
    packed = zlib.decompress(base64.b64decode(one["data"]))
    frames, place = one["frames"], 0

    def take(count, form, width=2):
        nonlocal place
        own = np.frombuffer(packed, np.uint8, count * width, place)
        place += count * width
        return own.reshape(width, count).T.copy().view(form).ravel()

    words = {"step": "<u2", "x": "<i2", "y": "<i2", "events": "<u2", "fired": "<u2"}
    columns = {name: take(frames, form) for name, form in words.items()}
    columns["pixels"] = np.split(take(columns["fired"].sum(), "<u2"), np.cumsum(columns["fired"])[:-1])
    columns["latents"] = take(frames * one["latent"], "i1", 1).reshape(frames, -1)
    columns["probabilities"] = take(frames * 3, "u1", 1).reshape(frames, 3)
    columns["action"] = take(frames, "u1", 1)
    assert place == len(packed)
    return columns


@pytest.mark.parametrize("place", [0, 1])
def test_what_a_page_holds_is_what_was_recorded(policies, place):
    recorded = record_episode(PolicyAgent(load_policy(policies[place]), stochastic=True), ENV, 5)
    one = packed_episode(recorded)
    columns, shown = unpacked(one), [recorded.moments[k] for k in shown_steps(len(recorded.moments), 200.0)]
    np.testing.assert_array_equal(columns["step"], [*range(0, 60, 5), 59])
    for row, moment in enumerate(shown):
        assert abs(columns["x"][row] - 100 * moment.x_m) <= 0.5
        assert abs(columns["y"][row] - 100 * moment.y_m) <= 0.5
        assert (columns["events"][row], columns["action"][row]) == (moment.num_events, moment.action)
        np.testing.assert_allclose(columns["probabilities"][row] / 255, moment.probabilities, atol=0.5 / 255)
        if moment.latent is not None:
            step = one["scale"] / 127
            np.testing.assert_allclose(columns["latents"][row] * step, moment.latent, atol=0.501 * step)
        image = np.zeros((64, 64), np.uint8)
        for at, code in zip(np.cumsum(columns["pixels"][row] // 2), columns["pixels"][row], strict=True):
            image[at % 64, at // 64] = GREY_ON if code % 2 else GREY_OFF
        np.testing.assert_array_equal(image, moment.events if moment.events is not None else 0)
    assert max(columns["fired"]) > (10 if place == 0 else -1)
    (row,) = roll_out(make_agent(policies[place], "stochastic"), ENV, [5])
    assert (one["distance"], one["steps"], one["ends"]) == (row["distance_m"], row["steps"], "time limit")
    assert (one["events"], one["end"]) == (row["events_per_step"], [row["x_m"], row["distance_m"]])


def test_every_choice_of_the_controls_has_its_own_episode(page):
    _, cells, data, _ = page
    choices = data["choices"]
    assert (choices["noise"], choices["rate"]) == ([0.0, 0.25], [100.0, 200.0])
    assert choices["scene"] == ["poles_eval", "gates"]
    keys = [tuple(one[name] for name in ("policy", "scene", "noise", "rate")) for one in data["episodes"]]
    assert len(set(keys)) == len(cells) == 16
    assert {one["steps"] for one in data["episodes"] if one["rate"] == 0} == {30}
    clean, noisy = (next(one for one in data["episodes"] if one["noise"] == noise) for noise in (0, 1))
    assert noisy["events"] > 1.1 * clean["events"]


def test_the_same_seed_gives_the_same_bytes_and_another_another_page(page, policies, tmp_path):
    config, cells, data, path = page
    other = dataclasses.replace(config, runs_dir=str(tmp_path))
    again = page_data(cells[:2], record(config, cells[:2], ignore))
    assert again["episodes"] == data["episodes"][:2]
    assert write_page(locate_run(other), data).read_bytes() == path.read_bytes()
    assert write_replay(path.parent, tmp_path).read_bytes() == path.read_bytes()  # the report's copy
    seed = dataclasses.replace(config, seed=3)
    assert page_data(cells[:1], record(seed, cells[:1], ignore))["episodes"] != data["episodes"][:1]


def test_a_page_needs_no_network_and_embeds_its_data_unchanged(page):
    *_, data, path = page
    text = path.read_text()
    assert re.findall(r"https?:|//[a-z]+\.|@import|fetch\(|XMLHttpRequest|url\(", text) == []
    (embedded,) = re.findall(r'id="data">(.*?)</script>', text)
    assert json.loads(embedded) == data


def test_another_name_than_one_policys_and_too_large_an_image_are_refused(tmp_path):
    with pytest.raises(ValueError, match="at most 32768 pixels, got 40000"):
        pixels(np.zeros((200, 200), np.uint8))
    with pytest.raises(ConfigError, match=r"replay_page\.policies: must be one trained policy: .*'oracle'"):
        run(page_config(tmp_path, ["oracle"]))


@pytest.mark.system
def test_the_job_tracks_the_page(tmp_path, policies):
    config = page_config(tmp_path, policies[:1])
    assert run(config) == {"episodes": 8}
    client, experiment = open_store(config.tracking.uri, config.tracking.experiment)
    (tracked,) = client.search_runs([experiment], "tags.kind = 'replay_page'")
    file = client.download_artifacts(tracked.info.run_id, "replay/replay.html", str(tmp_path))
    (own,) = (tmp_path / "runs").glob("*/replay/replay.html")
    assert own.read_bytes() == Path(file).read_bytes()


@pytest.fixture
def browser(tmp_path):
    if CHROMIUM is None:
        pytest.skip("needs Chromium: apt-get install --no-install-recommends chromium")
    browser = Browser(tmp_path / "profile", 1440, 1000)
    yield browser
    browser.close()


def shown(browser):
    """What the page shows: the text of the moment, the pictures, the probabilities."""
    browser.wait("document.getElementById('moment-text').textContent !== ''", "a moment")
    drawn = "document.getElementById('{}').toDataURL()"
    pictures = [browser.evaluate(drawn.format(name)) for name in ("events", "latent", "plan")]
    meters = browser.evaluate("[...document.querySelectorAll('[role=meter]')].map(e => +e.ariaValueNow)")
    return browser.evaluate("document.getElementById('moment-text').textContent"), pictures, meters


def move(browser, name, value):
    """Give a control another value, as a hand does."""
    control = f"document.getElementById('{name}')"
    browser.evaluate(f"{control}.value = {value}; {control}.dispatchEvent(new Event('input'))")


@pytest.mark.slow
def test_in_a_browser_controls_and_keys_change_what_is_shown_and_nothing_fails(page, browser):
    _, _, data, path = page
    browser.open(path.as_uri(), "What the policy sees")
    browser.evaluate("document.getElementById('policy').value = 0")
    move(browser, "noise", 1)
    browser.wait("document.getElementById('noise-text').textContent === '25 %'", "the noise")
    chosen = {"policy": 0, "scene": 0, "noise": 1, "rate": 0}
    one = next(one for one in data["episodes"] if chosen.items() <= one.items())
    columns = unpacked(one)
    seen = []
    for place in (3, 9):
        move(browser, "moment", place)
        seen.append(shown(browser))
        seconds, metres, step, steps = map(float, re.findall(r"[\d.]+", seen[-1][0]))
        assert (seconds, step, steps) == (columns["step"][place] / 100, columns["step"][place] + 1, 30)
        assert abs(100 * metres - columns["y"][place]) <= 5.01
        np.testing.assert_allclose(seen[-1][2], columns["probabilities"][place][[1, 0, 2]] / 255, atol=0.006)
        label = browser.evaluate("document.getElementById('events').ariaLabel")
        assert label == f"{columns['events'][place]} events in this step"
    assert all(before != after for before, after in zip(seen[0][1], seen[1][1], strict=True))
    browser.press("ArrowLeft")
    assert browser.evaluate("document.getElementById('moment').value") == "8"
    browser.press("Home")
    browser.press(" ")
    browser.wait("Number(document.getElementById('moment').value) > 3", "playing")
    browser.press(" ")
    assert browser.evaluate("document.getElementById('play').textContent") == "Play"
    for name, value in (("rate", 1), ("scene", 1), ("policy", 1)):
        before = shown(browser)[1][2]
        move(browser, name, value)
        browser.wait(f"document.getElementById('plan').toDataURL() !== {json.dumps(before)}", name)
    assert browser.errors == []


@pytest.mark.slow
@pytest.mark.parametrize("width", [1440, 390])
def test_in_a_browser_nothing_is_wider_than_the_screen_and_everything_has_a_name(
    page, tmp_path, browser, width
):
    browser.size["width"] = width
    browser.open(page[-1].as_uri(), "What the policy sees")
    shown(browser)
    assert browser.evaluate("document.documentElement.scrollWidth") <= width
    nameless = "[...document.querySelectorAll('input, select, canvas, button, [role=meter]')].filter("
    nameless += "e => !(e.ariaLabel || e.labels?.length || e.textContent.trim())).map(e => e.id)"
    assert browser.evaluate(nameless) == []
    assert browser.errors == []
