"""Agents: trained policies, and the baselines that show how hard the corridors are.

The baselines `straight` and `random` see nothing, and `oracle` knows the true geometry. They are the lower
and upper bounds to compare a result with.

Policies may come from elsewhere. An ONNX file is one that `models.policy.onnx` wrote, or any network with
one input, the event image (its values 0 to 255 in the input's own type), whose first output is a number
for each action. A Python function is called with the seed at the start of each episode, and returns a
function from an observation to an action, 0, 1 or 2, which may hold the memory of the episode. The outer
function's attribute `observation` names its input, as `EnvConfig.observation`; the default is the event
image::

    model = PPO.load("model.zip")

    def policy(seed):
        return lambda image: model.predict(image[None], deterministic=True)[0]
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, cast

import numpy as np
from gymnasium.spaces import Discrete

from core.places import resolve
from envs.config import Observation
from envs.corridor import CorridorEnv
from envs.events import unpack_window
from envs.kinematics import DIAGONAL
from envs.scene import Scene
from envs.scene.planning import LATTICE_M, SIDE_PRICE, cost_to_go
from envs.vehicles.planning import Planner

if TYPE_CHECKING:
    from models.policy import Policy

# Displacements of one step in x and y [step lengths]: forward, left, right.
MOVES = np.array([[0.0, 1.0], [-DIAGONAL, DIAGONAL], [DIAGONAL, DIAGONAL]])

ONNX = ".onnx"
ONNX_NUMBERS: Mapping[str, Any] = {
    **{"tensor(float)": np.float32, "tensor(double)": np.float64, "tensor(bool)": np.bool_},
    **{"tensor(int64)": np.int64, "tensor(int32)": np.int32, "tensor(uint8)": np.uint8},
}

Act = Callable[[Any], Any]  # an episode's observation -> its action


class Agent(Protocol):
    """Chooses an action for each episode of a batch.

    Attributes:
        observation: The observation that it needs from its environments, as `EnvConfig.observation`.
    """

    @property
    def observation(self) -> Observation:
        """Return the observation that it needs."""

    def reset(self, envs: Sequence[CorridorEnv], seeds: Sequence[int]) -> None:
        """Start one episode per environment; each has just been reset with its seed."""

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        """Return actions (B,) for observations (B, ...)."""

    def keep(self, places: np.ndarray) -> None:
        """Keep the running episodes (indices into the batch, in order); drop the finished ones."""


def make_agent(name: str, action: str = "deterministic", table: Sequence[tuple[str, Any]] = ()) -> Agent:
    """Return a baseline by its name, or the policy of a folder.

    Args:
        name: "straight", "random", "oracle", the path of a policy folder or of an ONNX file, or
            "module:attribute", a function whose module is imported or can be.
        action: How a policy chooses: "deterministic" or "stochastic".
        table: Names and values of settings of `EncoderTable.from_evae`, for a policy whose frozen
            encoder reads single events; empty for the policy's own settings.
    """
    if name in BASELINES:
        return EpisodeAgent(BASELINES[name])
    if name.endswith(ONNX):
        return OnnxAgent(name, action == "stochastic")
    if ":" in name:
        return function_agent(resolve(name))
    # Imported here, because the baselines need no network.
    from models.encoder.table import EncoderTable
    from models.encoder.weights import load_encoder
    from models.policy import load_policy
    from models.policy.policy import ENCODER

    policy = load_policy(Path(name))
    if table:
        policy.encoder = EncoderTable.from_evae(load_encoder(Path(name) / ENCODER)[0], **dict(table))
    return PolicyAgent(policy, action == "stochastic")


class EpisodeAgent:
    """An agent that acts in each episode of a batch independently."""

    def __init__(self, begin: Callable[[CorridorEnv, int], Act], observation: Observation = "none") -> None:
        """Call `begin(env, seed)` at the start of each episode for the function that chooses its actions."""
        self._begin, self.observation = begin, observation

    def reset(self, envs: Sequence[CorridorEnv], seeds: Sequence[int]) -> None:
        """Start an episode for each seed."""
        self._acts = [self._begin(env, int(seed)) for env, seed in zip(envs, seeds, strict=True)]

    def __call__(self, observations: Any) -> np.ndarray:
        """Return the action of each episode, (B,)."""
        return np.array([act(one) for act, one in zip(self._acts, observations, strict=True)])

    def keep(self, places: np.ndarray) -> None:
        """Keep the running episodes (`Agent.keep`)."""
        self._acts = [self._acts[k] for k in places]


def fly_straight(env: CorridorEnv, seed: int) -> Act:
    """Fly straight ahead at every step."""
    return lambda observation: env.dynamics.straight


def fly_at_random(env: CorridorEnv, seed: int) -> Act:
    """Take each action with the same probability, drawn from the episode's own stream."""
    (stream,), count = episode_streams([seed]), num_actions(env)
    return lambda observation: stream.integers(count)


