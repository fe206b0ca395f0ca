import csv
import dataclasses

import numpy as np
import pytest

from envs.config import CameraConfig, sensor_settings
from envs.corridor import CorridorEnv
from envs.sensor import Sensor
from jobs.analysis.tables import summarise
from jobs.analysis.video import frame
from jobs.config.config import ConfigError
from jobs.evaluation import evaluate as evaluating
from jobs.evaluation.evaluate import (
    announce,
    cell_of,
    evaluate,
    film_seed,
    find_policy,
    fly_tasks,
    tasks,
    tracked_figures,
)
from jobs.evaluation.evaluate import run as run_evaluation
from jobs.rollout.agents import PolicyAgent, make_agent
from jobs.rollout.drift import FIGURES
from jobs.rollout.episodes import EPISODE, Ways, check_sensor, fly
from jobs.rollout.scheduler import KeepEpisodes
from jobs.rollout.tasks import read_episodes
from jobs.run.files import write_json
from jobs.run.folder import finished, open_run
from jobs.tracking.tracker import open_tracker
from models.kinds import KINDS
from models.policy import load_policy
from tests.support.configs import small_config
from tests.support.policies import HELD_OUT, save_untrained


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    return save_untrained(tmp_path_factory.mktemp("flown") / "policy")


@pytest.mark.parametrize("name", ["bytestream", "event_columns", "event_image", "rgb"])
def test_a_policy_of_each_kind_flies_the_same_corridors_by_what_it_sees(tmp_path, name):
    short = dataclasses.replace(HELD_OUT, time_limit_s=0.15)
    corridors, shapes = {}, {}

    def watch(env, seed, observation, info):
        corridors.setdefault(seed, set()).add(env.scene.obstacles.tobytes())
        shapes.setdefault(env.config.observation, set()).add(observation.shape)

    for agent in ("straight", str(save_untrained(tmp_path, name=name))):
        fly(make_agent(agent), short, [3, 4], watch=watch)
    assert [len(seen) for seen in corridors.values()] == [1, 1]
    shape = (4097, 4) if KINDS[name].observation == "window" else (64, 64)
    assert shapes == {"none": {(0,)}, KINDS[name].observation: {shape}}


@pytest.mark.parametrize("action", ["deterministic", "stochastic"])
def test_an_episode_does_not_depend_on_how_many_fly_beside_it(policy, action):
    flown = [fly(make_agent(str(policy), action), HELD_OUT, range(5), num_envs) for num_envs in (1, 2, 5)]
    np.testing.assert_array_equal(flown[0], flown[1])
    np.testing.assert_array_equal(flown[0], flown[2])


def test_episodes_stand_in_the_order_of_their_seeds_and_depend_on_nothing_else():
    some = fly(make_agent("straight"), HELD_OUT, [7, 3])
    np.testing.assert_array_equal(some["seed"], [7, 3])
    np.testing.assert_array_equal(some[::-1], fly(make_agent("straight"), HELD_OUT, [3, 7], num_envs=1))


