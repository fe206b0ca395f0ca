import csv
import dataclasses

import numpy as np
import pytest

from envs.config import CameraConfig
from envs.corridor import CorridorEnv
from envs.sensor import Sensor
from jobs.analysis.tables import summarise
from jobs.analysis.video import frame
from jobs.config.config import HELD_OUT_SCENE, ConfigError
from jobs.evaluation import evaluate as evaluation
from jobs.evaluation.evaluate import (
    announce,
    evaluate,
    evaluate_all,
    evaluation_metrics,
    label_of,
    plan_evaluation,
    published,
    seed_to_film,
)
from jobs.evaluation.evaluate import run as run_evaluation
from jobs.rollout.agents import OnnxAgent, PolicyAgent, make_agent
from jobs.rollout.diagnostics import DRIFT_METRICS
from jobs.rollout.episodes import EPISODE, TrajectoryRecorder, roll_out
from jobs.rollout.executors import evaluate_part, run_serially
from jobs.rollout.policies import check_sensor, find_policy, own_sensor_differences, read_policy
from jobs.rollout.store import EpisodeStore
from jobs.run.files import write_json
from jobs.run.folder import finished, open_run
from jobs.tracking.tracker import open_tracker
from models.kinds import KINDS
from models.policy import load_policy, save_policy
from models.policy.memory import kept_shape
from models.policy.networks import build_networks
from tests.support.configs import small_config
from tests.support.fake_executor import FakeExecutor
from tests.support.policies import (
    ABOUT,
    HELD_OUT,
    SIDE,
    make_spec,
    make_windows,
    save_training,
    save_untrained,
)


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    return save_untrained(tmp_path_factory.mktemp("given") / "policy")


@pytest.mark.parametrize(("name", "shape"), [("bytestream", (4097, 4)), ("rgb", (64, 64, 1))])
def test_agents_and_conditions_fly_through_the_same_corridors_and_see_what_they_need(tmp_path, name, shape):
    short = dataclasses.replace(HELD_OUT, time_limit_s=0.05)
    other = dataclasses.replace(short, control_hz=100.0, camera=CameraConfig(contrast_threshold=0.05))
    corridors, shapes = {}, {}

    def watch(env, seed, observation):
        corridors.setdefault(seed, set()).add((env.scene.obstacles.tobytes(), env.scene.width_m))
        shapes.setdefault(env.config.observation, set()).add(observation.shape)

    for agent in ("straight", str(save_untrained(tmp_path, name=name))):
        for env in (short, other):
            roll_out(make_agent(agent), env, [3, 4], watch=watch)
    assert [len(seen) for seen in corridors.values()] == [1, 1]
    assert corridors[3] != corridors[4]
    assert shapes == {"none": {(0,)}, KINDS[name].observation: {shape}}


@pytest.mark.parametrize("agent", [None, "random", "oracle"])
def test_an_episode_depends_on_its_seed_and_not_on_how_many_run_beside_it(policy, agent):
    short = dataclasses.replace(HELD_OUT, scene="poles_dense", time_limit_s=2.5)
    seeds, name = [3, 1, 0, 4], agent or str(policy)
    alone, beside = (roll_out(make_agent(name, "stochastic"), short, seeds, count) for count in (1, 3))
    np.testing.assert_array_equal(alone["seed"], seeds)
    np.testing.assert_array_equal(alone, beside)
    assert len(np.unique(alone["x_m"])) == 4


@pytest.mark.parametrize(
    ("changes", "trials", "straight"),
    [
        ({}, 10, 0.3),
        ({"control_hz": 45.0}, 10, 0.3),
        ({"action_delay_ms": 250.0}, 10, 0.3),  # it foresees what it has decided
        ({"layout": {"num_obstacles": 0, "num_moving": 40}, "control_hz": 30.0}, 3, 0.4),
        ({"layout": {"throw_every_s": 1.0}, "control_hz": 50.0}, 5, 0.4),
    ],
)
def test_the_oracle_comes_through_where_flying_straight_does_not(changes, trials, straight):
    env = dataclasses.replace(HELD_OUT, **changes)
    assert roll_out(make_agent("oracle"), env, range(trials), num_envs=trials)["success"].mean() >= 0.9
    flown = roll_out(make_agent("straight"), env, range(10))
    assert flown["success"].mean() <= straight
    assert (flown["collision"] | flown["success"]).all()


def test_an_episode_that_is_cut_counts_its_way():
    short = dataclasses.replace(HELD_OUT, time_limit_s=0.5)
    episodes = roll_out(make_agent("straight"), short, range(4))
    assert episodes["truncated"].all()
    assert not (episodes["success"] | episodes["collision"]).any()
    np.testing.assert_array_equal(episodes["steps"], 100)
    np.testing.assert_allclose(episodes["distance_m"], 10.0)
    np.testing.assert_allclose(episodes["return"], 10.0)


