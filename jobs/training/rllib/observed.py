"""The corridor environment with the input of a policy's networks as its observation: one flat vector."""

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from envs.corridor import CorridorEnv
from jobs.config.conditions import episode_draw
from models.encoder.frozen import encoder_of
from models.encoder.weights import load_encoder
from models.kinds import PolicySpec
from models.policy.features import feature_of
from models.policy.memory import kept_shape, remember, windows_us


class ObservedCorridor(gymnasium.Env):
    """`CorridorEnv` whose observations pass through the features and the memory of a policy.

    RLlib's default networks read float32 vectors, so any algorithm can train a policy of dense layers.
    """

    def __init__(self, context: Mapping[str, Any]) -> None:
        """Create the environment.

        Args:
            context: `config` and `conditions` as for `TrainingCorridors`; `spec`, the policy; `encoder_file`,
                None for a policy without a frozen encoder; `reward_scale`.
        """
        self._env = CorridorEnv(context["config"], draw=episode_draw(context.get("conditions", [{}])))
        self._spec: PolicySpec = context["spec"]
        self._reward_scale: float = context["reward_scale"]
        file = context["encoder_file"]
        self._encoder = None if file is None else encoder_of(load_encoder(file)[0])
        self._shape = kept_shape(self._spec)
        self.observation_space = spaces.Box(-np.inf, np.inf, (int(np.prod(self._shape)),), np.float32)
        self.action_space = self._env.action_space
        self._stack = np.zeros((1, *self._shape), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, Any]:
        """Start an episode, as `CorridorEnv.reset` does."""
        shown, info = self._env.reset(seed=seed, options=options)
        return self._seen(shown, taken=None), info

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, Any]:
        """Simulate one control step, as `CorridorEnv.step` does."""
        shown, reward, terminated, truncated, info = self._env.step(action)
        return self._seen(shown, taken=action), self._reward_scale * reward, terminated, truncated, info

    def close(self) -> None:
        """Free the renderer."""
        self._env.close()

    def _seen(self, shown: np.ndarray, taken: Any) -> np.ndarray:
        """Return the networks' input as a flat vector; `taken` is this step's action, None at the start."""
        windows = shown[None]
        features = feature_of(self._spec).from_observations(windows, self._spec, self._encoder)
        began, last = np.array([taken is None]), np.array([taken or 0])
        duration_us, velocity = windows_us(windows, self._spec), self._env.measured_velocity_mps[None]
        self._stack = remember(self._stack, features, began, self._spec, duration_us, last, velocity)
        return self._stack.reshape(-1)