def test_random_flights_differ_from_each_other_and_repeat():
    first, again = (fly(make_agent("random"), HELD_OUT, range(3)) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert len(np.unique(first["distance_m"])) == 3


def test_the_oracle_comes_through_where_flying_straight_does_not():
    oracle = fly(make_agent("oracle"), HELD_OUT, range(20), num_envs=20)
    straight = fly(make_agent("straight"), HELD_OUT, range(20), num_envs=20)
    assert oracle["success"].mean() >= 0.9
    assert straight["success"].mean() <= 0.3
    assert straight["collision"].sum() + straight["success"].sum() == 20


def test_the_oracle_also_comes_through_at_the_slowest_control():
    slow = dataclasses.replace(HELD_OUT, control_hz=45.0)
    assert fly(make_agent("oracle"), slow, range(10), num_envs=10)["success"].mean() >= 0.9


def test_an_episode_ends_as_success_collision_or_truncation_and_counts_its_way():
    short = dataclasses.replace(HELD_OUT, time_limit_s=0.5)
    flown = fly(make_agent("straight"), short, range(4))
    assert flown["truncated"].all()
    assert not (flown["success"] | flown["collision"]).any()
    np.testing.assert_array_equal(flown["steps"], 100)
    np.testing.assert_allclose(flown["distance_m"], 10.0)
    np.testing.assert_allclose(flown["return"], 10.0)


@pytest.mark.parametrize(("scene", "limit_s"), [("poles_eval", 10.0), ("dynamic", 0.1)])
@pytest.mark.parametrize("name", ["straight", "random", "oracle"])
def test_a_agent_that_looks_at_nothing_flies_the_same_bits_without_a_render(
    name, scene, limit_s, monkeypatch
):
    config, seeds = dataclasses.replace(HELD_OUT, scene=scene, time_limit_s=limit_s), range(2)
    looking = make_agent(name)
    looking.observation = "window"
    rendered = fly(looking, config, seeds)
    monkeypatch.delattr(Sensor, "_set_renderer")
    blind = fly(make_agent(name), config, seeds)
    for field in ("seed", "success", "collision", "truncated", "distance_m", "return", "steps"):
        assert blind[field].tobytes() == rendered[field].tobytes(), field
    assert (rendered["events_per_step"] > 1).all()
    assert not blind["events_per_step"].any()


def test_conditions_fly_the_same_corridors():
    noisy = dataclasses.replace(HELD_OUT, control_hz=100.0, camera=CameraConfig(contrast_threshold=0.05))
    scenes = []
    for config in (HELD_OUT, noisy):
        env = CorridorEnv(config)
        env.reset(seed=11)
        scenes.append((env.scene.obstacles, env.camera_pose()))
    np.testing.assert_array_equal(scenes[0][0], scenes[1][0])
    assert scenes[0][1] == scenes[1][1]


def test_another_sensor_than_the_policys_is_refused_with_both_values():
    manifest = {"sensor": sensor_settings(HELD_OUT)}
    other = dataclasses.replace(HELD_OUT, camera=CameraConfig(contrast_threshold=0.05))
    assert check_sensor(manifest, HELD_OUT) == {}
    with pytest.raises(ValueError, match=r"contrast_threshold = 0\.05 instead of 0\.2"):
        check_sensor(manifest, other)
    assert check_sensor(manifest, other, allow_mismatch=True) == {"contrast_threshold": (0.2, 0.05)}


def test_without_a_policy_the_message_says_how_to_get_one(tmp_path):
    config = small_config(tmp_path)
    with pytest.raises(
        ConfigError,
        match=r"no trained policy of bytestream in .*run python -m platform.launch \+exp=bytestream",
    ):
        run_evaluation(config)
    assert not (tmp_path / "runs").exists()  # refused before anything was made


def test_the_newest_policy_of_another_model_is_not_taken_but_named(tmp_path):
    config = small_config(tmp_path)
    for name in ("rgb", "event_set"):
        write_json(tmp_path / "runs" / name / "policy" / "policy.json", {"name": name})
    rule = r"no trained policy of bytestream in .*\(there is one of event_set, rgb: take model=\): run .*"
    with pytest.raises(ConfigError, match=rule + "model=bytestream"):
        run_evaluation(config)


def test_a_runs_own_policy_comes_before_a_newer_one(tmp_path, capsys):
    config = small_config(tmp_path)
    run = open_run(config)
    write_json(tmp_path / "runs" / "other" / "policy" / "policy.json", {"name": "bytestream"})
    assert find_policy(config, run) == tmp_path / "runs" / "other" / "policy"
    announce(config, run, find_policy(config, run))
    assert "other/policy, the newest of bytestream in" in capsys.readouterr().out
    write_json(run.policy / "policy.json", {"name": "bytestream"})
    write_json(tmp_path / "runs" / "other" / "policy" / "policy.json", {"name": "bytestream"})
    announce(config, run, find_policy(config, run))
    assert "policy, this run's own" in capsys.readouterr().out
    assert find_policy(config, run) == run.policy


def test_ways_end_where_the_episode_did():
    ways = Ways([1])
    flown = fly(make_agent("straight"), HELD_OUT, range(2), watch=ways.add)
    (track,) = ways.tracks("straight", flown)
    assert track.seed == 1
    assert track.way_m[-1, 1] == flown["distance_m"][1]
    assert track.outcome == ("collision" if flown["collision"][1] else "goal")


def test_the_film_shows_a_success_if_there_is_one_else_the_longest_flight():
    flown = np.zeros(3, EPISODE)
    flown["seed"], flown["distance_m"] = [4, 5, 6], [30.0, 60.0, 20.0]
    assert film_seed(flown) == 5
    flown["success"][2] = True
    assert film_seed(flown) == 6


def test_the_tracked_figures_name_agent_scene_and_renderer(tmp_path):
    plan = tasks(small_config(tmp_path))
    rows = [summarise(task.label, fly(make_agent("straight"), HELD_OUT, [0, 1])) for task in plan[:1]] * len(
        plan
    )
    rows = [dataclasses.replace(row, label=task.label) for row, task in zip(rows, plan, strict=True)]
    figures = tracked_figures(rows)
    assert {
        "eval/success_rate",
        "eval/success_rate_poles",
        "eval/success_rate_pyrender",
        "eval/success_rate_oracle",
        "eval/distance_m_straight",
    } <= set(figures)
    assert len(figures) <= 40


@pytest.mark.system
@pytest.mark.parametrize("name", ["bytestream", pytest.param("rgb", marks=pytest.mark.slow)])
def test_an_evaluation_leaves_episodes_table_ways_film_and_figures(tmp_path, name):
    config = small_config(tmp_path)
    settings = dataclasses.replace(config.evaluate, episodes=2, renderers=["raycast"], video=True)
    env = dataclasses.replace(config.env, time_limit_s=0.6)
    config = dataclasses.replace(config, evaluate=settings, env=env)
    run = open_run(config)
    save_untrained(run.policy, config.env, name)
    with open_tracker(config, run) as tracker:
        figures = evaluate(config, run, tracker)
        assert evaluate(config, run, tracker) == figures
    with (run.evaluation / "episodes.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * 5 * 2  # scenes, agents, corridors
    agents = {"policy stochastic", "policy deterministic", "straight", "random", "oracle"}
    assert {row["Agent"] for row in rows} == agents
    assert (run.evaluation / "trajectories.png").stat().st_size > 10_000
    assert (run.evaluation / "episode.mp4").stat().st_size > 5_000
    assert not list(run.evaluation.glob(".*"))
    measured = {key for key in figures if key.startswith("evae/")}
    plain = {f"evae/{part}" for part in FIGURES}
    others = {f"evae/drift_{row}" for row in ("deterministic", "poles", "deterministic_poles")}
    assert measured == (plain | others if KINDS[name].encoder else set())
    assert len(figures) <= 40
    assert (
        tracker.client.get_run(tracker.run_id).data.metrics["eval/distance_m"] == figures["eval/distance_m"]
    )
    with open_tracker(config, run) as tracker:
        more = dataclasses.replace(config, evaluate=dataclasses.replace(settings, episodes=3, video=False))
        evaluate(more, run, tracker)
    with (run.evaluation / "episodes.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 2 * 5 * 3


def test_a_policy_flies_as_its_own_networks_say(policy):
    agent = PolicyAgent(load_policy(policy))
    env = CorridorEnv(HELD_OUT)
    window, info = env.reset(seed=0)
    agent.reset([env], [0])
    alone = load_policy(policy)
    for _ in range(20):
        action = agent(window[None], [info])
        np.testing.assert_array_equal(action, alone(window[None]))
        window, _, _, _, info = env.step(int(action[0]))


def cells_for(config, path, identity="p"):
    return {task: cell_of(task, config, path, (identity, "window")) for task in tasks(config)}


def test_more_episodes_fly_only_the_new_corridors_and_another_policy_flies_all_but_the_bounds(tmp_path, stub):
    config = small_config(tmp_path)
    settings = dataclasses.replace(config.evaluate, episodes=2, renderers=["raycast"])
    config = dataclasses.replace(config, evaluate=settings)
    more = dataclasses.replace(config, evaluate=dataclasses.replace(settings, episodes=3))
    run, path = open_run(config), save_untrained(tmp_path / "policy")
    flown = fly_tasks(cells_for(config, path), config, run)
    assert list(flown) == tasks(config)
    assert len(stub.flown) == len(set(stub.flown)) == 10 * 2
    stub.flown.clear()
    fly_tasks(cells_for(more, path), more, run)
    assert {seed for _, seed in stub.flown} == {2}
    stub.flown.clear()
    fly_tasks(cells_for(more, path, "another"), more, run)
    assert len(stub.flown) == 4 * 3  # two choices of action in two scenes


def test_a_second_renderer_that_cannot_draw_leaves_its_row_out_and_the_first_stops_with_the_reason(
    tmp_path, stub
):
    config = small_config(tmp_path)
    run, path = open_run(config), save_untrained(tmp_path / "policy")
    stub.broken = {("poles_eval", "pyrender"): "RuntimeError: no OpenGL"}
    flown = fly_tasks(cells_for(config, path), config, run)
    assert {task.renderer for task in tasks(config)} - {task.renderer for task in flown} == {"pyrender"}
    stub.broken = {("poles", "raycast"): "ValueError: no"}
    config = dataclasses.replace(config, runs_dir=str(tmp_path / "others"))
    with pytest.raises(RuntimeError, match=r"poles raycast: not flown: ValueError: no; the same command"):
        fly_tasks(cells_for(config, path), config, open_run(config))


def test_an_evaluation_with_a_row_missing_tries_it_again_and_a_whole_one_is_done(tmp_path, monkeypatch):
    config = small_config(tmp_path)
    settings = dataclasses.replace(config.evaluate, episodes=1, pyrender_episodes=1, video=False)
    env = dataclasses.replace(config.env, time_limit_s=0.05)
    config = dataclasses.replace(config, evaluate=settings, env=env)
    run, asked = open_run(config), []
    save_untrained(run.policy, config.env, "event_columns")

    def flown_here(config, place, cells, *given, **named):
        asked.append(len(cells))
        able = [cell for cell in cells if len(asked) > 1 or cell.env.renderer == "raycast"]
        keep = KeepEpisodes(place / "episodes")
        for cell in able:
            rows = fly(make_agent("straight"), cell.env, cell.seeds).tolist()
            result = {"key": cell.key, "label": [], "simulation": "s", "accuracy": None, "encoder": {}}
            keep.on_trial_result(1, [], None, result | {"episodes": rows})
        kept = {cell.key: read_episodes(cell, place / "episodes") for cell in able}
        return kept, {cell.key: "no" for cell in cells if cell.key not in kept}

    monkeypatch.setattr(evaluating, "fly_cells", flown_here)
    with open_tracker(config, run) as tracker:
        for _ in range(3):
            evaluate(config, run, tracker)
    assert asked == [11, 11]
    marker = finished(run, "evaluate")
    assert marker["missing"] == []
    assert len(marker["flown_at"]) == 1


def test_a_caption_has_room_under_a_single_panel():
    panel = ("luminance", np.zeros((64, 64, 3), np.uint8))
    caption = "shape_change 99   9.99 s    99.9 m   collision   4x slower"
    one, three = (frame([panel] * count, caption)[-40:] for count in (1, 3))
    np.testing.assert_array_equal(one, three[:, : one.shape[1]])
    assert (three[:, one.shape[1] :] == three[0, -1]).all(), "all of the caption is in the narrow one"
