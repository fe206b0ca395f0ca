import inspect
import re

import pytest
import ray
from ray.rllib.algorithms.ppo.torch.ppo_torch_learner import PPOTorchLearner
from ray.rllib.core.rl_module.torch import TorchRLModule
from ray.rllib.env.env_runner_group import EnvRunnerGroup
from ray.rllib.env.single_agent_env_runner import SingleAgentEnvRunner

from jobs.training.ppo import learner as ppo_learner
from jobs.training.sampling import env_runner
from jobs.training.sampling.rllib_internals import ENV_RUNNER, GROUP, LEARNER, MODULE, TESTED_RAY, require


def defined(part, name):
    """Whether a class of RLlib has a method of this name, or gives itself an attribute of it."""
    sources = (inspect.getsource(base) for base in part.__mro__ if base.__module__.startswith("ray."))
    return hasattr(part, name) or any(re.search(rf"self\.{name}\b", source) for source in sources)


@pytest.mark.parametrize(
    ("part", "names"),
    [
        (SingleAgentEnvRunner, ENV_RUNNER),
        (EnvRunnerGroup, GROUP),
        (PPOTorchLearner, LEARNER),
        (TorchRLModule, MODULE),
    ],
)
def test_every_private_name_that_is_relied_on_exists(part, names):
    assert [name for name in names if not defined(part, name)] == []


@pytest.mark.parametrize(
    ("module", "part", "names"),
    [(env_runner, SingleAgentEnvRunner, ENV_RUNNER), (ppo_learner, PPOTorchLearner, LEARNER)],
)
def test_no_private_name_is_used_that_is_not_listed(module, part, names):
    source = inspect.getsource(module)
    used = set(re.findall(r"(?:self\.|def )(_[a-z]\w*)", source))
    assert {name for name in used if defined(part, name)} <= set(names)
    assert set(re.findall(r"module\.(_[a-z]\w*)\(", source)) <= set(MODULE)


def test_a_missing_name_is_refused_with_the_tested_version():
    require("text", ["upper"])
    with pytest.raises(RuntimeError, match=rf"str lacks _gone; tested with Ray {re.escape(TESTED_RAY)}"):
        require("text", ["upper", "_gone"])


def test_the_installed_version_is_the_tested_one():
    assert ray.__version__ == TESTED_RAY