@pytest.mark.parametrize(
    ("name", "scene", "limit_s"), [("random", "poles_eval", 2.0), ("oracle", "dynamic", 0.1)]
)
def test_an_agent_that_looks_at_nothing_gives_the_same_bits_without_a_render(
    name, scene, limit_s, monkeypatch
):
    config, seeds = dataclasses.replace(HELD_OUT, scene=scene, time_limit_s=limit_s), range(2)
    looking = make_agent(name)
    looking.observation = "window"
    rendered = roll_out(looking, config, seeds)
    monkeypatch.delattr(Sensor, "_set_renderer")
    blind = roll_out(make_agent(name), config, seeds)
    for field in ("seed", "success", "collision", "truncated", "distance_m", "return", "steps"):
        assert blind[field].tobytes() == rendered[field].tobytes(), field
    assert (rendered["events_per_step"] > 1).all()
    assert not blind["events_per_step"].any()


def test_another_sensor_than_the_policys_is_refused_with_both_values(tmp_path):
    policy = read_policy(save_training(tmp_path / "policy", "a", 0, HELD_OUT))
    other = dataclasses.replace(HELD_OUT, camera=CameraConfig(contrast_threshold=0.05))
    check_sensor(policy.sensor, HELD_OUT)
    with pytest.raises(ValueError, match=r"contrast_threshold = 0\.05 instead of 0\.2"):
        check_sensor(policy.sensor, other)
    assert own_sensor_differences(policy, HELD_OUT) == {}
    assert own_sensor_differences(policy, other) == {"contrast_threshold": (0.2, 0.05)}
    assert own_sensor_differences(read_policy("oracle"), other) == {}


def test_without_a_policy_the_message_says_how_to_get_one_and_names_those_of_other_models(tmp_path):
    config = small_config(tmp_path)
    with pytest.raises(ConfigError, match=r"no trained policy of bytestream in .*launch \+exp=bytestream"):
        run_evaluation(config)
    assert not (tmp_path / "runs").exists()  # refused before anything was made
    for name in ("rgb", "event_set"):
        write_json(tmp_path / "runs" / name / "policy" / "policy.json", {"name": name})
    rule = r"no trained policy of bytestream in .*\(there is one of event_set, rgb: take model=\): run .*"
    with pytest.raises(ConfigError, match=rule + "model=bytestream"):
        run_evaluation(config)


def test_a_runs_own_policy_comes_before_a_newer_one(tmp_path, capsys):
    config = small_config(tmp_path)
    run, other = open_run(config), tmp_path / "runs" / "other" / "policy"
    said = {other: "other/policy, the newest of bytestream in", run.policy: "policy, this run's own"}
    for place, words in said.items():
        save_training(place, "a", 0, HELD_OUT, "bytestream")
        save_training(other, "a", 0, HELD_OUT, "bytestream")
        found = find_policy(config, run)
        announce(run, found)
        assert words in capsys.readouterr().out
        assert found.agent == str(place)


def test_a_trajectory_ends_where_the_episode_did():
    recorder = TrajectoryRecorder([1])
    episodes = roll_out(make_agent("straight"), HELD_OUT, range(2), watch=recorder.add)
    (trajectory,) = recorder.trajectories("straight", episodes)
    assert trajectory.seed == 1
    assert trajectory.xy_m[-1, 1] == episodes["distance_m"][1]
    assert trajectory.outcome == ("collision" if episodes["collision"][1] else "goal")


def test_the_video_shows_a_success_if_there_is_one_else_the_longest_episode():
    episodes = np.zeros(3, EPISODE)
    episodes["seed"], episodes["distance_m"] = [4, 5, 6], [30.0, 60.0, 20.0]
    assert seed_to_film(episodes) == 5
    episodes["success"][2] = True
    assert seed_to_film(episodes) == 6


def with_settings(config, **changes):
    """The configuration with other settings of its evaluation."""
    return dataclasses.replace(config, evaluate=dataclasses.replace(config.evaluate, **changes))


def with_both_renderers(config):
    return with_settings(config, renderers=["raycast", "pyrender"])


