"""The private names of RLlib on which this package relies; other versions may lack some of them.

`sampling.env_runner` and `ppo.learner` replace RLlib's loops over single steps and minibatches, and
`sampling.rounds` its loop over env runners. RLlib has no public interface for them. A test compares these
lists with what the three files use.
"""

from collections.abc import Sequence

import ray

TESTED_RAY = "2.60.0"
# Of a SingleAgentEnvRunner.
ENV_RUNNER = (
    "_callbacks",
    "_increase_sampled_metrics",
    "_log_env_steps",
    "_metrics_num_env_steps_sampled",
    "_needs_initial_reset",
    "_sample",
    "_seed",
    "_weights_seq_no",
)
# Of an EnvRunnerGroup.
GROUP = ("_worker_manager",)
# Of a PPOTorchLearner.
LEARNER = ("_log_steps_trained_metrics", "_module", "_weights_seq_no")
# Of a TorchRLModule.
MODULE = ("_forward", "_forward_train")


def require(part: object, names: Sequence[str]) -> None:
    """Check that a part of RLlib has the required names.

    Raises:
        RuntimeError: A name is missing; the message states which version of Ray was tested.
    """
    missing = [name for name in names if not hasattr(part, name)]
    if missing:
        raise RuntimeError(
            f"Ray {ray.__version__}: RLlib's {type(part).__name__} lacks {', '.join(missing)}; "
            f"tested with Ray {TESTED_RAY}: pip install 'ray[rllib,tune]=={TESTED_RAY}'"
        )
