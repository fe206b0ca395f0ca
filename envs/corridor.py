"""The corridor as a Gymnasium environment, single and vectorised (appendix D.1).

The vehicle moves at constant speed, in one of three directions per step, while its camera always
points along +y. `EnvConfig.vehicle` selects other vehicles (`envs.vehicles.dynamics`). Contact is
tested along the way of the step: the vehicle stops at its first contact with an obstacle or a wall, or
at the goal line, whichever comes first. Both at the same place is a collision, and so is a start
in contact.

Time and way are counted in whole steps, so neither drifts. Each episode draws from its own random
streams, seeded by (split, seed, episode): a corridor of one split never occurs in another.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypedDict, cast

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from envs import kinematics
from envs.config import EnvConfig
from envs.events.windows import pack_windows
from envs.observations import observation_space, observe, picture
from envs.scene import MovingBody, make_scene
from envs.sensor import Sensor
from envs.vehicles import StepError, Vehicles
from envs.vehicles.dynamics import make_dynamics, number_type, planned_config, wrong_actions

VELOCITY_STREAM = 0x57A7E  # part of the seed of the noise on measured velocity
Draw = Callable[[EnvConfig, np.random.Generator], EnvConfig]  # draws the settings of an episode


class Info(TypedDict):
    """The `info` that `CorridorEnv` returns with each observation.

    Gymnasium and stable-baselines3 add their own keys, such as "episode"; no key here may have such a name.

    Attributes:
        episode_seed: Seed of the series of episodes.
        episode_number: Number of the episode in its series, from 0.
        x_m, y_m: Position of the vehicle [m].
        distance_m: Progress along y since the start [m].
        success, collision: Whether the goal line or a contact ended the episode; at most one is True.
        num_events: Number of events of the last step, faults included.
        dropped_events: Number of events of the last step lost to the camera's cap, its readout or the
            window's capacity.
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
    """One episode from y = 0 to the goal line, with an observation of `envs.observations`.

    Actions: 0 forward, 1 left 45 degrees, 2 right 45 degrees. Reward (appendix D.1.1):
    metres of progress along y, +100 at the goal line, -100 at a collision; both terminate.
    Past `time_limit_s` the episode is truncated.

    Attributes:
        config: The settings of this episode, `EnvConfig`.
        dynamics: The vehicle of this episode, `envs.vehicles.dynamics.Dynamics`.
        scene: The corridor of this episode.
        series: Seed of the series of episodes, and the number of this one in it.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 200}  # noqa: RUF012 - Gymnasium's name

    def __init__(
        self,
        config: EnvConfig | Mapping[str, Any] | None = None,
        render_mode: Any = None,
        draw: Draw | None = None,
        **fields: Any,
    ) -> None:
        """Create the environment.

        Args:
            config: The settings, or a mapping of fields such as RLlib's `env_config`; None: `EnvConfig()`.
            render_mode: "rgb_array" for pictures, or None.
            draw: Draws the settings of each episode from `config` and a generator of the episode; the
                observation space must stay the same.
            fields: Fields to replace in `config`.

        Raises:
            TypeError: A field is unknown; clients that probe for an argument expect this exception.
            ValueError: A setting or the render mode is invalid.
        """
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f'render_mode must be None or "rgb_array"; got {render_mode!r}.')
        for name in fields.keys() - {field.name for field in dataclasses.fields(EnvConfig)}:
            raise TypeError(f"{type(self).__name__}() got an unexpected keyword argument {name!r}")
        if isinstance(config, Mapping):
            fields, config = {**config, **fields}, None
        self.config = self._nominal = dataclasses.replace(config or EnvConfig(), **fields)
        self._draw = draw
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": self.config.control_hz}
        self.dynamics = make_dynamics(self.config)
        self.action_space = self.dynamics.action_space
        self.observation_space = observation_space(self.config)
        self._sensor = Sensor(self.config, planned_config(self.config, self.dynamics))
        self.series: tuple[int | None, int] = None, 0
        self._vehicles, self._row = Vehicles(1), 0
        self._actions: list[Any] = []  # of this episode

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for copies and pickles: the settings, the episode and its actions."""
        arguments = {"config": self._nominal, "render_mode": self.render_mode, "draw": self._draw}
        set_later = {"action_space", "observation_space", "spec", "_np_random", "_np_random_seed"}
        return {
            "arguments": arguments,
            "attributes": {name: getattr(self, name) for name in set_later},
            "series": self.series,
            "actions": list(self._actions),
            "over": bool(self._vehicles.rows["over"][self._row]),
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Create the environment again and repeat the episode's actions, which gives the same bytes."""
        self.__init__(**state["arguments"])  # type: ignore[misc]
        self.restore(state)

    def restore(self, state: dict[str, Any]) -> None:
        """Repeat the episode of a state that `__getstate__` returned for the same settings."""
        seed, number = state["series"]
        if seed is not None:
            self.begin(seed, {"episode_number": number})
            for action in state["actions"]:
                self.step(action)
        self._vehicles.rows["over"][self._row] = state["over"]
        for name, value in state["attributes"].items():
            setattr(self, name, value)

    def join(self, vehicles: Vehicles, row: int) -> None:
        """Share `vehicles` with other environments; this one is row `row` from the next reset."""
        self._vehicles, self._row = vehicles, row

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, object] | None = None
    ) -> tuple[np.ndarray, Info]:
        """Start an episode; its first render gives no events.

        Args:
            seed: Seed of a new series of episodes, of which this is number 0. None: start the
                next episode of the current series.
            options: {"episode_number": number} starts that episode of the series.

        Raises:
            ValueError: An option is unknown, or the episode number is not an integer >= 0.
        """
        self.begin(seed, options)
        return self.observe(), self.info()

    def begin(self, seed: int | None, options: Mapping[str, object] | None) -> None:
        """Start an episode like `reset`, but do not compute the observation."""
        super().reset(seed=seed)
        if seed is None and self.series[0] is None:
            seed = int(self.np_random.integers(kinematics.SEED_STRIDE))
        number = kinematics.choose_episode(0 if seed is not None else self.series[1] + 1, options or {})
        self.series = self.series[0] if seed is None else int(seed), number
        streams = kinematics.random_streams(self._nominal.split, self.series[0] or 0, number)
        scene_rng, spawn_rng, faults_rng, condition_rng = streams
        if self._draw is not None:
            self._set_config(self._draw(self._nominal, condition_rng))
        config = self.config
        vehicle = config.vehicle_radius_m, config.camera_height_m
        self.scene = make_scene(config.scene, scene_rng, *vehicle, **config.layout)
        spawn = float(spawn_rng.uniform(*self.scene.spawn_range_m)), 0.0
        self._sensor.reset(self.scene, spawn, faults_rng)
        self._actions = []
        self._vehicles.start(self._row, config, self.scene, self._sensor, spawn, self.dynamics)

    def _set_config(self, config: EnvConfig) -> None:
        """Switch to the settings drawn for the next episode."""
        if config != self.config:
            self._sensor.close()
            self.config, self.dynamics = config, make_dynamics(config)
            self._sensor = Sensor(config, planned_config(config, self.dynamics))

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, Info]:
        """Simulate one control step.

        Raises:
            ResetNeeded: The episode is over or has not begun.
            ValueError: The action is not in the action space; or a number became NaN or
                infinite, and the message names the episode, step and seed.
        """
        row = self._row
        if self._vehicles.rows["over"][row]:
            raise ResetNeeded("The episode is over or has not begun; call reset() before step().")
        space = self.action_space
        if not _is_action(space, action):
            raise ValueError(_bad_action(space, action))
        active = np.zeros(len(self._vehicles.rows), bool)
        active[row] = True
        actions = np.full((active.size, *(space.shape or ())), action, number_type(space))
        try:
            self._vehicles.step(actions, active)
        except StepError as error:
            raise ValueError(f"{self.name_step()}: {error}") from error
        self.remember(np.asarray(action))
        info, vehicle = self.info(), self._vehicles.rows[row]
        terminated = info["success"] or info["collision"]
        return self.observe(), float(vehicle["reward"]), terminated, bool(vehicle["truncated"]), info

    def remember(self, action: np.ndarray) -> None:
        """Store an action of this episode, for copies of the environment."""
        self._actions.append(action)

    def render(self) -> Any:
        """Draw luminance next to the events of the last step: uint8 (4 H, 8 W, 3); None without a mode."""
        return None if self.render_mode is None else picture(self.events, self.luminance)

    def close(self) -> None:
        """Free the renderer."""
        self._sensor.close()

    @property
    def events(self) -> np.ndarray:
        """EVENT array of the last step, faults included; empty with observation "luminance" or "none".

        In a vector environment it holds this environment's events in the vector's last step.
        """
        return self._vehicles.events_of(self._row)

    @property
    def seen_events(self) -> np.ndarray:
        """Return the events that pass the neighbour filter (`EnvConfig.filter_support`)."""
        return self._vehicles.seen_of(self._row)

    @property
    def true_events(self) -> np.ndarray:
        """Return the events of the last step before the faults of the sensor."""
        return self._vehicles.true_of(self._row)

    @property
    def luminance(self) -> np.ndarray:
        """Return the last render, float32 (H, W); the next step may change it; 0 with observation "none"."""
        return self._sensor.luminance

    def camera_pose(self) -> tuple[float, float, float, float]:
        """Return the pose of the camera: x, y, z [m] and yaw [rad]."""
        vehicle = self._vehicles.rows[self._row]
        return float(vehicle["x_m"]), float(vehicle["y_m"]), self.config.camera_height_m, 0.0

    @property
    def velocity_mps(self) -> tuple[float, float]:
        """Velocity to the right and ahead [m/s]; for a kinematic vehicle, the mean over its last step."""
        vehicle = self._vehicles.rows[self._row]
        if vehicle["parts"] or not vehicle["t_us"]:
            return float(vehicle["vx_mps"]), float(vehicle["vy_mps"])
        per_s = 1e6 / vehicle["window_us"]
        moved = vehicle["x_m"] - vehicle["start_x_m"], vehicle["y_m"] - vehicle["start_y_m"]
        return float(moved[0] * per_s), float(moved[1] * per_s)

    @property
    def measured_velocity_mps(self) -> np.ndarray:
        """Velocity with the noise of `EnvConfig.velocity_noise_mps`, float64 (2,) [m/s].

        The noise depends on the episode and the step alone.
        """
        velocity, noise_mps = np.array(self.velocity_mps), self.config.velocity_noise_mps
        if noise_mps:
            (seed, number), step = self.series, int(self._vehicles.rows["steps"][self._row])
            rng = np.random.default_rng([seed or 0, number, VELOCITY_STREAM, step])
            velocity += noise_mps * rng.standard_normal(2)
        return velocity

    def place_of_action(self) -> tuple[float, float]:
        """Return the place where the next decision takes effect if nothing is in the way: x, y [m].

        Without `action_delay_ms` it is the vehicle's place. With a delay, earlier decisions move the vehicle
        until then.
        """
        vehicle = self._vehicles.rows[self._row]
        if not vehicle["delay"]:
            return self.camera_pose()[:2]
        if vehicle["parts"]:
            x_m, y_m = self.state_of_action()[:2]
            return float(x_m), float(y_m)
        left, right = ((self._vehicles.decided(self._row) == action).sum() for action in (1, 2))
        forward = vehicle["delay"] - left - right
        moves = vehicle["forward"] + forward, vehicle["left"] + left, vehicle["right"] + right
        way = self.config.speed_mps, self.config.control_hz
        return kinematics.planned_position(vehicle["spawn_x_m"], moves, way)

    @property
    def moving(self) -> tuple[MovingBody, ...]:
        """Return the moving bodies on their current paths; each throw gives the ball a new path."""
        return self._vehicles.moving(self._row)

    def state_of_action(self) -> np.ndarray:
        """Return the state of a vehicle with a body when its next decision is taken, float64 (S,)."""
        return self._vehicles.state_of_action(self._row)

    def name_step(self) -> str:
        """Return episode, step and seed as text for an error."""
        vehicle, (seed, number) = self._vehicles.rows[self._row], self.series
        return f"episode {number}, step {vehicle['steps']}, seed {seed}"

    def observe(self) -> np.ndarray:
        """Return the observation of the last step."""
        if self.config.observation != "window":
            return observe(self.config, self.seen_events, self.luminance)
        row, events = self._vehicles.rows[self._row : self._row + 1], self.seen_events
        ends = np.array([0, events.size])
        return pack_windows(events, ends, row["start_us"], row["window_us"], self.config.window_capacity)[0]

    def info(self) -> Info:
        """Return the `Info` of the last step or reset."""
        infos = _infos_of([self], self._vehicles, np.array([self._row]))
        return cast(Info, {name: values.tolist()[0] for name, values in infos.items()})


