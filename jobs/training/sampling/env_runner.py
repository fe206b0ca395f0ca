"""RLlib's environment runner with all episodes of a process in one loop over arrays.

RLlib appends each number of each step to an episode object and sends every step through two
connector pipelines, which takes longer than simulating the step. Here the steps of all corridors
are stored as arrays, and the episodes are cut from them at the end. The episodes are the same as
from RLlib's own env runner with connectors that stack features (`test_env_runner.py` compares the
bytes).

The features of a step (`models.policy.features`) are computed exactly once, and the stack of the
newest ones replaces the observation. PPO's epochs and its bootstrap values read stacks, so raw
windows never leave the env runner.
"""

import uuid
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from ray.rllib.core.columns import Columns
from ray.rllib.env.single_agent_env_runner import SingleAgentEnvRunner
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.env.utils.infinite_lookback_buffer import InfiniteLookbackBuffer

from jobs.config.plugins import one_line
from jobs.run.watchdog import ending_after
from jobs.training.sampling.rllib_internals import ENV_RUNNER, require
from jobs.training.sampling.snapshots import Snapshot, generators, set_generators
from jobs.training.sampling.window_sample import WindowSample

STATES = "recurrent_state"  # column of a step: a recurrent network's state before the step, float32 (S,)
MAX_SAMPLE_S = 900.0  # an env runner compiles kernels for a minute first, on a busy machine for several


class Step(NamedTuple):
    """One step of all N episodes, each field an array (N, ...).

    Attributes:
        stacks: Input of the policy before the step.
        actions: Actions taken, int64.
        outputs: Stored outputs of the policy, by RLlib's name.
        rewards: Unscaled rewards, float64.
        terminated: Whether the episode ended by contact or goal.
        truncated: Whether the episode ended by its time limit.
        infos: Infos of the environments, each value an array.
        over: Whether the environment was reset instead of stepped.
    """

    stacks: np.ndarray
    actions: np.ndarray
    outputs: dict[str, np.ndarray]
    rewards: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    infos: dict[str, np.ndarray]
    over: np.ndarray


class Part(NamedTuple):
    """The contribution of one env runner to a round of sampling.

    Attributes:
        runner: RLlib's `worker_index` of the env runner.
        began: Number of its rounds before this one, and sequence number of the weights used.
        episodes: Episodes as returned by `PlainEnvRunner.sample`.
        metrics: Metrics as returned by RLlib's `get_metrics`.
        after: State of the env runner after the round.
    """

    runner: int
    began: tuple[int, int]
    episodes: list[SingleAgentEpisode]
    metrics: Any
    after: Snapshot


class RolloutError(RuntimeError):
    """An error of the simulation or the policy in an env runner."""


class Raised:
    """Replaces the samples of a failed env runner; re-raises its error in the learner process."""

    def __init__(self, reason: str) -> None:
        """Store the error's text."""
        self.reason = reason

    def __getitem__(self, index: int) -> Any:
        """Raise RolloutError."""
        raise RolloutError(self.reason)


