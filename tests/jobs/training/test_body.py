"""Training, evaluation and files of a policy whose vehicle has a body."""

import dataclasses

import numpy as np
import pytest

from envs.corridor import CorridorEnv
from envs.events import EVENT
from jobs.rollout.agents import PolicyAgent, make_agent
from jobs.rollout.episodes import roll_out
from jobs.rollout.policies import read_policy, with_own_parts, with_sensor
from jobs.training.algorithms import build_algorithm
from jobs.training.imitation.labelled_steps import COSTS, MIRRORED
from jobs.training.policy import policy_about, policy_spec
from models.policy import load_policy, save_policy
from models.policy.networks import build_networks
from models.policy.policy import PolicyFileError
from tests.support.configs import make_config

BODY = ("vehicle=point_mass", "model=event_columns", "algo.num_env_runners=0", "env.time_limit_s=0.1")


@pytest.fixture(scope="module")
def config():
    return make_config(*BODY)


@pytest.fixture(scope="module")
def folder(config, tmp_path_factory):
    spec = policy_spec(config)
    return save_policy(tmp_path_factory.mktemp("body"), build_networks(spec), spec, policy_about(config))


def test_the_files_of_a_policy_name_its_vehicle_and_its_commands(config, folder):
    policy = load_policy(folder)
    assert policy.spec.num_actions == len(policy.action_names) == 15
    env = CorridorEnv(**policy.env_fields)
    assert env.action_space.n == 15
    assert np.array_equal(policy.commands, env.dynamics.commands)
    events = np.zeros(3, EVENT)
    events["t"], events["x"], events["p"] = (1, 2, 3), (5, 9, 60), 1
    logits = policy.event_logits(events, 0, 10_000)
    policy.reset()
    command = policy.act(events, 0, 10_000)
    assert np.array_equal(command, policy.commands[logits.argmax()])
    flying = dataclasses.replace(env.config, body={}, observation="none")
    boxed = CorridorEnv(flying)
    boxed.reset(seed=0)
    boxed.step(command.astype(np.float32))  # what the Box takes


def test_a_policy_brings_its_own_vehicle(config, folder):
    policy = read_policy(str(folder))
    kinematic = dataclasses.replace(
        config.env, vehicle="kinematic", body={}, control_hz=200.0, speed_mps=20.0
    )
    assert with_own_parts(policy, kinematic).body == {"primitives": 15}
    heavy = dataclasses.replace(config.env, body={"primitives": 15, "mass_ratio": 1.1})
    assert with_own_parts(policy, heavy) == heavy
    slow = with_sensor(kinematic, policy.sensor)
    assert slow.time_limit_s * slow.speed_mps == kinematic.time_limit_s * kinematic.speed_mps
    assert slow.speed_mps != kinematic.speed_mps
    assert dataclasses.replace(slow, time_limit_s=config.env.time_limit_s) == dataclasses.replace(
        config.env, split=kinematic.split, observation=kinematic.observation
    )
    old = dataclasses.replace(policy, sensor={"control_hz": 100.0, "speed_mps": 10.0})
    assert with_sensor(config.env, old.sensor).vehicle == "kinematic"
    assert with_own_parts(old, config.env).vehicle == "kinematic"


@pytest.mark.parametrize("commands", [[[0.0, 1.0]], "left", [[None, 0.0]] * 15])
def test_wrong_commands_are_refused(folder, tmp_path, config, commands):
    spec = policy_spec(config)
    about = {**policy_about(config), "commands": commands}
    path = save_policy(tmp_path / "policy", build_networks(spec), spec, about)
    with pytest.raises(PolicyFileError, match="commands must be 15 lists of finite numbers"):
        load_policy(path)


def test_agents_fly_a_body_and_refuse_another_number_of_actions(config, folder):
    seeds = [0, 1]
    for name in ("straight", "oracle"):
        episodes = roll_out(make_agent(name), config.env, seeds)
        assert (episodes["distance_m"] > 0.9).all()
    assert roll_out(PolicyAgent(load_policy(folder)), config.env, seeds)["steps"].tolist() == [10, 10]
    other = dataclasses.replace(config.env, body={"primitives": 5})
    with pytest.raises(ValueError, match="among 15 actions, and the vehicle has 5"):
        roll_out(PolicyAgent(load_policy(folder)), other, seeds)


def test_imitation_labels_each_command_and_exchanges_left_and_right(make_runner):
    built = build_algorithm(make_config(*BODY, "algo=imitation", "algo.mirrored=true"))
    assert built.learner_config_dict["imitation"][MIRRORED] == list(range(14, -1, -1))
    episodes = make_runner(built).sample(num_timesteps=40)
    costs = np.concatenate([episode.get_extra_model_outputs(COSTS) for episode in episodes])
    assert costs.shape[1] == 15
    assert (costs.min(axis=1) == 0.0).all()
