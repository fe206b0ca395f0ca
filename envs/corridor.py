"""The corridor as a Gymnasium environment, single and vectorised (appendix D.1).

The vehicle moves at constant speed, one of three directions a step, while its camera keeps
looking along +y. What ends a step early is decided along the way of the step: the vehicle
stops where it first touches an obstacle or a wall, or at the goal line, whichever comes
first; both at the same place is a collision, and so is a start in contact.

Time and way are counted in whole steps, so neither drifts. Each episode draws from streams
of its own, made of (split, seed, episode): a corridor of one split never occurs in another.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, TypedDict

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from envs import kinematics
from envs.config import EnvConfig
from envs.observations import observation_space, observe, picture
from envs.scene import make_scene
from envs.sensor import Sensor


class Info(TypedDict):
    """What `CorridorEnv` tells beside the observation.

    Gymnasium and stable-baselines3 add keys of their own, such as "episode", which none here may have.

    Attributes:
        episode_seed: Seed of the series of episodes.
        episode_number: Number of the episode in its series, from 0.
        x_m, y_m: Position of the vehicle [m].
        distance_m: Progress along y since the start [m].
        success, collision: What ended the episode; at most one of them.
        num_events: Events of the last step, faults included.
        dropped_events: Events of the last step lost to the camera's cap or the window's capacity.
        t_us: Simulated time [us].
    """

    episode_seed: int | None
    episode_number: int
    x_m: float
    y_m: float
    distance_m: float
    success: bool
    collision: bool
    num_events: int
    dropped_events: int
    t_us: int


class CorridorEnv(gymnasium.Env):
    """One episode from y = 0 to the goal line; `observation` is as `envs.observations` says.

    Actions: 0 forward, 1 left 45 degrees, 2 right 45 degrees. Reward (appendix D.1.1):
    metres of progress along y, +100 at the goal line, -100 at a collision; both terminate.
    Past `time_limit_s` the episode is truncated.

    Attributes:
        config: The settings, `EnvConfig`.
        scene: The corridor of this episode.
        events: EVENT array of the last step, faults included; empty with observation "luminance" or "none".
        luminance: float32 (H, W), the last render; 0 with "none".
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 200}  # noqa: RUF012 - Gymnasium's name

    def __init__(self, config: EnvConfig | None = None, render_mode: Any = None, **fields: Any) -> None:
        """Make the environment from a config (default `EnvConfig()`) and fields of it to replace.

        Raises:
            ValueError: A setting or the render mode is refused.
        """
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f'render_mode must be None or "rgb_array"; got {render_mode!r}.')
        self.config = dataclasses.replace(config or EnvConfig(), **fields)
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": self.config.control_hz}
        self.action_space = spaces.Discrete(kinematics.NUM_ACTIONS)
        self.observation_space = observation_space(self.config)
        self._sensor = Sensor(self.config)
        self._seed: int | None = None
        self._episode = 0
        self._done = True

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, object] | None = None
    ) -> tuple[np.ndarray, Info]:
        """Start an episode; its first render makes no events.

        Args:
            seed: Starts a series of episodes, of which this is number 0. Without it, the
                next episode of the series starts.
            options: {"episode_number": number} starts that episode of the series.

        Raises:
            ValueError: An unknown option, or an episode that is no integer >= 0.
        """
        super().reset(seed=seed)
        if seed is None and self._seed is None:
            seed = int(self.np_random.integers(kinematics.SEED_STRIDE))
        self._episode = kinematics.choose_episode(0 if seed is not None else self._episode + 1, options or {})
        self._seed = self._seed if seed is None else int(seed)
        split = self.config.split
        scene_rng, spawn_rng, faults_rng = kinematics.random_streams(split, self._seed or 0, self._episode)
        config = self.config
        vehicle = config.vehicle_radius_m, config.camera_height_m
        self.scene = make_scene(config.scene, scene_rng, *vehicle, **config.layout)
        self._spawn_x = float(spawn_rng.uniform(*self.scene.spawn_range_m))
        self._moves = [0] * kinematics.NUM_ACTIONS
        self._place = (self._spawn_x, 0.0)
        self._sensor.reset(self.scene, self._place, faults_rng)
        self._done = False
        observation, lost = self._observe(0, kinematics.clock_us(1, self.config.control_hz))
        return observation, self._info(lost)

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, Info]:
        """Simulate one control step.

        Raises:
            ResetNeeded: The episode is over, or has not begun.
            ValueError: The action is not in the action space; or a number became NaN or
                infinite, with the episode, step and seed named.
        """
        if self._done:
            raise ResetNeeded("The episode is over or has not begun; call reset() before step().")
        if not self.action_space.contains(action):
            raise ValueError(
                f"action must be an integer in [0, {kinematics.NUM_ACTIONS - 1}]; got {action!r}."
            )
        start_us = self._sensor.t_us
        self._done = True  # an error below leaves the episode unusable
        self._moves[int(action)] += 1
        try:
            outcome = self._move()
            observation, lost = self._observe(start_us, self._sensor.t_us)
        except ValueError as error:
            where = f"episode {self._episode}, step {sum(self._moves)}, seed {self._seed}"
            raise ValueError(f"{where}: {error}") from error
        terminated = outcome.success or outcome.collision
        truncated = not terminated and self._sensor.t_us >= self.config.time_limit_s * 1e6
        self._done = terminated or truncated
        return observation, outcome.reward, terminated, truncated, self._info(lost, outcome)

    def render(self) -> Any:
        """Luminance beside the events of the last step: uint8 (4 H, 8 W, 3); None without a mode."""
        return None if self.render_mode is None else picture(self.events, self.luminance)

    def close(self) -> None:
        """Free the renderer."""
        self._sensor.close()

    def camera_pose(self) -> tuple[float, float, float, float]:
        """Where the camera is: x, y, z [m] and yaw [rad]."""
        return (*self._place, self.config.camera_height_m, 0.0)

    def _move(self) -> kinematics.Outcome:
        """Move and sense."""
        config, start = self.config, self._place
        planned = kinematics.planned_position(self._spawn_x, self._moves, config)
        vehicle = config.vehicle_radius_m, config.camera_height_m
        outcome = kinematics.advance(self.scene, start, planned, *vehicle)
        self._sensor.step(start, outcome, kinematics.clock_us(sum(self._moves), config.control_hz))
        self._place = outcome.end
        return outcome

    def _observe(self, start_us: int, end_us: int) -> tuple[np.ndarray, int]:
        """Observation, and the events lost to the camera's cap or the window's capacity."""
        self.events, self.luminance = self._sensor.events, self._sensor.luminance
        observation, excess = observe(self.config, self.events, self.luminance, start_us, end_us)
        return observation, self._sensor.dropped + excess

    def _info(self, lost: int, outcome: kinematics.Outcome | None = None) -> Info:
        return {
            "episode_seed": self._seed,
            "episode_number": self._episode,
            "x_m": self._place[0],
            "y_m": self._place[1],
            "distance_m": self._place[1],
            "success": outcome is not None and outcome.success,
            "collision": outcome is not None and outcome.collision,
            "num_events": self.events.size,
            "dropped_events": lost,
            "t_us": self._sensor.t_us,
        }


