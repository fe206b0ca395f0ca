"""Measure the effect of a setting on recorded episodes: events, latents, actions, and the cost of a step.

A recorded episode consists of its corridor and its actions. Replayed under another setting, it visits the
same places, so that every difference is due to the setting.
"""

import time
from collections.abc import Callable, Generator, Sequence
from typing import NamedTuple

import numpy as np

from envs.config import EnvConfig
from envs.corridor import CorridorEnv
from envs.event_error import TIME_SHARE, event_error
from envs.events import EVENT, unpack_window
from jobs.measure.encodings import exact_latents
from jobs.rollout.agents import PolicyAgent
from models.encoder.evae import EventVAE
from models.encoder.event_batch import cut_packed
from models.encoder.table import EncoderTable

TURN = 50  # steps: some hundredths of a second, long enough that reloading the cache hardly counts
Setting = tuple[EnvConfig, PolicyAgent]


class Replay(NamedTuple):
    """One replayed episode of T steps.

    Attributes:
        actions: The agent's choice at each step, int64 (T,).
        windows: The T packed windows that it saw before each choice, int32 (rows, 4).
        events: All events of the episode, EVENT.
        step_us: Mean process time of a step, choice and simulation [us].
    """

    actions: np.ndarray
    windows: list[np.ndarray]
    events: np.ndarray
    step_us: float


Episode = Generator[None, None, Replay]


class Measured(NamedTuple):
    """Cost and errors of a setting over all recorded episodes.

    Attributes:
        steps_us: Process time of a step in each episode [us].
        event_error: Error against the reference's events, see `envs.event_error`.
        latent_error: Error against the exact latents of the reference's events, see `latent_error`.
        other_action: Share of steps with a different action than under the reference setting.
    """

    steps_us: tuple[float, ...]
    event_error: float
    latent_error: float
    other_action: float

    @property
    def step_us(self) -> float:
        """Return the process time of a step, median over episodes [us]."""
        return float(np.median(self.steps_us))


class _Comparison(NamedTuple):
    """One episode under one setting, compared with the reference."""

    step_us: float
    event_error: float
    events: int  # of both replays together
    latents: np.ndarray
    others: np.ndarray


def measure_settings(
    settings: Sequence[Setting], evae: EventVAE, seeds: Sequence[int], advance: Callable[[int], None]
) -> list[Measured]:
    """Record one episode per seed under the first setting, and replay it under every setting.

    The settings alternate every `TURN` steps, so that a busy machine slows all of them equally. A stochastic
    policy draws the same random numbers under every setting.

    Args:
        settings: Simulation and policy of each setting; the last one is the reference.
        evae: The policy's encoder, for latents in float64 with exact times.
        seeds: Seeds of the corridors.
        advance: Called with 1 for each setting and episode.
    """
    for setting in settings:  # an untimed turn loads the compiled kernels
        first = steps(*setting, seeds[0])
        next(first, None)
        first.close()
    exact: list[np.ndarray] = []
    found: list[list[_Comparison]] = [[] for _ in settings]
    for seed in seeds:
        actions = replay(*settings[0], seed).actions
        replays = take_turns([steps(*setting, seed, actions) for setting in settings], advance)
        reference = replays[-1]
        windows = [unpack_window(window) for window in reference.windows]
        exact.append(exact_latents(evae, [(events, 0, window_us) for events, window_us in windows])[0])
        for comparisons, own, setting in zip(found, replays, settings, strict=True):
            comparisons.append(_compare(own, reference, *setting))
    return [_mean(own, np.concatenate(exact)) for own in found]


def _compare(own: Replay, reference: Replay, env: EnvConfig, agent: PolicyAgent) -> _Comparison:
    error = event_error(own.events, reference.events, TIME_SHARE * 1e6 / env.control_hz)
    others = own.actions != reference.actions
    events = own.events.size + reference.events.size
    return _Comparison(own.step_us, error, events, latents_of(agent, own.windows), others)


def _mean(found: Sequence[_Comparison], exact: np.ndarray) -> Measured:
    steps_us, errors, events, latents, others = zip(*found, strict=True)
    return Measured(
        steps_us=steps_us,
        event_error=float(np.average(errors, weights=events)) if sum(events) else 0.0,
        latent_error=latent_error(np.concatenate(latents), exact),
        other_action=float(np.concatenate(others).mean()),
    )


def take_turns(episodes: Sequence[Episode], advance: Callable[[int], None]) -> list[Replay]:
    """Run all episodes to their ends in alternating turns; call `advance(1)` after each episode."""
    done: dict[int, Replay] = {}
    while len(done) < len(episodes):
        for place, episode in enumerate(episodes):
            if place in done:
                continue
            try:
                next(episode)
            except StopIteration as end:
                done[place] = end.value
                advance(1)
    return [done[place] for place in range(len(episodes))]


def replay(config: EnvConfig, agent: PolicyAgent, seed: int, actions: np.ndarray | None = None) -> Replay:
    """Run an episode of `steps` without interruption; return its replay."""
    return take_turns([steps(config, agent, seed, actions)], lambda count: None)[0]


def steps(config: EnvConfig, agent: PolicyAgent, seed: int, actions: np.ndarray | None = None) -> Episode:
    """Run an episode in the corridor of a seed, in turns of `TURN` steps.

    Args:
        config: The simulation.
        agent: Chooses an action at every step; it remembers one episode at a time.
        seed: Seed of the corridor.
        actions: Actions to execute instead of the agent's, int64 (T,). None: execute the agent's actions
            until the episode ends.
    """
    env = CorridorEnv(config, observation=agent.observation)
    try:
        observation, _ = env.reset(seed=seed)
        agent.reset([env], [seed])
        chosen: list[int] = []
        windows, events = [], [np.empty(0, EVENT)]
        seconds, over = 0.0, False
        while not over:
            windows.append(cut_packed(observation))
            start = time.process_time()
            chosen.append(int(agent(observation[None])[0]))
            action = chosen[-1] if actions is None else int(actions[len(chosen) - 1])
            agent.policy.taken = np.array([action])
            observation, _, terminated, truncated, _ = env.step(action)
            seconds += time.process_time() - start
            events.append(env.events)
            over = terminated or truncated
            if len(chosen) % TURN == 0:
                yield
    finally:
        env.close()
    return Replay(np.array(chosen), windows, np.concatenate(events), 1e6 * seconds / len(chosen))


def latents_of(agent: PolicyAgent, windows: Sequence[np.ndarray]) -> np.ndarray:
    """Return the latents (T, latent) of packed windows by the policy's encoder.

    Raises:
        TypeError: The policy has no lookup table of single events.
    """
    table = agent.policy.encoder
    if not isinstance(table, EncoderTable):
        raise TypeError(f"the policy's encoder must be an EncoderTable, got {type(table).__name__}")
    return table.encode_windows(windows)


def latent_error(latents: np.ndarray, exact: np.ndarray) -> float:
    """Return the root mean squared error of latents (T, latent), in standard deviations of the exact ones.

    Error and deviation are taken over all units together, so that a unit without information has no weight.
    The result is 0 for the exact latents, and 1 for their mean as a constant prediction.
    """
    deviation = float(np.sqrt(exact.var(axis=0).sum()))
    error = float(np.sqrt(np.square(latents - exact).sum(axis=1).mean()))
    return error / deviation if deviation > 0.0 else float("nan")
