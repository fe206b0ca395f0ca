"""The interface of a training algorithm; `jobs.config.algorithms.ALGORITHMS` lists the algorithms."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from torch import nn

from core.places import resolve
from jobs.config.algorithms import ALGORITHMS
from jobs.config.config import Config
from models.kinds import PolicySpec


class Algorithm(NamedTuple):
    """The functions and metric names with which RLlib trains a policy.

    Attributes:
        build: (config, encoder file or None, file of initial networks or None) -> RLlib's `AlgorithmConfig`.
        trainable: config -> the class that Tune runs.
        networks: (trained RLModule, spec) -> the policy's networks, as in `models.policy.networks.assemble`.
        losses: Name in the tracker -> the learner's name, for metrics of an update that must be finite.
        figures: Like `losses`, for metrics that may be NaN.
    """

    build: Callable[[Config, Path | None, Path | None], Any]
    trainable: Callable[[Config], type]
    networks: Callable[[Any, PolicySpec], nn.ModuleDict]
    losses: Mapping[str, str]
    figures: Mapping[str, str]


def algorithm_of(config: Config) -> Algorithm:
    """Return the algorithm that a configuration names."""
    algorithm: Algorithm = resolve(ALGORITHMS[config.algo.name].algorithm)
    return algorithm


def build_algorithm(config: Config, encoder_path: Path | None = None, init: Path | None = None) -> Any:
    """Return RLlib's configuration of an experiment's algorithm; arguments as for `Algorithm.build`."""
    return algorithm_of(config).build(config, encoder_path, init)