class PlainEnvRunner(SingleAgentEnvRunner):
    """Rolls out the episodes of one process, without connectors; its module computes the features.

    RLlib restarts an env runner that died or hangs, which is right. It would also restart one whose
    code raised an error, hide the reason in a log, and fail the same way again. Here such an error is
    passed on to the learner.
    """

    _callbacks: list[Any]
    _needs_initial_reset: bool

    def __init__(self, **settings: Any) -> None:
        """Build the environments and the policy.

        In a separate process, an error is stored and raised by the next call. RLlib would otherwise
        continue without the env runner, and fail for lack of it.
        """
        self._refused, self.shown = "", WindowSample()
        try:
            super().__init__(**settings)
            require(self, ENV_RUNNER)
        except Exception as error:
            if not settings.get("worker_index"):
                raise
            self._refused = one_line(error)

    def assert_healthy(self) -> None:
        """Run RLlib's check, but not after a failed construction: that process must answer too."""
        if not self._refused:
            super().assert_healthy()

    def _check_built(self) -> None:
        """Raise the error of the construction, if there was one."""
        if self._refused:
            raise RolloutError(self._refused)

    def get_spaces(self) -> Any:
        """Return RLlib's spaces, for which RLlib asks first.

        Raises:
            RolloutError: The construction failed.
        """
        self._check_built()
        return super().get_spaces()

    def sample(self, **asked: Any) -> list[SingleAgentEpisode]:
        """Roll out the requested steps; end the process if that takes longer than `MAX_SAMPLE_S`.

        Raises:
            RolloutError: An error was raised; the message has its type and text.
        """
        self._check_built()
        try:
            with ending_after(MAX_SAMPLE_S):
                return super().sample(**asked)
        except Exception as error:
            raise RolloutError(one_line(error)) from error

    def take_part(self) -> Part:
        """Sample one round; return it with the state before and after.

        Raises:
            RolloutError: An error was raised; the message has its type and text.
        """
        self._check_built()
        began = self._callbacks[0].rounds, self._weights_seq_no
        return Part(self.worker_index, began, self.sample(), self.get_metrics(), self.snapshot())

    def snapshot(self) -> Snapshot:
        """Return the state on which the next rounds depend, without weights; episodes are stored as actions.

        Raises:
            RolloutError: The construction failed.
        """
        self._check_built()
        values = {"metrics": self._callbacks[0].state(), "steps": self.shown.steps}
        arrays = {**generators(), **self.shown.arrays()}
        if not self._needs_initial_reset:
            values["names"] = [name for name, _ in self._episodes]
            actions = [taken for _, taken in self._episodes]
            arrays |= {
                "stacks": self._stacks,
                STATES: self._state,
                "actions": np.concatenate(actions),
                "actions_taken": np.array([len(taken) for taken in actions], np.int64),
                "episode_seed": self._infos["episode_seed"],
                "episode_number": self._infos["episode_number"],
            }
        return Snapshot(values, arrays)

    def resume(self, snapshot: Snapshot) -> str:
        """Continue from the snapshot of another process; `set_state` sets the weights.

        Returns:
            Why the episodes are restarted instead, in a few words; empty if they continue.

        Raises:
            RolloutError: The construction failed.
        """
        self._check_built()
        arrays = snapshot.arrays
        self._callbacks[0].set_state(snapshot.values["metrics"])
        self._needs_initial_reset = "stacks" not in arrays
        with ending_after(MAX_SAMPLE_S):
            problem = "" if self._needs_initial_reset else self._replay(snapshot)
        self._needs_initial_reset |= bool(problem)
        self.shown.load(arrays, snapshot.values["steps"])
        set_generators(arrays)
        return problem

    def _replay(self, snapshot: Snapshot) -> str:
        """Simulate the running episodes up to the snapshot; return what differs, empty if nothing does."""
        arrays = snapshot.arrays
        actions = np.split(arrays["actions"], np.cumsum(arrays["actions_taken"])[:-1])
        series = arrays["episode_seed"].tolist(), arrays["episode_number"].tolist()
        try:
            told = self.env.unwrapped.replay(list(zip(*series, actions, strict=True)))
        except ValueError as error:
            return one_line(error)
        observations, self._over, self._infos = told
        self._stacks, none = arrays["stacks"], np.zeros((len(self._over), 0), np.float32)
        self._state = arrays.get(STATES, none)
        shown = self.module.features(observations)
        # Without the own action and velocity that `remember` appends.
        if not np.array_equal(shown, self._stacks[:, -1, ..., : shown.shape[-1]]):
            return "the simulation shows something else than before"
        self._episodes = list(zip(snapshot.values["names"], actions, strict=True))
        return ""

    def apply(self, func: Callable[..., Any], *values: Any, **named: Any) -> Any:
        """Call a function as RLlib does, but return a RolloutError as `Raised` instead of raising it."""

        def handed_on(runner: Any, *values: Any, **named: Any) -> Any:
            try:
                return func(runner, *values, **named)
            except RolloutError as error:
                return Raised(str(error))

        return super().apply(handed_on, *values, **named)

    def _sample(
        self,
        *,
        num_timesteps: int | None = None,
        num_episodes: int | None = None,
        explore: bool = True,
        random_actions: bool = False,
        force_reset: bool = False,
    ) -> list[SingleAgentEpisode]:
        """Roll out at least `num_timesteps` steps, all episodes in lock-step.

        Returns:
            The ended episodes in the order of their end, then the pieces of the running ones;
            observations are stacks of features, `get_infos()` is a dict of arrays (T + 1,).

        Raises:
            ValueError: The request is not for a number of steps with actions drawn from the policy.
        """
        if num_timesteps is None or random_actions or not explore:
            raise ValueError("PlainEnvRunner rolls out num_timesteps of drawn actions and nothing else")
        if force_reset or self._needs_initial_reset:
            self._reset_all()
        self._run = self.module.network.run(self.module.trunk, self.module.pi)
        steps: list[Step] = []
        taken = 0
        while taken < num_timesteps:
            steps.append(self._step())
            taken += int((~steps[-1].over).sum())
        done, going_on = self._cut(steps)
        self._log_env_steps(metric=self._metrics_num_env_steps_sampled, num_steps=taken)
        self._increase_sampled_metrics(taken, len(done))
        return done + going_on

    def _reset_all(self) -> None:
        """Start a new episode in every environment; drop unfinished ones."""
        seed = self._seed if self._needs_initial_reset else None
        observations, infos = self.env.unwrapped.reset(seed=seed)
        first, space = np.ones(self.env.num_envs, bool), self.module.observation_space
        self._stacks = np.zeros((len(first), *space.shape), space.dtype)
        self._state = np.zeros((len(first), self.module.state_size), np.float32)
        self._remember(observations, first, np.zeros(len(first), np.int64))
        self._infos, self._over = infos, ~first
        self._episodes = [_begun() for _ in first]
        self._needs_initial_reset = False

    def _step(self) -> Step:
        """Step every environment, or reset it if its episode has ended."""
        stacks, over = self._stacks, self._over
        actions, outputs = self._decide(stacks)
        observations, rewards, terminated, truncated, infos = self.env.unwrapped.step(actions)
        self._state = np.where(over[:, None], np.float32(0.0), self._state)
        self._remember(observations, over, actions)
        self._over = terminated | truncated
        return Step(stacks, actions, outputs, rewards, terminated, truncated, infos, over)

    def velocities_mps(self) -> np.ndarray | None:
        """Return each vehicle's measured velocity (N, 2) [m/s]; None for a policy that does not read it."""
        if not self.module.spec.own_velocity:
            return None
        return np.array([env.measured_velocity_mps for env in self.env.unwrapped.envs])

    def _remember(self, observations: Any, first: np.ndarray, taken: np.ndarray) -> None:
        """Add the newest observation of each environment to the policy's memory.

        Args:
            observations: One observation per environment.
            first: bool (N,), True where an episode starts.
            taken: int (N,), the actions of the step that ended with these observations.
        """
        if self.module.encoder is not None:
            self.shown.add(observations)
        self._stacks = self.module.remember(self._stacks, observations, first, taken, self.velocities_mps())

    @torch.no_grad()
    def _decide(self, stacks: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Draw actions (N,); return them, and by name the logits (N, actions) and any recurrent states."""
        before = {STATES: self._state} if self.module.state_size else {}
        decided, self._state = self._run(stacks, self._state)
        logits = torch.from_numpy(decided)
        actions = torch.multinomial(torch.softmax(logits, dim=-1), 1, replacement=True)
        return actions[:, 0].numpy(), {Columns.ACTION_DIST_INPUTS: logits.numpy(), **before}

    def _cut(self, steps: list[Step]) -> tuple[list[SingleAgentEpisode], list[SingleAgentEpisode]]:
        """Return the episodes that ended in these steps, and the pieces of the running ones."""
        over = np.stack([step.over for step in steps])
        ended = np.stack([step.terminated | step.truncated for step in steps])
        stacks = np.stack([*(step.stacks for step in steps), self._stacks])
        infos = _by_name([self._infos, *(step.infos for step in steps)])
        self._infos = steps[-1].infos
        columns = {name: np.stack([getattr(step, name) for step in steps]) for name in ("actions", "rewards")}
        columns |= {name: np.stack([step.outputs[name] for step in steps]) for name in steps[0].outputs}
        columns[Columns.ACTION_LOGP] = _logps(columns[Columns.ACTION_DIST_INPUTS], columns["actions"])
        done: list[tuple[int, SingleAgentEpisode]] = []
        going_on = []
        for row in range(over.shape[1]):
            first = 0
            for last in [*np.flatnonzero(ended[:, row]), len(steps)]:
                if over[first : first + 1, row].any():  # a reset: the episode starts after it
                    self._episodes[row] = _begun()
                    first += 1
                end = min(last + 1, len(steps))
                if end > first:
                    piece = slice(first, end)
                    episode = self._episode(
                        row,
                        stacks[first : end + 1, row],
                        {name: values[piece, row] for name, values in columns.items()},
                        {name: values[first : end + 1, row] for name, values in infos.items()},
                    )
                    if last < len(steps):
                        episode.is_terminated = bool(steps[last].terminated[row])
                        episode.is_truncated = bool(steps[last].truncated[row])
                        done.append((int(last), episode))
                    else:
                        going_on.append(episode)
                first = end
        return [episode for _, episode in sorted(done, key=lambda pair: pair[0])], going_on

    def _episode(
        self, row: int, stacks: np.ndarray, columns: dict[str, np.ndarray], infos: dict[str, np.ndarray]
    ) -> SingleAgentEpisode:
        """Return the next piece of the episode in a row."""
        name, before = self._episodes[row]
        self._episodes[row] = name, np.concatenate([before, columns["actions"].astype(np.int16)])
        return SingleAgentEpisode(
            name,
            observations=InfiniteLookbackBuffer(stacks),
            observation_space=self.module.observation_space,
            infos=InfiniteLookbackBuffer(infos) if infos else None,
            actions=InfiniteLookbackBuffer(columns.pop("actions")),
            action_space=self.module.action_space,
            rewards=InfiniteLookbackBuffer(columns.pop("rewards")),
            extra_model_outputs={name: InfiniteLookbackBuffer(values) for name, values in columns.items()},
            t_started=len(before),
            len_lookback_buffer=0,
        )


def _begun() -> tuple[str, np.ndarray]:
    """Return a new episode: its name, and its actions so far, none."""
    return uuid.uuid4().hex, np.empty(0, np.int16)


def _logps(logits: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """Return the log-probabilities float32 (...) of actions (...) given logits (..., actions)."""
    logps = torch.log_softmax(torch.from_numpy(logits), dim=-1)
    return logps.gather(-1, torch.from_numpy(actions)[..., None])[..., 0].numpy()


def _by_name(infos: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Return infos of T steps as arrays (T, N), without Gymnasium's masks, which start with an underscore."""
    return {name: np.stack([info[name] for info in infos]) for name in infos[0] if name[0] != "_"}
