"""Record the events of episodes in training corridors, with random actions and, if named, a policy.

Recordings of real cameras (`collect.recordings`) supplement the episodes or replace them.

Run: python -m platform.launch +exp=collect
Expect: about 3,000 control steps per second on one core; `data/train.h5` and
`data/validation.h5` in the run folder, whole episodes that differ between the two files. If the encoder
learns to denoise, `train_true.h5` and `validation_true.h5` have the same steps before the sensor's faults.
"""

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from envs.config import WITHOUT_EVENTS, EnvConfig, Observation, Split, sensor_settings, settings_hash
from envs.corridor import CorridorEnv, Info
from envs.events import EVENT
from envs.recordings import Recording, write_recording
from envs.scene import Scene
from envs.scene.paths import bodies_at
from envs.scene.range_scan import sector_proximity
from jobs.config.conditions import episode_draw
from jobs.config.config import Config, ConfigError
from jobs.rollout.agents import Agent, make_agent, num_actions
from jobs.rollout.diagnostics import report_event_error
from jobs.rollout.policies import load_trained
from jobs.run.checkpoints import seal
from jobs.run.folder import Run, finish, finished, locate_run, open_run
from jobs.run.progress import progress
from jobs.run.recordings import refusing
from jobs.tracking.tracker import Tracker, open_tracker
from jobs.training.real_recordings import GAP_US, Recorded, no_episodes, read_recorded, with_recorded
from models.encoder.evae import SECTORS

MEAN_HOLD_M = 2.0
PROXIMITY_ONE = 65_535  # stored value of proximity 1
POLICY_EPISODES = 10**6  # number of a policy's first episode; random actions get other corridors


def run(config: Config) -> dict[str, float]:
    """Collect the data sets of a run; return their metrics."""
    check_collect(locate_run(config))
    folder = open_run(config)
    with open_tracker(folder.config, folder) as tracker:
        return collect(folder, tracker)


def collect(folder: Run, tracker: Tracker) -> dict[str, float]:
    """Write the training and validation recordings of a run if they are missing; return their metrics."""
    done = finished(folder, "collect")
    if done is not None:
        return done
    config = folder.config
    policy, recorded = check_collect(folder)
    sizes: dict[Split, int] = {
        "train": config.collect.num_steps,
        "validation": config.collect.num_validation_steps,
    }
    figures: dict[str, float] = {}
    with progress("Collect", sum(sizes.values()), "steps") as advance:
        for split, num_steps in sizes.items():
            scenes = config.collect.scenes
            parts = np.array_split(np.arange(num_steps), len(scenes) + len(recorded))
            shares = [len(part) for part in parts]
            own = [
                (dataclasses.replace(config.env, scene=scene, split=split, observation="events"), share)
                for scene, share in zip(scenes, shares, strict=False)
            ]
            denoise = learns_to_denoise(config)
            made = [no_episodes(config.env)] * (1 + denoise)
            if own:
                by_policy = policy, config.collect.policy_share
                drawn, sectors = config.collect.conditions, SECTORS * knows_truth(config)
                made = record(own, config.seed, advance, *by_policy, drawn, denoise, sectors)
            if recorded:
                taken = list(zip([part[split] for part in recorded], shares[len(scenes) :], strict=True))
                made = [with_recorded(one, taken) for one in made]
            for name, one in zip((split, f"{split}_true"), made, strict=False):
                write_recording(data_file(folder, name), one)
            figures[f"collect/{split}_events"] = len(made[0].events)
            figures[f"collect/{split}_episodes"] = made[0].about["flights"]
            del made  # frees gigabytes before the next split is recorded
    seal(folder.data)
    if config.collect.scenes:
        figures |= report_event_error(dataclasses.replace(config.env, scene=config.collect.scenes[0]))
    tracker.log(0, figures)
    return finish(folder, "collect", figures)


def data_file(folder: Run, split: str) -> Path:
    """Return the path of a split's recording in a run folder."""
    return folder.data / f"{split}.h5"


def check_collect(folder: Run) -> tuple[Path | None, list[dict[str, Recorded]]]:
    """Return the policy and the recordings that a run has yet to collect from; None and [] once collected.

    Raises:
        ConfigError: `collect.policy` or `collect.recordings` names a file that does not fit.
    """
    if finished(folder, "collect") is not None:
        return None, []
    config, settings = folder.config, folder.config.collect
    named = settings.policy
    policy = None if named is None else load_trained("collect.policy", named, config.env)[0]
    if settings.recordings and knows_truth(config):
        rule = "must be [] for model.target=proximity, which only a simulator knows; take target=occupancy"
        raise ConfigError(f"collect.recordings: {rule}, got {settings.recordings}")
    share = settings.num_validation_steps / (settings.num_steps + settings.num_validation_steps)
    read: list[dict[str, Recorded]] = []
    for path in settings.recordings:
        with refusing("collect.recordings", path):
            read.append(read_recorded(path, config.env, share, config.recording))
    return policy, read