def fly_as_planned(env: CorridorEnv, seed: int) -> Act:
    """Plan with the true geometry from the place where the action takes effect.

    A vehicle with a body, or among moving bodies, takes the command with the lowest cost (`Planner`).
    """
    if env.dynamics.move is not None or env.moving:
        planner = Planner()
        return lambda observation: int(planner.costs(env).argmin())
    step_m = env.config.speed_mps / env.config.control_hz
    plan = plan_path(env.scene, env.camera_pose()[0], env.config.vehicle_radius_m, env.config.camera_height_m)
    return lambda observation: follow(plan, MOVES * step_m, *env.place_of_action())


class PolicyAgent:
    """A trained policy, which gets nothing but its observation.

    Attributes:
        logits: The logits of its last actions, float64 (B, actions).
    """

    logits: np.ndarray

    def __init__(self, policy: "Policy", stochastic: bool = False) -> None:
        """Take the policy's likeliest action, or draw one from its distribution as in training."""
        self.policy, self.stochastic = policy, stochastic
        self.observation = cast(Observation, policy.observation)

    def reset(self, envs: Sequence[CorridorEnv], seeds: Sequence[int]) -> None:
        """Start new episodes, with an empty memory.

        Raises:
            ValueError: The vehicle has another number of actions than the policy.
        """
        own, theirs = self.policy.spec.num_actions, num_actions(envs[0])
        if own != theirs:
            raise ValueError(f"the policy chooses among {own} actions, and the vehicle has {theirs}")
        self.policy.reset(len(envs))
        self._envs, self._streams = list(envs), episode_streams(seeds)

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        """Return actions (B,); random draws come from each episode's own stream."""
        if self.policy.spec.own_velocity:
            self.policy.velocity_mps = np.array([env.measured_velocity_mps for env in self._envs])
        self.logits = logits = self.policy.logits(observations).astype(np.float64)
        if not self.stochastic:
            return logits.argmax(axis=1)
        gumbel = np.array([stream.gumbel(size=logits.shape[1]) for stream in self._streams])
        self.policy.taken = (logits + gumbel).argmax(axis=1)
        return self.policy.taken.copy()

    def keep(self, places: np.ndarray) -> None:
        """Keep the running episodes (`Agent.keep`)."""
        self.policy.keep(places)
        self._envs, self._streams = ([kept[k] for k in places] for kept in (self._envs, self._streams))


def function_agent(function: Callable[[int], Act]) -> EpisodeAgent:
    """Return the agent of a Python function, which the module's docstring describes."""

    def begin(env: CorridorEnv, seed: int) -> Act:
        act = function(seed)
        return lambda observation: int(np.asarray(act(observation)).item())

    return EpisodeAgent(begin, getattr(function, "observation", "event_image"))