def test_the_metrics_name_agent_scene_and_renderer(tmp_path):
    config = with_both_renderers(small_config(tmp_path))
    config = dataclasses.replace(config, env=dataclasses.replace(config.env, scene="gates"))
    labels = [label_of(task) for task in plan_evaluation(config, read_policy(trained(tmp_path)))]
    row = summarise(labels[0], roll_out(make_agent("straight"), HELD_OUT, [0, 1]))
    metrics = evaluation_metrics([dataclasses.replace(row, label=label) for label in labels])
    rates = {f"eval/success_rate{of}" for of in ("", "_gates", "_pyrender", "_oracle")}
    assert rates | {"eval/distance_m_straight"} <= set(metrics)
    assert len(metrics) <= 40


def test_a_scene_of_training_is_evaluated_unless_it_is_what_the_held_out_one_stands_for(tmp_path):
    config, policy = small_config(tmp_path), read_policy("straight")

    def scenes(trained_in):
        env = dataclasses.replace(config.env, scene=trained_in)
        return [task.env.scene for task in plan_evaluation(dataclasses.replace(config, env=env), policy)[::5]]

    assert scenes("poles") == scenes("poles_eval") == ["poles_eval"]
    assert scenes("gates") == ["poles_eval", "gates"]


def trained(tmp_path, name="bytestream"):
    """The folder of a policy that says it was trained."""
    return save_training(tmp_path / name, name, 0, small_config(tmp_path).env, name)


@pytest.mark.system
@pytest.mark.parametrize("name", ["bytestream", pytest.param("rgb", marks=pytest.mark.slow)])
def test_an_evaluation_leaves_episodes_table_trajectories_video_and_metrics(tmp_path, monkeypatch, name):
    monkeypatch.setattr(evaluation, "default_executor", lambda *_: run_serially)
    config = with_settings(small_config(tmp_path), episodes=2, renderers=["raycast"], video=True)
    config = dataclasses.replace(config, env=dataclasses.replace(config.env, time_limit_s=0.6))
    run = open_run(config)
    save_training(run.policy, name, 0, config.env, name)
    with open_tracker(config, run) as tracker:
        figures = evaluate(run, tracker)
        assert evaluate(run, tracker) == figures
    rows = list(csv.DictReader((run.evaluation / "episodes.csv").read_text().splitlines()))
    assert len(rows) == 5 * 2  # agents, corridors
    agents = {"policy stochastic", "policy deterministic", "straight", "random", "oracle"}
    assert {row["Agent"] for row in rows} == agents
    assert (run.evaluation / "trajectories.png").stat().st_size > 10_000
    assert (run.evaluation / "episode.mp4").stat().st_size > 5_000
    assert not list(run.evaluation.glob(".*"))
    measured = {key for key in figures if key.startswith("evae/")}
    drifts = {"evae/drift_deterministic", *(f"evae/{part}" for part in DRIFT_METRICS)}
    assert measured == (drifts if KINDS[name].encoder else set())
    assert len(figures) <= 40
    tracked = tracker.client.get_run(tracker.run_id).data.metrics
    assert tracked["eval/distance_m"] == figures["eval/distance_m"]
    with open_tracker(config, run) as tracker:
        more = with_settings(config, episodes=3, video=False)
        evaluate(dataclasses.replace(run, config=more), tracker)
    assert len((run.evaluation / "episodes.csv").read_text().splitlines()) == 1 + 5 * 3


def test_a_policy_acts_as_its_own_networks_say(policy):
    agent = PolicyAgent(load_policy(policy))
    env = CorridorEnv(HELD_OUT)
    window, _ = env.reset(seed=0)
    agent.reset([env], [0])
    alone = load_policy(policy)
    for _ in range(5):
        action = agent(window[None])
        np.testing.assert_array_equal(action, alone(window[None]))
        window = env.step(int(action[0]))[0]


@pytest.mark.system
def test_a_policy_and_its_file_see_the_same_actions_and_velocity(tmp_path):
    pytest.importorskip("onnxruntime", reason="needs the extra onnx")
    from models.policy.onnx import export_onnx

    spec = make_spec("event_columns", memory_ms=[10.0, 100.0], own_actions=True, own_velocity=True)
    networks = build_networks(spec, seed=3)
    networks["pi"][0].weight.data.view(64, *kept_shape(spec))[:, :, -spec.own_size :] *= 20.0
    networks["pi"][-1].weight.data.mul_(100.0)
    own = load_policy(save_policy(tmp_path / "policy", networks, spec, ABOUT))
    file = export_onnx(own, tmp_path / "policy.onnx")
    agents = PolicyAgent(own, stochastic=True), OnnxAgent(str(file), stochastic=True)
    envs = [CorridorEnv(HELD_OUT, velocity_noise_mps=1.0) for _ in range(2)]
    for seed, env in enumerate(envs):
        env.reset(seed=seed)
    for agent in agents:
        agent.reset(envs, [0, 1])
    rng, chosen = np.random.default_rng(0), []
    for _ in range(40):
        windows = make_windows(rng, 2, side=SIDE)
        one, other = (agent(windows) for agent in agents)
        for env, action in zip(envs, one, strict=True):
            env.step(action)
        np.testing.assert_array_equal(one, other)
        np.testing.assert_array_equal(own.taken, one)
        chosen.append(agents[0].logits.argmax(axis=1) == one)
    assert 0.1 < np.mean(chosen) < 0.9  # other actions were drawn than the likeliest