def knows_truth(config: Config) -> bool:
    """Whether only the simulator knows the encoder's target (proximity)."""
    return getattr(config.model, "target", None) == "proximity"


def check_pictures(config: Config) -> None:
    """Check that the encoder of a run decodes event pictures, for studies that compare event pictures.

    Raises:
        ConfigError: The encoder decodes proximity.
    """
    if knows_truth(locate_run(config).config):
        rule = "must be a picture of events for this study: occupancy, signed, aged or counts"
        raise ConfigError(f"model.target: {rule}, got 'proximity'")


def learns_to_denoise(config: Config) -> bool:
    """Whether the encoder decodes the events before the sensor's faults; never if it decodes proximity."""
    return config.pretrain.denoise and not knows_truth(config)


def record(
    shares: Sequence[tuple[EnvConfig, int]],
    seed: int,
    advance: Callable[[int], None],
    policy: Path | None = None,
    policy_share: float = 0.5,
    conditions: Sequence[Mapping[str, Any]] = ({},),
    keep_true: bool = False,
    sectors: int = 0,
) -> list[Recording]:
    """Roll out each environment for a number of control steps; join all episodes on one clock.

    Args:
        shares: Environment and number of control steps [-], one pair per scene.
        seed: Seed of corridors and actions.
        advance: Called with the number of steps after each episode.
        policy: Folder of a policy that acts in a share of the steps, in whole episodes of its own,
            sampling its actions as in training; None: all actions are random.
        policy_share: The policy's share of the steps, 0..1.
        conditions: Conditions of which each episode draws one.
        keep_true: Whether to record the events before the sensor's faults as well.
        sectors: Number of sectors of the field of view in which to record the proximity of obstacles at the
            end of each step; 0: proximity is not recorded.

    Returns:
        The observed events of all episodes, `GAP_US` apart; with `keep_true` a second recording of the events
        before the faults. `index` has `step_t_us`, `step_end_us` and `step_flight` (start and end [us] and
        episode number of each step) and, with `sectors`, `step_proximity`, uint16 (steps * sectors,), in
        units of 1 / `PROXIMITY_ONE`.
    """
    tape, near = _Tape([EventBlock() for _ in range(1 + keep_true)]), list[np.ndarray]()
    for config, num_steps, by_policy in stints(shares, policy, policy_share):
        actions, draws = (np.random.SeedSequence([seed, len(tape.steps), stream]) for stream in (1, 2))
        agent = make_agent(str(by_policy), "stochastic") if by_policy else HoldingAgent(actions)
        env = CorridorEnv(config, observation=_shown_to(agent), draw=episode_draw(conditions))
        agent_seeds, taken = np.random.default_rng(draws), 0
        started = env.reset(seed=seed, options={"episode_number": POLICY_EPISODES if by_policy else 0})
        while taken < num_steps:
            agent.reset([env], [int(agent_seeds.integers(2**63))])
            events, true_events, ends_us, proximity = run_episode(
                env, agent, started, num_steps - taken, sectors
            )
            near += proximity
            tape.add(events, true_events, ends_us)
            taken += len(ends_us)
            advance(len(ends_us))
            started = env.reset()
        env.close()
    start, end, number = np.array(tape.steps, dtype=np.int64).T
    settings = sensor_settings(shares[0][0])
    about = {
        "sensor": settings,
        "sensor_hash": settings_hash(settings),
        "scenes": [config.scene for config, _ in shares],
        "conditions": [dict(condition) for condition in conditions],
        "faults": [dataclasses.asdict(config.faults) for config, _ in shares],
        "seed": seed,
        "flights": tape.episodes,
        "policy": None if policy is None else str(policy),
        "policy_share": 0.0 if policy is None else policy_share,
    }
    index = {"step_t_us": start, "step_end_us": end, "step_flight": number}
    if sectors:
        index["step_proximity"] = np.concatenate(near)
    return [Recording(block.events, index, about) for block in tape.blocks]


