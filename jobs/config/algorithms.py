"""The table of training algorithms, and the settings of each.

To add an algorithm of RLlib, write `conf/algo/NAME.yaml` with `name: rllib`. To add your own, write a folder
`jobs/training/NAME` with a `jobs.training.algorithms.Algorithm`, a row here, and its YAML file. A row names
its algorithm as "module:attribute", so that a configuration is checked without importing Ray.
"""

import dataclasses
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import pydantic
from pydantic import BeforeValidator, Field
from pydantic.dataclasses import dataclass

from envs.config import STRICT, Fraction, Positive
from jobs.config.schema import Count, NonNegative
from models.kinds import checked

Runners = Annotated[int, Field(ge=0, le=10_000)]


@dataclass(frozen=True, config=STRICT)
class ImitationConfig:
    """Imitation of a planner that knows the geometry (DAgger: Ross et al. 2011).

    Attributes:
        temperature: Labels are softmax(-cost / temperature); costs as in `envs.scene.planning`.
        guided_batches: Number of first batches in which the teacher also acts: in all steps of the first,
            then in half as many with each further batch; 0: none.
        fit_steps: Gradient steps after each batch, on steps of all batches.
        final_steps: Gradient steps after the last batch. They start from the initial weights, with a step
            size that falls to 0.
        keep_mb: Memory for stored steps [MB]; if it is full, a random sample of all steps is stored.
    """

    temperature: Positive
    guided_batches: Annotated[int, Field(ge=0)]
    fit_steps: Count
    final_steps: Count
    keep_mb: Positive


def _imitation(values: object) -> object:
    """Convert a mapping to the settings, because strict pydantic accepts no mapping for a dataclass."""
    return checked(ImitationConfig, dict(values)) if isinstance(values, Mapping) else values


@dataclass(frozen=True, config=STRICT)
class AlgoConfig:
    """PPO, each word as RLlib spells it (appendix D.1.2).

    Attributes:
        critic: Input of the value network: the policy's input (`observation`), or in addition the cost of the
            cheapest path to the goal line, from a teacher that knows the geometry (`teacher`).
        shaping: Factor of the potential -shaping * log(1 + that cost), which shapes the rewards in training
            only; 0: no shaping.
        imitation: Learn from a teacher instead; then only lr, sizes, grad_clip, mirrored and teacher_sight_m
            of the other settings count.
        mirrored: Learn each step a second time with left and right exchanged (`models.policy.mirror`).
        teacher_sight_m: How far ahead the teacher plans [m], for imitation, critic and shaping; None: to the
            goal line.
    """

    lr: Positive
    lr_schedule: Literal["constant", "linear"]
    gamma: Fraction
    lambda_: Fraction
    clip_param: Positive
    num_epochs: Count
    minibatch_size: Count
    train_batch_size_per_learner: Count
    vf_loss_coeff: NonNegative
    entropy_coeff: NonNegative
    grad_clip: Positive
    reward_scale: Positive
    num_envs_per_env_runner: Count
    num_env_runners: Runners
    critic: Literal["observation", "teacher"] = "observation"
    shaping: NonNegative = 0.0
    imitation: Annotated[ImitationConfig | None, BeforeValidator(_imitation)] = None
    mirrored: bool = False
    teacher_sight_m: Positive | None = None

    @pydantic.model_validator(mode="after")
    def _minibatch_fits(self) -> "AlgoConfig":
        if self.minibatch_size > self.train_batch_size_per_learner:
            raise ValueError("minibatch_size must not exceed train_batch_size_per_learner")
        if self.mirrored and self.imitation is None:
            rule = "must be false without algo.imitation, because PPO learns only from what it did"
            raise ValueError(f"mirrored {rule}, got true")
        taught = self.imitation is not None or self.critic == "teacher" or self.shaping > 0.0
        if self.teacher_sight_m is not None and not taught:
            rule = "must be null without a teacher (algo=imitation, algo.critic=teacher, algo.shaping)"
            raise ValueError(f"teacher_sight_m {rule}, got {self.teacher_sight_m}")
        return self

    @property
    def name(self) -> str:
        """Return the algorithm's key in `ALGORITHMS`."""
        return "ppo" if self.imitation is None else "imitation"


@dataclass(frozen=True, config=STRICT)
class RLlibConfig:
    """An algorithm of RLlib, configured by the user.

    Attributes:
        name: "rllib", the key in `ALGORITHMS`.
        algorithm: RLlib's name, such as DQN, SAC, APPO or IMPALA.
        settings: Arguments of `AlgorithmConfig.training` of that algorithm.
        lr_schedule: "constant", or "linear": settings.lr falls to 0 at the last environment step.
        reward_scale: Factor of the rewards that it learns from.
        num_env_runners: Processes that roll out episodes; 0: the learner's process.
        num_envs_per_env_runner: Environments that each process steps together.
    """

    imitation: ClassVar[None] = None

    name: Literal["rllib"]
    algorithm: Annotated[str, Field(pattern=r"^[A-Za-z0-9]+$")]
    settings: dict[str, Any]
    lr_schedule: Literal["constant", "linear"]
    reward_scale: Positive
    num_env_runners: Runners
    num_envs_per_env_runner: Count


Algo = AlgoConfig | RLlibConfig


class Row(NamedTuple):
    """An algorithm.

    Attributes:
        settings: The dataclass of its settings.
        algorithm: Its `jobs.training.algorithms.Algorithm`, as "module:attribute".
    """

    settings: type
    algorithm: str


ALGORITHMS = {
    "ppo": Row(AlgoConfig, "jobs.training.ppo.train:PPO"),
    "imitation": Row(AlgoConfig, "jobs.training.imitation.train:IMITATION"),
    "rllib": Row(RLlibConfig, "jobs.training.rllib.train:RLLIB"),
}


def read_algo(**values: object) -> Algo:
    """Check and return the settings of an algorithm, which is PPO if there is no `name`.

    Raises:
        pydantic.ValidationError: A setting is missing, unknown to this algorithm, or has a wrong value.
        ValueError: There is no algorithm of this name.
    """
    name = values.get("name", "ppo")
    if name not in ALGORITHMS:
        raise ValueError(f"name must be one of {', '.join(ALGORITHMS)}, got {name!r}")
    settings: Any = ALGORITHMS[str(name)].settings
    return settings(**values)


def algo_keys() -> list[str]:
    """Return the names of the settings of all algorithms."""
    fields = (field for row in ALGORITHMS.values() for field in dataclasses.fields(row.settings))
    return list(dict.fromkeys(field.name for field in fields))