class CorridorVectorEnv(VectorEnv):
    """Several episodes at once, each with the same bytes as a `CorridorEnv` with the same seed.

    `autoreset_mode` decides what happens to an episode that is over, as in Gymnasium's SyncVectorEnv. By
    default (NEXT_STEP) the next step resets the episode; its action is ignored and its reward is 0. All
    returned arrays are fresh.
    """

    metadata = {**CorridorEnv.metadata, "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        config: EnvConfig | Sequence[EnvConfig] | None = None,
        render_mode: Any = None,
        draw: Draw | None = None,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **fields: Any,
    ) -> None:
        """Create `num_envs` environments.

        Args:
            num_envs: Number of environments.
            config: One config for all environments, or several, which the environments take in turn.
            render_mode: See `CorridorEnv`.
            draw: See `CorridorEnv`.
            max_episode_steps: Steps after which an episode is truncated; None: only `time_limit_s` applies.
            autoreset_mode: NEXT_STEP; SAME_STEP, with infos "final_obs" and "final_info"; or DISABLED, in
                which case the caller resets by `options={"reset_mask": bool (num_envs,)}`.
            fields: Fields to replace in every config.

        Raises:
            ValueError: A setting is invalid, `num_envs` or `max_episode_steps` is below 1, or configs differ
                in observation or action space.
        """
        self.envs: list[CorridorEnv] = []  # set first: Gymnasium closes an object that failed to start
        if num_envs < 1:
            raise ValueError(f"num_envs must be >= 1; got {num_envs}.")
        self.num_envs, self.render_mode = num_envs, render_mode
        configs = config if isinstance(config, Sequence) else [config]
        self.envs = [
            CorridorEnv(configs[k % len(configs)], render_mode, draw, **fields) for k in range(num_envs)
        ]
        spaces_seen = {repr(env.observation_space) for env in self.envs}
        if len(spaces_seen) > 1:
            raise ValueError(f"configs must have one observation space; got {sorted(spaces_seen)}.")
        self.autoreset_mode, self._max_steps = AutoresetMode(autoreset_mode), max_episode_steps
        if max_episode_steps is not None and max_episode_steps < 1:
            raise ValueError(f"max_episode_steps must be >= 1 or None; got {max_episode_steps}.")
        render_fps = self.envs[0].metadata["render_fps"]
        self.metadata = {**self.metadata, "render_fps": render_fps, "autoreset_mode": self.autoreset_mode}
        self.single_observation_space = self.envs[0].observation_space
        self.single_action_space = self.envs[0].action_space
        if any(env.action_space != self.single_action_space for env in self.envs):
            raise ValueError(
                f"configs must have one action space; got {[env.action_space for env in self.envs]}."
            )
        self._vehicles = Vehicles(num_envs)
        for row, env in enumerate(self.envs):
            env.join(self._vehicles, row)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._over = np.zeros(num_envs, bool)
        self._number = number_type(self.single_action_space)
        self._actions_shape = (num_envs, *(self.single_action_space.shape or ()))

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: Mapping[str, object] | None = None
    ) -> tuple[Any, dict[str, np.ndarray]]:
        """Reset all environments.

        Args:
            seed: One seed per environment, or one number, see `envs.kinematics.spread_seeds`.
            options: As for `CorridorEnv.reset`, for all; "reset_mask", bool (num_envs,), resets only some.

        Raises:
            ValueError: The number of seeds differs from `num_envs`, or the mask has a wrong shape or dtype.
        """
        seeds = kinematics.spread_seeds(seed, self.num_envs)
        if options is not None and "reset_mask" in options:
            rest = {name: value for name, value in options.items() if name != "reset_mask"}
            return self._reset_some(np.asarray(options["reset_mask"]), seeds, rest)
        self._over[:] = False
        for env, own_seed in zip(self.envs, seeds, strict=True):
            env.begin(own_seed, options)
        self._vehicles.forget_events()
        return self._observations(np.arange(self.num_envs)), self.infos()

    def step(
        self, actions: np.ndarray
    ) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, np.ndarray]]:
        """Step all environments, or reset those that were over.

        Raises:
            ResetNeeded: No reset yet, or an environment failed in the previous step.
            ValueError: The number of actions differs from `num_envs`, or an action is invalid; or as
                for `CorridorEnv.step`.
        """
        over = self._over
        self._step_active(np.asarray(actions), ~over)
        for row in np.flatnonzero(over):
            self.envs[row].begin(None, None)
        observations, rewards, terminated, truncated, infos = self._results(np.arange(self.num_envs))
        ended = terminated | truncated
        if self.autoreset_mode is AutoresetMode.SAME_STEP and ended.any():
            observations, infos = self._reset_now(ended, observations, infos)
        self._over = ended & (self.autoreset_mode is AutoresetMode.NEXT_STEP)
        return observations, rewards, terminated, truncated, infos

    def _reset_now(self, ended: np.ndarray, last: Any, infos: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        """Reset the episodes that have ended; return observations, and infos with the final observations."""
        final, observations = np.full(self.num_envs, None, object), list(last)
        final_info = {name: values.copy() for name, values in infos.items() if not name.startswith("_")}
        for row in np.flatnonzero(ended):
            final[row] = last[row]
            observations[row], _ = self.envs[row].reset()
        extra = {"final_obs": final, "_final_obs": ended.copy(), "_final_info": ended.copy()}
        masks = {f"_{name}": ended.copy() for name in final_info}
        return self._batch(observations), self.infos() | extra | {"final_info": final_info | masks}

    def _reset_some(
        self, mask: np.ndarray, seeds: Sequence[int | None], options: Mapping[str, object]
    ) -> tuple[Any, dict[str, np.ndarray]]:
        """Reset the environments of a mask; the others keep their last observation."""
        if mask.shape != (self.num_envs,) or mask.dtype != bool:
            rule = f"reset_mask must be bool ({self.num_envs},)"
            raise ValueError(f"{rule}; got {mask.dtype} of shape {mask.shape}.")
        for row in np.flatnonzero(mask).tolist():
            self.envs[row].begin(seeds[row], options)
        self._over &= ~mask
        return self._batch([env.observe() for env in self.envs]), self.infos()

    @property
    def np_random_seed(self) -> tuple[int | None, ...]:
        """Seeds of the generators of all environments."""
        return tuple(env.np_random_seed for env in self.envs)

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call a method or read an attribute of every environment, like Gymnasium's SyncVectorEnv."""
        found = [env.get_wrapper_attr(name) for env in self.envs]
        return tuple(value(*args, **kwargs) if callable(value) else value for value in found)

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Return an attribute of every environment."""
        return self.call(name)

    def set_attr(self, name: str, values: Any) -> None:
        """Set an attribute of every environment to one value, or to one element each of a list or tuple."""
        own = values if isinstance(values, list | tuple) else [values] * self.num_envs
        for env, value in zip(self.envs, own, strict=True):
            env.set_wrapper_attr(name, value)

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for copies and pickles, see `CorridorEnv`."""
        states = [env.__getstate__() for env in self.envs]
        arguments = {"render_mode": self.render_mode, "draw": states[0]["arguments"]["draw"]}
        arguments |= {"autoreset_mode": self.autoreset_mode, "max_episode_steps": self._max_steps}
        configs = [state["arguments"]["config"] for state in states]
        attributes = {name: getattr(self, name) for name in ("action_space", "observation_space", "spec")}
        return {
            "arguments": {"num_envs": self.num_envs, "config": configs, **arguments},
            "states": states,
            "over": self._over.copy(),
            "attributes": attributes,
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Create the environments again and repeat their episodes."""
        self.__init__(**state["arguments"])  # type: ignore[misc]
        for env, own in zip(self.envs, state["states"], strict=True):
            env.restore(own)
        self._over = state["over"].copy()
        for name, value in state["attributes"].items():
            setattr(self, name, value)

    def step_some(
        self, actions: np.ndarray, some: np.ndarray
    ) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, np.ndarray]]:
        """Step some environments and leave the others unchanged; unlike `step`, reset nothing.

        Args:
            actions: (n,) integers, or (n, C) for a Box.
            some: Numbers of the environments, int (n,), ascending. All returned arrays have n rows.

        Raises:
            ResetNeeded: The episode of one of these environments is over or has not begun.
            ValueError: The number of actions is not n; or as for `step`.
        """
        own, active = np.asarray(actions), np.zeros(self.num_envs, bool)
        if own.shape[:1] != some.shape:
            raise ValueError(f"actions must number {len(some)}; got {own.size}.")
        taken = np.zeros((self.num_envs, *own.shape[1:]), own.dtype)
        active[some], taken[some] = True, own
        self._step_active(taken, active)
        return self._results(some)

    def _results(
        self, some: np.ndarray
    ) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, np.ndarray]]:
        """Return the results of `step` for some environments."""
        rows = self._vehicles.rows[some]
        terminated, truncated = rows["success"] | rows["collision"], rows["truncated"]
        if self._max_steps is not None:
            truncated = truncated | ~terminated & (rows["steps"] >= self._max_steps)
            self._vehicles.rows["over"][some] |= truncated
        return self._observations(some), rows["reward"], terminated, truncated, self._infos(some)

    def _step_active(self, taken: np.ndarray, active: np.ndarray) -> None:
        """Simulate one control step of the active environments."""
        rows, space = self._vehicles.rows, self.single_action_space
        if taken.shape != self._actions_shape:
            raise ValueError(f"actions must number {self.num_envs} of {space}; got shape {taken.shape}.")
        if (rows["over"] & active).any():
            raise ResetNeeded("An episode is over or has not begun; call reset() before step().")
        wrong = active & wrong_actions(space, taken)
        if wrong.any():
            raise ValueError(_bad_action(space, taken[wrong.argmax()]))
        try:
            self._vehicles.step(taken.astype(self._number), active)
        except StepError as error:
            raise ValueError(f"{self.envs[error.row].name_step()}: {error}") from error
        for row in np.flatnonzero(active):
            self.envs[row].remember(taken[row])

    def infos(self) -> dict[str, np.ndarray]:
        """Return the infos of all environments in Gymnasium's form, a dictionary of arrays and masks."""
        return self._infos(np.arange(self.num_envs))

    def _infos(self, some: np.ndarray) -> dict[str, np.ndarray]:
        infos = _infos_of([self.envs[row] for row in some], self._vehicles, some)
        return infos | dict.fromkeys([f"_{name}" for name in infos], np.ones(len(some), bool))

    def replay(
        self, episodes: Sequence[tuple[int, int, Sequence[Any]]]
    ) -> tuple[Any, np.ndarray, dict[str, np.ndarray]]:
        """Repeat recorded actions in each environment, so that later steps have the same bytes too.

        Args:
            episodes: For each environment: seed, number of the episode, and the actions since its start.

        Returns:
            The last observations, whether each episode is over, and infos.

        Raises:
            ValueError: An episode ends before its last action, so the actions are from another simulation.
        """
        observations, self._over = [], np.zeros(self.num_envs, bool)
        for row, (env, (seed, number, actions)) in enumerate(zip(self.envs, episodes, strict=True)):
            observation, _ = env.reset(seed=seed, options={"episode_number": number})
            for step, action in enumerate(actions):
                if self._over[row]:
                    where = f"environment {row}, seed {seed}, episode {number}"
                    raise ValueError(f"actions must not outlast the episode; {where} ended at step {step}.")
                observation, _, terminated, truncated, _ = env.step(action)
                self._over[row] = terminated or truncated
            observations.append(observation)
        return self._batch(observations), self._over.copy(), self.infos()

    def render(self) -> Any:
        """Return one picture per environment, see `CorridorEnv.render`."""
        return tuple(env.render() for env in self.envs)

    def close_extras(self, **kwargs: Any) -> None:
        """Free the renderers."""
        for env in self.envs:
            env.close()

    def _observations(self, some: np.ndarray) -> Any:
        """Return the observations of some environments; the others must have no events in the last step."""
        config, vehicles = self.envs[0].config, self._vehicles
        if config.observation != "window":
            envs = [self.envs[row] for row in some]
            return self._batch([observe(env.config, env.seen_events, env.luminance) for env in envs])
        clocks = vehicles.rows["start_us"][some], vehicles.rows["window_us"][some]
        ends = np.append(0, vehicles.seen_ends[1:][some])
        return pack_windows(vehicles.seen, ends, *clocks, config.window_capacity)

    def _batch(self, observations: Any) -> Any:
        """Stack observations into one fresh array; return those of varying length as a tuple."""
        if isinstance(self.single_observation_space, spaces.Sequence):
            return tuple(observations)
        return np.stack(observations)


def _infos_of(envs: Sequence[CorridorEnv], vehicles: Vehicles, some: np.ndarray) -> dict[str, np.ndarray]:
    """Return the `Info` of several environments as arrays; `some` has the rows of their vehicles."""
    config, rows = envs[0].config, vehicles.rows[some]
    lost = rows["dropped"].copy()
    if config.observation == "window" and config.window_capacity is not None:
        lost += np.maximum(vehicles.num_seen[some] - config.window_capacity, 0)
    return {
        "episode_seed": np.array([env.series[0] for env in envs]),
        "episode_number": np.array([env.series[1] for env in envs]),
        "x_m": rows["x_m"].copy(),
        "y_m": rows["y_m"].copy(),
        "distance_m": rows["y_m"].copy(),
        "success": rows["success"].copy(),
        "collision": rows["collision"].copy(),
        "num_events": rows["num_events"].copy(),
        "dropped_events": lost,
        "t_us": rows["t_us"].copy(),
    }


def _is_action(space: spaces.Space, action: Any) -> bool:
    """Whether an action is in a Discrete (tested without arrays, which is faster) or in a Box."""
    if isinstance(space, spaces.Discrete):
        return not isinstance(action, bool | np.bool_) and bool(space.contains(action))
    own = np.asarray(action)
    return own.shape == space.shape and not wrong_actions(space, own[None]).any()


def _bad_action(space: spaces.Space, action: object) -> str:
    if isinstance(space, spaces.Discrete):
        return f"action must be an integer in [0, {space.n - 1}]; got {action!r}."
    return f"action must be in {space}; got {action!r}."


# Gymnasium imports the module before the colon: make("envs.corridor:evade/Corridor-v0").
if "evade/Corridor-v0" not in gymnasium.registry:
    gymnasium.register(
        id="evade/Corridor-v0",
        entry_point="envs.corridor:CorridorEnv",
        vector_entry_point="envs.corridor:CorridorVectorEnv",
    )