class EventBlock:
    """Events in one array that grows in place, so large that its memory returns to the system when freed.

    Thousands of arrays, one per episode, would stay allocated while any small object lies between them.
    """

    def __init__(self) -> None:
        """Start without events."""
        self._room, self._size = np.empty(1 << 16, EVENT), 0

    @property
    def events(self) -> np.ndarray:
        """Return all events so far as a view; do not add events while it is in use."""
        return self._room[: self._size]

    def add(self, parts: Sequence[np.ndarray], clock_us: int) -> None:
        """Append the EVENT arrays of an episode that starts at `clock_us`."""
        size = self._size + sum(map(len, parts))
        if size > len(self._room):
            self._room.resize(max(size, 5 * len(self._room) // 4), refcheck=False)
        if size > self._size:
            new = self._room[self._size : size]
            np.concatenate(parts, out=new)
            new["t"] += clock_us
        self._size = size


@dataclass
class _Tape:
    """Episodes one after the other on one clock: their events; start, end and episode of each step.

    Attributes:
        blocks: The observed events and, in a second block if there is one, the events before the faults.
    """

    blocks: list[EventBlock]
    steps: list[tuple[int, int, int]] = field(default_factory=list)
    clock_us: int = 0
    episodes: int = 0

    def add(
        self, events: Sequence[np.ndarray], true_events: Sequence[np.ndarray], ends_us: Sequence[int]
    ) -> None:
        """Append an episode: the events and the end [us since the episode's start] of each step."""
        for block, parts in zip(self.blocks, (events, true_events), strict=False):
            block.add(parts, self.clock_us)
        for start, end in zip([0, *ends_us], ends_us, strict=False):
            self.steps.append((self.clock_us + start, self.clock_us + end, self.episodes))
        self.episodes += 1
        self.clock_us += ends_us[-1] + GAP_US


def _shown_to(agent: Agent) -> Observation:
    """Return the observation of an agent's environment; "events" for an agent that sees no events."""
    return "events" if agent.observation in WITHOUT_EVENTS else agent.observation


def stints(
    shares: Sequence[tuple[EnvConfig, int]], policy: Path | None, policy_share: float
) -> list[tuple[EnvConfig, int, Path | None]]:
    """Split each share into environment, control steps and policy; the policy is None for random actions."""
    parts = []
    for config, num_steps in shares:
        of_policy = 0 if policy is None else round(policy_share * num_steps)
        parts += [(config, num_steps - of_policy, None), (config, of_policy, policy)]
    return [part for part in parts if part[1] > 0]


class HoldingAgent:
    """Draws actions uniformly and holds each for 2 m on average; for one episode at a time."""

    observation: Observation = "events"

    def __init__(self, seed: np.random.SeedSequence) -> None:
        """Draw the actions of all episodes from one stream."""
        self._rng = np.random.default_rng(seed)

    def reset(self, envs: Sequence[CorridorEnv], seeds: Sequence[int]) -> None:
        """Draw the first action; the stream continues from episode to episode."""
        config, self._count = envs[0].config, num_actions(envs[0])
        self._hold_steps = max(1.0, MEAN_HOLD_M * config.control_hz / config.speed_mps)
        self._action = self._rng.integers(self._count)

    def keep(self, places: np.ndarray) -> None:
        """Do nothing: the one episode has ended."""

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        """Return the action, int (1,)."""
        if self._rng.random() < 1.0 / self._hold_steps:
            self._action = self._rng.integers(self._count)
        return np.array([self._action])


def run_episode(
    env: CorridorEnv, agent: Agent, started: tuple[np.ndarray, Info], most_steps: int, sectors: int = 0
) -> tuple[list[np.ndarray], list[np.ndarray], list[int], list[np.ndarray]]:
    """Run one episode of an environment and an agent after their reset; `started` is the reset's result.

    Returns:
        For each step: the observed events, the events before the sensor's faults, the end of the step
        [us since the start] and, with `sectors`, the proximity of obstacles as in `record`.
    """
    events, true_events, ends_us, near = [], [], [], []
    for end_us in steps_of(env, agent, started, most_steps):
        events.append(env.seen_events)
        true_events.append(env.true_events)
        ends_us.append(end_us)
        if sectors:
            scene = at_rest(env.scene, bodies_at(env.moving, 1e-6 * end_us))
            scan = sector_proximity(scene, env.camera_pose(), env.config.camera.fov_deg, sectors)
            near.append(np.rint(PROXIMITY_ONE * scan).astype(np.uint16))
    return events, true_events, ends_us, near


def at_rest(scene: Scene, bodies: np.ndarray) -> Scene:
    """Return a scene whose moving bodies are replaced by standing ones, `bodies` OBSTACLE (N,)."""
    if not len(bodies):
        return scene
    standing = np.concatenate([scene.obstacles, bodies])
    return dataclasses.replace(scene, obstacles=standing, moving=(), throws=None)


def steps_of(
    env: CorridorEnv, agent: Agent, started: tuple[np.ndarray, Info], most_steps: int
) -> Iterator[int]:
    """Run the episode of `run_episode` step by step; the caller can read the environment after each step.

    Yields:
        The end of the step [us since the start].
    """
    observation, info = started
    for _ in range(most_steps):
        shown = env.luminance if agent.observation == "luminance" else observation
        action = int(agent(shown[None])[0])
        observation, _, terminated, truncated, info = env.step(action)
        yield int(info["t_us"])
        if terminated or truncated:
            break