class OnnxAgent(EpisodeAgent):
    """An ONNX file, run by one thread of onnxruntime, one episode at a time."""

    def __init__(self, path: str, stochastic: bool) -> None:
        """Load the file; draw actions from its logits if `stochastic`, else take the likeliest."""
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        self._session = onnxruntime.InferenceSession(path, options)
        self._inputs = {one.name: one for one in self._session.get_inputs()}
        self._outputs = [one.name for one in self._session.get_outputs()]
        self._own = "first" in self._inputs  # written by models.policy.onnx
        self.stochastic = stochastic
        sees = ("luminance" if "luminance" in self._inputs else "window") if self._own else "event_image"
        super().__init__(self._episode, cast(Observation, sees))

    def _episode(self, env: CorridorEnv, seed: int) -> Act:
        """Start an episode that feeds the file's `next_*` outputs back into its `last_*` inputs."""
        (stream,) = episode_streams([seed])
        first = True
        memory = {name: _empty(one) for name, one in self._inputs.items() if name.startswith("last_")}
        reads_velocity = "velocity_mps" in self._inputs

        def act(observation: np.ndarray) -> int:
            nonlocal first, memory
            given = self._seen(observation, first)
            if reads_velocity:
                given["velocity_mps"] = env.measured_velocity_mps.astype(np.float32)
            results = self._session.run(None, given | memory)
            named = dict(zip(self._outputs, results, strict=True))
            memory = {name: named["next_" + name.removeprefix("last_")] for name in memory}
            first = False
            logits = np.asarray(results[0], np.float64).reshape(-1)
            if not self.stochastic:
                return int(logits.argmax())
            action = int((logits + stream.gumbel(size=logits.size)).argmax())
            if "last_action" in memory:
                memory["last_action"] = np.array(action)
            return action

        return act

    def _seen(self, observation: np.ndarray, first: bool) -> dict[str, Any]:
        """Return an observation as the file's inputs, name -> array."""
        if not self._own:
            ((name, one),) = self._inputs.items()
            shape = [size if isinstance(size, int) else 1 for size in one.shape]
            return {name: observation.astype(ONNX_NUMBERS[one.type]).reshape(shape)}
        begins = {"first": np.array(first)}
        if self.observation == "luminance":
            return {"luminance": observation, **begins}
        events, window_us = unpack_window(observation)
        rows = np.stack([events[name].astype(np.int64) for name in ("t", "x", "y", "p")], axis=1)
        return {"events": rows, "window_us": np.array(window_us), **begins}


def _empty(one: Any) -> np.ndarray:
    """Return zeros of an input's shape and type."""
    return np.zeros([size if isinstance(size, int) else 1 for size in one.shape], ONNX_NUMBERS[one.type])


def num_actions(env: CorridorEnv) -> int:
    """Return the number of a vehicle's actions.

    Raises:
        ValueError: Its actions are not discrete.
    """
    space = env.action_space
    if not isinstance(space, Discrete):
        raise ValueError(f"agents choose among discrete actions, such as body.primitives=15; got {space}")
    return int(space.n)


def episode_streams(seeds: Sequence[int]) -> list[np.random.Generator]:
    """Return one random stream per episode, which depends only on the episode's seed."""
    return [np.random.default_rng(np.random.SeedSequence([int(seed), 0x9110])) for seed in seeds]


def follow(path_x_m: np.ndarray, moves_m: np.ndarray, x_m: float, y_m: float) -> int:
    """Return the action whose move (moves_m: (3, 2), x and y [m]) ends closest in x to the path."""
    places = np.interp(y_m + moves_m[:, 1], np.arange(len(path_x_m)) * LATTICE_M, path_x_m)
    return int(np.abs(x_m + moves_m[:, 0] - places).argmin())


def plan_path(scene: Scene, start_x_m: float, radius_m: float, height_m: float) -> np.ndarray:
    """Return the cheapest path to the goal line on a lattice of the three directions (`envs.scene.planning`).

    Args:
        scene: The true geometry.
        start_x_m: x where the episode starts, at y = 0 [m].
        radius_m: Radius of the vehicle [m].
        height_m: Height of the vehicle above the ground [m].

    Returns:
        x [m] at y = 0, LATTICE_M, 2 LATTICE_M, ... up to the goal line, float64.
    """
    plan = cost_to_go(scene, radius_m, height_m, start_x_m)
    start = round((start_x_m - plan.first_x_m) / LATTICE_M)
    column, path = start, [start]
    for ahead in plan.costs[1:]:
        sides = ahead[column], ahead[column - 1] + SIDE_PRICE, ahead[column + 1] + SIDE_PRICE
        column += (0, -1, 1)[int(np.argmin(sides))]
        path.append(column)
    return start_x_m + (np.array(path) - start) * LATTICE_M


# Name -> function that starts an episode.
BASELINES: dict[str, Callable[[CorridorEnv, int], Act]] = {
    "straight": fly_straight,
    "random": fly_at_random,
    "oracle": fly_as_planned,
}
