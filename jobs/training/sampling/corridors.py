"""The environments of a training."""

import dataclasses
from collections.abc import Mapping
from typing import Any, cast

from envs.config import Observation
from envs.corridor import CorridorVectorEnv
from jobs.config.conditions import episode_draw
from jobs.config.config import Config
from models.kinds import KINDS


class TrainingCorridors(CorridorVectorEnv):
    """The environments of one env runner; each episode draws one of the training's conditions.

    A class instead of a registered name, so that `Algorithm.from_checkpoint` finds it in any process.
    """

    def __init__(self, context: Mapping[str, Any]) -> None:
        """Create the environments from RLlib's context: `corridor_settings` and `num_envs`."""
        draw = episode_draw(context.get("conditions", [{}]))
        super().__init__(context["num_envs"], context["config"], draw=draw)


def corridor_settings(config: Config) -> dict[str, object]:
    """Return the `env_config` of `TrainingCorridors`.

    Tune resumes a training only with the keys and types of values with which it started, so a setting
    of later versions is included only if it is used.
    """
    observation = KINDS[config.model.name].observation
    settings: dict[str, object] = {
        "config": dataclasses.replace(config.env, split="train", observation=cast(Observation, observation))
    }
    if config.train.conditions != [{}]:
        settings["conditions"] = config.train.conditions
    return settings
