import numpy as np
import pytest
import ray
import torch
from ray.rllib.algorithms.algorithm import Algorithm as RLlibAlgorithm
from ray.rllib.core.rl_module.rl_module import RLModule

from jobs.config.config import ConfigError, parse
from jobs.run.ray_cluster import start_ray
from jobs.training.algorithms import algorithm_of, build_algorithm
from jobs.training.rllib.observed import ObservedCorridor
from jobs.training.train import MODULE, export_policy, read_metrics
from models.policy import load_policy
from tests.support.configs import compose, make_config

COLUMNS = "model=event_columns", "model.hidden=[8,8]", "env.control_hz=20"
SMALL = (
    *("algo=dqn", *COLUMNS, "algo.num_envs_per_env_runner=2"),
    *(
        "algo.settings.num_steps_sampled_before_learning_starts=20",
        "algo.settings.train_batch_size_per_learner=8",
    ),
)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    start_ray(make_config().cluster, tmp_path_factory.mktemp("ray"))
    yield
    ray.shutdown()


@pytest.mark.system
def test_a_users_dqn_trains_reports_and_is_exported_as_a_policy_that_acts_greedily(tmp_path, cluster):
    config = make_config(*SMALL)
    algorithm = algorithm_of(config)
    training = algorithm.trainable(config)(config=build_algorithm(config))
    result = {**training.train(), "trial_restarts": 0}
    while "default_policy" not in result.get("learners", {}):
        result = {**training.train(), "trial_restarts": 0}
    metrics = read_metrics(result, 1.0, algorithm)
    assert metrics["train/loss"] > 0.0
    assert metrics["sim/events_per_step"] > 0.0
    training.save(str(tmp_path / "checkpoint"))
    export_policy(config, tmp_path / "checkpoint", None, tmp_path / "policy", {})
    module = RLModule.from_checkpoint(tmp_path / "checkpoint" / MODULE)
    policy, env = load_policy(tmp_path / "policy"), ObservedCorridor(training.config.env_config)
    seen, _ = env.reset(seed=3)
    for _ in range(20):
        with torch.no_grad():
            values = module.compute_q_values({"obs": torch.from_numpy(seen[None].copy())})["qf_preds"][0]
        logits = policy._run(seen.reshape(1, *policy.stack_shape), np.zeros((1, 0)))[0][0]
        assert logits.argmax() == values.argmax()
        seen, _, over, cut, _ = env.step(int(logits.argmax()))
        if over or cut:
            break
    training.stop()


@pytest.mark.slow
def test_a_checkpoint_of_ppo_is_opened_by_rllibs_own_command(tmp_path, cluster):
    config = make_config(*COLUMNS, "algo.train_batch_size_per_learner=64", "algo.num_envs_per_env_runner=2")
    training = algorithm_of(config).trainable(config)(config=build_algorithm(config))
    training.train()
    training.save(str(tmp_path / "checkpoint"))
    weights = training.get_weights()
    training.stop()
    again = RLlibAlgorithm.from_checkpoint(str(tmp_path / "checkpoint"))
    for name, value in again.get_weights()["default_policy"].items():
        np.testing.assert_array_equal(value, weights["default_policy"][name])
    again.train()
    again.stop()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("algo.algorithm=Nope",), r"algo\.algorithm: must be one of APPO, .*, got 'Nope'"),
        (("+algo.settings.no_such=1",), r"algo\.settings: DQN has no such setting: .*no_such"),
        (("model=event_image",), r"model\.name: must be event_columns, .*got 'event_image'"),
    ],
)
def test_what_rllib_cannot_train_is_refused_with_the_key(words, message):
    columns = () if "model=event_image" in words else COLUMNS
    with pytest.raises(ConfigError, match=message):
        build_algorithm(make_config("algo=dqn", *columns, *words))


def test_an_unknown_algorithm_and_a_setting_of_another_are_refused():
    values = compose("+exp=train", "algo=dqn", *COLUMNS)
    with pytest.raises(ConfigError, match=r"^algo\.name must be one of ppo, imitation, rllib, got 'sac'$"):
        parse({**values, "algo": {**values["algo"], "name": "sac"}})
    with pytest.raises(ConfigError, match=r"^algo\.gamma: no such key"):
        parse({**values, "algo": {**values["algo"], "gamma": 0.9}})
