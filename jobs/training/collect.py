"""Fly through training corridors, at random and by a policy if one is named; record every event.

Recordings of real cameras (`collect.recordings`) are data beside the flights, or instead of them.

Run: python -m platform.launch +exp=collect
Expect: about 3,000 control steps per second on one core; `data/train.h5` and
`data/validation.h5` in the run folder, each of whole flights that no other file shares.
"""

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np

from envs.config import WITHOUT_EVENTS, EnvConfig, Observation, Split, sensor_settings, settings_hash
from envs.corridor import CorridorEnv
from envs.events import EVENT
from envs.kinematics import NUM_ACTIONS
from envs.recordings import Recording, write_recording
from jobs.config.config import Config, ConfigError
from jobs.rollout.agents import Agent, StepInfo, make_agent
from jobs.rollout.diagnostics import report_event_error
from jobs.rollout.policies import check_sensor
from jobs.run.folder import Run, finish, finished, locate_run, named_policy, open_run
from jobs.run.progress import progress
from jobs.tracking.tracker import Tracker, open_tracker
from jobs.training.real_recordings import Recorded, no_flights, read_recorded, with_recorded
from models.policy import load_policy

FLIGHT_GAP_US = 1_000_000
MEAN_HOLD_M = 2.0
POLICY_EPISODES = 10**6  # number of a policy's first flight: corridors that no random flight came to


def run(config: Config) -> dict[str, Any]:
    """Collect the data sets of a run; return its folder."""
    check_collect(locate_run(config))
    folder = open_run(config)
    with open_tracker(folder.config, folder) as tracker:
        return collect(folder.config, folder, tracker)


def collect(config: Config, folder: Run, tracker: Tracker) -> dict[str, Any]:
    """Write the training and validation recordings of a run, unless they are there already."""
    done = finished(folder, "collect")
    if done is not None:
        return done
    policy, recorded = check_collect(folder)
    sizes: dict[Split, int] = {
        "train": config.collect.num_steps,
        "validation": config.collect.num_validation_steps,
    }
    figures: dict[str, Any] = {}
    with progress("Collect flights", sum(sizes.values()), "steps") as advance:
        for split, num_steps in sizes.items():
            scenes = config.collect.scenes
            parts = np.array_split(np.arange(num_steps), len(scenes) + len(recorded))
            shares = [len(part) for part in parts]
            flights = [
                (dataclasses.replace(config.env, scene=scene, split=split, observation="events"), share)
                for scene, share in zip(scenes, shares, strict=False)
            ]
            recording = no_flights(config.env)
            if flights:
                recording = record(flights, config.seed, advance, policy, config.collect.policy_share)
            if recorded:
                taken = [part[split] for part in recorded]
                recording = with_recorded(recording, list(zip(taken, shares[len(scenes) :], strict=True)))
            write_recording(data_file(folder, split), recording)
            figures[f"collect/{split}_events"] = len(recording.events)
            figures[f"collect/{split}_flights"] = recording.about["flights"]
    if config.collect.scenes:
        figures |= report_event_error(dataclasses.replace(config.env, scene=config.collect.scenes[0]))
    tracker.log(0, figures)
    return finish(folder, "collect", figures)


def data_file(folder: Run, split: str) -> Path:
    """Where the recording of a split lives in a run folder."""
    return folder.data / f"{split}.h5"


def check_collect(folder: Run) -> tuple[Path | None, list[dict[str, Recorded]]]:
    """The policy and the recordings that a run still has to collect; none if it has collected.

    Raises:
        ConfigError: `collect.policy` or `collect.recordings` names one that does not fit.
    """
    policy, config = check_policy(folder), folder.config
    if finished(folder, "collect") is not None:
        return None, []
    settings = config.collect
    share = settings.num_validation_steps / (settings.num_steps + settings.num_validation_steps)
    try:
        return policy, [read_recorded(path, config.env, share) for path in settings.recordings]
    except ValueError as error:
        raise ConfigError(f"collect.recordings: {error}") from error


def check_policy(folder: Run) -> Path | None:
    """The folder of the policy that a run still has to collect flights of; None if there is none.

    Raises:
        ConfigError: `collect.policy` names none, or one that cannot fly here.
    """
    named = folder.config.collect.policy
    if named is None or finished(folder, "collect") is not None:
        return None
    path = named_policy(named)
    if path is None:
        raise ConfigError(f"collect.policy: must be a run folder or a policy folder, got {named!r}")
    try:
        check_sensor(load_policy(path).manifest["sensor"], folder.config.env)
    except ValueError as error:
        raise ConfigError(f"collect.policy: {error}") from error
    return path


