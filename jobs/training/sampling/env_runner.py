"""RLlib's environment runner with all episodes of a process in one loop over arrays.

RLlib appends each number of each step to the object of its episode and sends every step through
two pipelines of connectors, which takes longer than simulating it. Here the steps of all
corridors are kept as arrays, and the episodes are cut out of them at the end: the same episodes
as from RLlib's own runner with connectors that stack features (`test_env_runner.py` compares the
bytes).

The features of a step (`models.policy.features`) are computed exactly once, and the stack of the
last ones replaces the observation: PPO's epochs and its bootstrap values read stacks, and a raw
window never leaves the env runner.
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

STATES = "recurrent_state"  # column of a step: the state of a recurrent network before it, float32 (S,)
MAX_SAMPLE_S = 900.0  # an env runner compiles kernels for a minute first, on a busy machine for several


class Step(NamedTuple):
    """One step of all N episodes, each an array (N, ...).

    Attributes:
        stacks: What the policy saw before it.
        actions: What was done, int64.
        outputs: What is kept of the policy's decision, by RLlib's name.
        rewards: True ones, float64.
        terminated: Whether the episode ended by contact or goal.
        truncated: Whether the episode ended by its time limit.
        infos: The environments', each value an array.
        over: Where the environment was reset instead of stepped.
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
    """What one env runner contributes to a round of sampling.

    Attributes:
        runner: Which one, RLlib's `worker_index`.
        began: Its rounds before this one, and the number of the weights that it sampled with.
        episodes: As `PlainEnvRunner.sample` returns them.
        metrics: As RLlib's `get_metrics` returns them.
        after: Where it stands now.
    """

    runner: int
    began: tuple[int, int]
    episodes: list[SingleAgentEpisode]
    metrics: Any
    after: Snapshot


class RolloutError(RuntimeError):
    """An error of the simulation or the policy in an env runner."""


class Raised:
    """Stands for the samples of an env runner that failed; re-raises its error in the learner process."""

    def __init__(self, reason: str) -> None:
        """Remember why."""
        self.reason = reason

    def __getitem__(self, index: int) -> Any:
        """Raise it."""
        raise RolloutError(self.reason)


class PlainEnvRunner(SingleAgentEnvRunner):
    """Rolls out the episodes of one process, without connectors; its module computes the features.

    RLlib restarts an env runner that died or hangs, which is right. It would also restart one whose
    code raised, hide the reason in a log, and fail the same way again: such an error is passed on.
    """

    _callbacks: list[Any]
    _needs_initial_reset: bool

    def __init__(self, **settings: Any) -> None:
        """Build the environments and the policy.

        In a process of its own an error is kept and raised by the next call: RLlib would otherwise go
        on without the env runner, and fail for lack of it.
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
        """Check RLlib's parts; a process that could not be built answers too."""
        if not self._refused:
            super().assert_healthy()

    def _check_built(self) -> None:
        """Raise the error of the construction, if there was one."""
        if self._refused:
            raise RolloutError(self._refused)

    def get_spaces(self) -> Any:
        """Return RLlib's spaces; RLlib asks for these first.

        Raises:
            RolloutError: The process could not be built.
        """
        self._check_built()
        return super().get_spaces()

    def sample(self, **asked: Any) -> list[SingleAgentEpisode]:
        """Roll out as asked, in less than `MAX_SAMPLE_S`.

        Raises:
            RolloutError: With the type and text of whatever was raised.
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
            RolloutError: With the type and text of whatever was raised.
        """
        self._check_built()
        began = self._callbacks[0].rounds, self._weights_seq_no
        return Part(self.worker_index, began, self.sample(), self.get_metrics(), self.snapshot())

    def snapshot(self) -> Snapshot:
        """Return all that the next rounds depend on except the weights; episodes are their actions so far.

        Raises:
            RolloutError: The process could not be built.
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
        """Continue from the snapshot of another process; the weights come by `set_state`.

        Returns:
            Why the episodes start again instead, in a few words; empty if they go on.

        Raises:
            RolloutError: The process could not be built.
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
        """Simulate the episodes under way up to where they were; return what differs, empty if nothing."""
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
        if not np.array_equal(shown, self._stacks[:, -1, ..., : shown.shape[-1]]):  # without the own action
            return "the simulation shows something else than before"
        self._episodes = list(zip(snapshot.values["names"], actions, strict=True))
        return ""

    def apply(self, func: Callable[..., Any], *values: Any, **named: Any) -> Any:
        """Call a function as RLlib does, but pass a rollout's error on instead of ending the process."""

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
            The episodes that ended, in the order in which they did, then the pieces of those
            that go on; observations are stacks of features, `get_infos()` is a dict of arrays (T + 1,).

        Raises:
            ValueError: Something else was asked than steps of the policy's drawn actions.
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
        """Start every episode again; unfinished ones are dropped."""
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
        """Step every episode; finished ones start again instead."""
        stacks, over = self._stacks, self._over
        actions, outputs = self._decide(stacks)
        observations, rewards, terminated, truncated, infos = self.env.unwrapped.step(actions)
        self._state = np.where(over[:, None], np.float32(0.0), self._state)
        self._remember(observations, over, actions)
        self._over = terminated | truncated
        return Step(stacks, actions, outputs, rewards, terminated, truncated, infos, over)

    def velocities_mps(self) -> np.ndarray | None:
        """Return what each vehicle measures now, (N, 2) [m/s]; None for a policy that does not ask."""
        if not self.module.spec.own_velocity:
            return None
        return np.array([env.measured_velocity_mps for env in self.env.unwrapped.envs])

    def _remember(self, observations: Any, first: np.ndarray, taken: np.ndarray) -> None:
        """Add what each environment shows to what the policy keeps.

        Args:
            observations: One for each environment.
            first: bool (N,), True where an episode begins.
            taken: int (N,), the actions of the step that ended with these observations.
        """
        if self.module.encoder is not None:
            self.shown.add(observations)
        self._stacks = self.module.remember(self._stacks, observations, first, taken, self.velocities_mps())

    @torch.no_grad()
    def _decide(self, stacks: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Return drawn actions (N,), and by name the logits (N, actions) and a recurrent network's states."""
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
                if over[first : first + 1, row].any():  # reset here: the episode begins after it
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
    """Return an episode that begins: its name, and the actions so far."""
    return uuid.uuid4().hex, np.empty(0, np.int16)


def _logps(logits: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """Log-probabilities float32 (...) of actions (...) by logits (..., actions)."""
    logps = torch.log_softmax(torch.from_numpy(logits), dim=-1)
    return logps.gather(-1, torch.from_numpy(actions)[..., None])[..., 0].numpy()


def _by_name(infos: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Return infos of T steps as arrays (T, N); names with an underscore are Gymnasium's masks."""
    return {name: np.stack([info[name] for info in infos]) for name in infos[0] if name[0] != "_"}