class CorridorVectorEnv(VectorEnv):
    """Several episodes at once, each with the bytes that `CorridorEnv` gives for the same seed.

    An episode that is over is reset by the next step (AutoresetMode.NEXT_STEP), whose
    action is ignored and whose reward is 0. All returned arrays are fresh.
    """

    metadata = {**CorridorEnv.metadata, "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        config: EnvConfig | Sequence[EnvConfig] | None = None,
        render_mode: Any = None,
        **fields: Any,
    ) -> None:
        """Make `num_envs` environments; the arguments not named here are those of `CorridorEnv`.

        Args:
            num_envs: Environments.
            config: One for all, or several, which the environments take in turn.
            render_mode: See `CorridorEnv`.
            fields: To replace in every config.

        Raises:
            ValueError: A setting is refused, `num_envs` is below 1, or configs have different observations.
        """
        self.envs: list[CorridorEnv] = []  # first, because Gymnasium closes what failed to start
        if num_envs < 1:
            raise ValueError(f"num_envs must be >= 1; got {num_envs}.")
        self.num_envs, self.render_mode = num_envs, render_mode
        configs = config if isinstance(config, Sequence) else [config]
        self.envs = [CorridorEnv(configs[k % len(configs)], render_mode, **fields) for k in range(num_envs)]
        spaces_seen = {repr(env.observation_space) for env in self.envs}
        if len(spaces_seen) > 1:
            raise ValueError(f"configs must have one observation space; got {sorted(spaces_seen)}.")
        self.metadata = {**self.metadata, "render_fps": self.envs[0].metadata["render_fps"]}
        self.single_observation_space = self.envs[0].observation_space
        self.single_action_space = self.envs[0].action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._over = np.zeros(num_envs, bool)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: Mapping[str, object] | None = None
    ) -> tuple[Any, dict[str, np.ndarray]]:
        """Reset all environments.

        Args:
            seed: One per environment, or one number, see `envs.kinematics.spread_seeds`.
            options: As for `CorridorEnv.reset`, for all.

        Raises:
            ValueError: The number of seeds is not that of environments.
        """
        seeds = kinematics.spread_seeds(seed, self.num_envs)
        self._over[:] = False
        results = [env.reset(seed=s, options=options) for env, s in zip(self.envs, seeds, strict=True)]
        return self._batch([r[0] for r in results]), _stack_infos([r[1] for r in results])

    def step(
        self, actions: np.ndarray
    ) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, np.ndarray]]:
        """Step all environments, or reset those that were over.

        Raises:
            ValueError: The number of actions is not that of environments, or one is refused.
        """
        if len(actions) != self.num_envs:
            raise ValueError(f"actions must number {self.num_envs}; got {len(actions)}.")
        results = []
        for env, action, over in zip(self.envs, actions, self._over, strict=True):
            if over:
                observation, info = env.reset()
                results.append((observation, 0.0, False, False, info))
            else:
                results.append(env.step(action))
        observations, rewards, terminated, truncated, infos = zip(*results, strict=True)
        ends = np.array(terminated), np.array(truncated)
        self._over = ends[0] | ends[1]
        return self._batch(observations), np.array(rewards), *ends, _stack_infos(infos)

    def replay(
        self, episodes: Sequence[tuple[int, int, Sequence[int]]]
    ) -> tuple[Any, np.ndarray, dict[str, np.ndarray]]:
        """Lead each environment to where its actions led before; what follows has the same bytes too.

        Args:
            episodes: Of each environment the seed, the number of its episode and the actions since its start.

        Returns:
            The last observations, whether each episode is over, and infos.

        Raises:
            ValueError: An episode ends before its last action: another simulation was given these.
        """
        results, self._over[:] = [], False
        for row, (env, (seed, number, actions)) in enumerate(zip(self.envs, episodes, strict=True)):
            observation, info = env.reset(seed=seed, options={"episode_number": number})
            for step, action in enumerate(actions):
                if self._over[row]:
                    where = f"environment {row}, seed {seed}, episode {number}"
                    raise ValueError(f"actions must not outlast the episode; {where} ended at step {step}.")
                observation, _, terminated, truncated, info = env.step(int(action))
                self._over[row] = terminated or truncated
            results.append((observation, info))
        observations, infos = zip(*results, strict=True)
        return self._batch(observations), self._over.copy(), _stack_infos(infos)

    def render(self) -> Any:
        """One picture per environment, as `CorridorEnv.render`."""
        return tuple(env.render() for env in self.envs)

    def close_extras(self, **kwargs: Any) -> None:
        """Free the renderers."""
        for env in self.envs:
            env.close()

    def _batch(self, observations: Any) -> Any:
        """Observations as one fresh array; event sequences differ in length and stay a tuple."""
        if isinstance(self.single_observation_space, spaces.Sequence):
            return tuple(observations)
        return np.stack(observations)


def _stack_infos(infos: Any) -> dict[str, np.ndarray]:
    """Infos of all environments as Gymnasium's dictionary of arrays, each with its mask."""
    stacked = {key: np.array([info[key] for info in infos]) for key in infos[0]}
    mask = np.ones(len(infos), bool)
    return stacked | {f"_{key}": mask for key in infos[0]}


# Gymnasium imports what stands before the colon: make("envs.corridor:evade/Corridor-v0").
if "evade/Corridor-v0" not in gymnasium.registry:
    gymnasium.register(
        id="evade/Corridor-v0",
        entry_point="envs.corridor:CorridorEnv",
        vector_entry_point="envs.corridor:CorridorVectorEnv",
    )
