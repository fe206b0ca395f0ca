"""A wrapper that adds the vehicle's measured velocity and last command to the observation."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from envs.corridor import CorridorEnv, Info

Observation = dict[str, Any]


class StateObservation(gymnasium.Wrapper):
    """Wrapper with a Dict observation: "events", the observation of the wrapped environment, and "state".

    The state is float32 (2 + C,): measured velocity to the right and ahead [m/s], with noise of
    `EnvConfig.velocity_noise_mps`, and the C numbers of the last command, 0 at the start. For a Discrete
    action space the command is the action's number, -1 at the start.
    """

    def __init__(self, env: gymnasium.Env) -> None:
        """Wrap a `CorridorEnv`."""
        super().__init__(env)
        self._last: np.ndarray = self._no_command()
        state = spaces.Box(-np.inf, np.inf, (2 + self._last.size,), np.float32)
        self.observation_space = spaces.Dict({"events": env.observation_space, "state": state})

    @property
    def corridor(self) -> CorridorEnv:
        """Return the wrapped environment."""
        corridor = self.env.unwrapped
        assert isinstance(corridor, CorridorEnv)  # noqa: S101  for the type checker
        return corridor

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, Info]:
        """Start an episode."""
        events, info = self.env.reset(seed=seed, options=options)
        self._last = self._no_command()
        return self._shown(events), info

    def step(self, action: Any) -> tuple[Observation, Any, bool, bool, Any]:
        """Simulate one control step."""
        events, reward, terminated, truncated, info = self.env.step(action)
        self._last = np.atleast_1d(np.asarray(action, np.float32))
        return self._shown(events), reward, terminated, truncated, info

    def _no_command(self) -> np.ndarray:
        space = self.env.action_space
        return (
            -np.ones(1, np.float32)
            if isinstance(space, spaces.Discrete)
            else np.zeros(space.shape, np.float32)
        )

    def _shown(self, events: Any) -> Observation:
        state = np.concatenate([self.corridor.measured_velocity_mps, self._last])
        return {"events": events, "state": state.astype(np.float32)}