def record(
    flights: Sequence[tuple[EnvConfig, int]],
    seed: int,
    advance: Callable[[int], None],
    policy: Path | None = None,
    policy_share: float = 0.5,
) -> Recording:
    """Fly each environment for a number of control steps; join all flights on one clock.

    Args:
        flights: Environment and number of control steps [-], one pair per scene.
        seed: Seed of corridors and actions.
        advance: Told the number of steps after each flight.
        policy: Folder of a policy that flies a share of the steps, whole flights of its own,
            drawing its actions as in training; None: all are random.
        policy_share: That share, 0..1.

    Returns:
        Events of all flights, `FLIGHT_GAP_US` apart. `index` holds `step_t_us`, `step_end_us`
        and `step_flight` (start and end [us] and flight number of each step).
    """
    parts: list[np.ndarray] = []
    steps: list[tuple[int, int, int]] = []
    clock_us, flight = 0, 0
    for config, num_steps, flown_by in stints(flights, policy, policy_share):
        actions, draws = (np.random.SeedSequence([seed, len(parts), stream]) for stream in (1, 2))
        agent = make_agent(str(flown_by), "stochastic") if flown_by else HoldingAgent(actions)
        flight_seeds = np.random.default_rng(draws)
        blind = agent.observation in WITHOUT_EVENTS  # its flights are recorded with events all the same
        env = CorridorEnv(config, observation="events" if blind else agent.observation)
        started = env.reset(seed=seed, options={"episode": POLICY_EPISODES if flown_by else 0})
        flown = 0
        while flown < num_steps:
            agent.reset([env], [int(flight_seeds.integers(2**63))])
            flight_events, ends_us = fly_once(env, agent, started, num_steps - flown)
            for events in flight_events:
                shifted = events.copy()
                shifted["t"] += clock_us
                parts.append(shifted)
            steps += [
                (clock_us + start, clock_us + end, flight)
                for start, end in zip([0, *ends_us], ends_us, strict=False)
            ]
            flown += len(ends_us)
            flight += 1
            clock_us += ends_us[-1] + FLIGHT_GAP_US
            advance(len(ends_us))
            started = env.reset()
        env.close()
    start, end, number = np.array(steps, dtype=np.int64).T
    settings = sensor_settings(flights[0][0])
    about = {
        "sensor": settings,
        "sensor_hash": settings_hash(settings),
        "scenes": [config.scene for config, _ in flights],
        "faults": [dataclasses.asdict(config.faults) for config, _ in flights],
        "seed": seed,
        "flights": flight,
        "policy": None if policy is None else str(policy),
        "policy_share": 0.0 if policy is None else policy_share,
    }
    index = {"step_t_us": start, "step_end_us": end, "step_flight": number}
    return Recording(np.concatenate([np.empty(0, EVENT), *parts]), index, about)


def stints(
    flights: Sequence[tuple[EnvConfig, int]], policy: Path | None, policy_share: float
) -> list[tuple[EnvConfig, int, Path | None]]:
    """What each agent flies of each scene: environment, control steps, and the policy or None for random."""
    parts = []
    for config, num_steps in flights:
        of_policy = 0 if policy is None else round(policy_share * num_steps)
        parts += [(config, num_steps - of_policy, None), (config, of_policy, policy)]
    return [part for part in parts if part[1] > 0]


class HoldingAgent:
    """Any action with the same probability, held for 2 m on average; for one flight at once."""

    observation: Observation = "events"

    def __init__(self, seed: np.random.SeedSequence) -> None:
        """Draw the actions of all flights from one stream."""
        self._rng = np.random.default_rng(seed)

    def reset(self, envs: Sequence[CorridorEnv], seeds: Sequence[int]) -> None:
        """Draw the first action; the stream goes on from flight to flight."""
        config = envs[0].config
        self._hold_steps = max(1.0, MEAN_HOLD_M * config.control_hz / config.speed_mps)
        self._action = self._rng.integers(NUM_ACTIONS)

    def __call__(self, observations: np.ndarray, infos: Sequence[Mapping[str, Any]]) -> np.ndarray:
        """The action, int (1,)."""
        if self._rng.random() < 1.0 / self._hold_steps:
            self._action = self._rng.integers(NUM_ACTIONS)
        return np.array([self._action])


def fly_once(
    env: CorridorEnv, agent: Agent, started: tuple[np.ndarray, Mapping[str, Any]], most_steps: int
) -> tuple[list[np.ndarray], list[int]]:
    """One flight of an environment and an agent that were just reset; `started` is what the reset gave.

    Returns:
        The events of each step, and the time at which each step ended [us since take-off].
    """
    events, ends_us = [], []
    for end_us in steps_of(env, agent, started, most_steps):
        events.append(env.events)
        ends_us.append(end_us)
    return events, ends_us


def steps_of(
    env: CorridorEnv, agent: Agent, started: tuple[np.ndarray, Mapping[str, Any]], most_steps: int
) -> Iterator[int]:
    """The steps of such a flight, for who wants to look at the environment after each one.

    Yields:
        The time at which the step ended [us since take-off].
    """
    observation, info = started
    for _ in range(most_steps):
        shown = env.luminance if agent.observation == "luminance" else observation
        action = int(agent(shown[None], [cast(StepInfo, info)])[0])
        observation, _, terminated, truncated, info = env.step(action)
        yield int(info["t_us"])
        if terminated or truncated:
            break