def test_more_episodes_evaluate_only_the_new_corridors_and_another_policy_all_but_the_baselines(tmp_path):
    config = with_settings(small_config(tmp_path), episodes=2, renderers=["raycast"])
    more = with_settings(config, episodes=3)
    store, executor, policy = EpisodeStore(tmp_path), FakeExecutor(), read_policy(trained(tmp_path))
    tasks = plan_evaluation(config, policy)
    assert list(evaluate_all(tasks, store, executor)) == [label_of(task) for task in tasks]
    assert len(executor.evaluated) == len(set(executor.evaluated)) == 5 * 2
    executor.evaluated.clear()
    evaluate_all(plan_evaluation(more, policy), store, executor)
    assert {seed for _, seed in executor.evaluated} == {2}
    executor.evaluated.clear()
    evaluate_all(plan_evaluation(more, dataclasses.replace(policy, identity="another")), store, executor)
    assert len(executor.evaluated) == 2 * 3  # two choices of action


def test_a_second_renderer_that_cannot_draw_leaves_its_row_out_and_the_first_stops_with_the_reason(tmp_path):
    config = with_both_renderers(small_config(tmp_path))
    executor, tasks = FakeExecutor(), plan_evaluation(config, read_policy(trained(tmp_path)))
    executor.broken = {("poles_eval", "pyrender"): "RuntimeError: no OpenGL"}
    results = evaluate_all(tasks, EpisodeStore(tmp_path), executor)
    missing = {label_of(task) for task in tasks} - set(results)
    assert missing == {("policy stochastic", "poles_eval", "pyrender")}
    executor.broken = {("poles_eval", "raycast"): "ValueError: no"}
    with pytest.raises(RuntimeError, match=r"poles_eval raycast: .*ValueError: no"):
        evaluate_all(tasks, EpisodeStore(tmp_path / "others"), executor)


@pytest.mark.system
def test_an_evaluation_with_a_row_missing_tries_it_again_and_a_whole_one_is_done(tmp_path, monkeypatch):
    config = with_both_renderers(small_config(tmp_path))
    config = with_settings(config, episodes=1, pyrender_episodes=1, video=False)
    config = dataclasses.replace(config, env=dataclasses.replace(config.env, time_limit_s=0.05))
    run, executor = open_run(config), FakeExecutor(evaluate_part)
    monkeypatch.setattr(evaluation, "default_executor", lambda *_: executor)
    save_training(run.policy, "a", 0, config.env, "event_columns")
    drawn = {("poles_eval", "pyrender"): "RuntimeError: no OpenGL"}
    with open_tracker(config, run) as tracker:
        for broken, evaluated, missing in ((drawn, 5, 1), ({}, 6, 0), (drawn, 6, 0)):
            executor.broken = broken
            evaluate(run, tracker)
            found = len(executor.evaluated), len(finished(run, "evaluate")["missing"])
            assert found == (evaluated, missing)
    assert len(finished(run, "evaluate")["evaluated_at"]) == 1


def test_a_caption_has_room_under_a_single_panel():
    panel = ("luminance", np.zeros((64, 64, 3), np.uint8))
    caption = "shape_change 99   9.99 s    99.9 m   collision   4x slower"
    one, three = (frame([panel] * count, caption)[-40:] for count in (1, 3))
    np.testing.assert_array_equal(one, three[:, : one.shape[1]])
    assert (three[:, one.shape[1] :] == three[0, -1]).all(), "all of the caption is in the narrow one"


def test_a_published_policy_is_evaluated_beside_with_its_own_sensor_and_named(tmp_path):
    config = small_config(tmp_path)
    tasks = plan_evaluation(with_settings(config, beside=["bytestream_hold-s0"]), read_policy("straight"))
    beside = [task for task in tasks if label_of(task)[0] == "bytestream_hold s0"]
    assert {task.condition for task in beside} == {(HELD_OUT_SCENE, "raycast")}
    assert {task.env.filter_support for task in beside} == {1}
    assert len(tasks) == len(plan_evaluation(config, read_policy("straight"))) + 1
    with pytest.raises(ConfigError, match=r"^evaluate.beside: must be names in models/pretrained, .*'moon'"):
        published("moon")
