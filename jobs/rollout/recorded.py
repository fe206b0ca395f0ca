"""One episode of a policy with its observations and actions, for films and pages."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from envs.config import WITHOUT_EVENTS, EnvConfig
from envs.corridor import CorridorEnv
from envs.events import event_image
from envs.scene import Scene
from jobs.rollout.agents import PolicyAgent
from jobs.rollout.episodes import roll_out


class Moment(NamedTuple):
    """One action of a policy, with the input that led to it.

    Attributes:
        luminance: The camera's image, float32 (H, W), linear.
        events: The last event of each pixel in this control step, as `envs.events.event_image` codes it,
            uint8 (H, W); None for a policy that sees no events.
        num_events: Events of this control step, faults included [-].
        observation: The policy's observation.
        latent: The encoder's latent of this observation, float32 (L,); None for a policy without encoder.
        probabilities: Probabilities of the actions, float64 (K,).
        action: The action taken.
        x_m, y_m: Position of the vehicle [m].
        t_us: Simulated time [us].
    """

    luminance: np.ndarray
    events: np.ndarray | None
    num_events: int
    observation: np.ndarray
    latent: np.ndarray | None
    probabilities: np.ndarray
    action: int
    x_m: float
    y_m: float
    t_us: int


@dataclasses.dataclass(frozen=True)
class RecordedEpisode:
    """An episode with one moment per step.

    Attributes:
        episode: EPISODE (), the same as in an evaluation.
        moments: Input and action of each step.
        scene: The corridor.
        env: The simulation.
    """

    episode: np.void
    moments: list[Moment]
    scene: Scene
    env: EnvConfig


def record_episode(agent: PolicyAgent, env: EnvConfig, seed: int) -> RecordedEpisode:
    """Roll out and record the episode of one seed; recording does not change the episode."""
    recorder = _Recorder(agent)
    (episode,) = roll_out(recorder, env, [seed])
    return RecordedEpisode(episode, recorder.moments, recorder.env.scene, recorder.env.config)


class _Recorder:
    """An agent that acts like another agent and records its moments."""

    def __init__(self, agent: PolicyAgent) -> None:
        self.agent, self.observation = agent, agent.observation
        self.moments: list[Moment] = []

    def reset(self, envs: Sequence[CorridorEnv], seeds: Sequence[int]) -> None:
        """Start one episode."""
        (self.env,) = envs
        self.agent.reset(envs, seeds)

    def keep(self, places: np.ndarray) -> None:
        """Do nothing: the only episode has ended."""

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        """Return the agent's action (1,), and record the moment."""
        actions, env = self.agent(observations), self.env
        info = env.info()
        encoder, (logits,) = self.agent.policy.encoder, self.agent.logits
        weights = np.exp(logits - logits.max())
        height, width = env.luminance.shape
        sees_events = self.observation not in WITHOUT_EVENTS
        self.moments.append(
            Moment(
                luminance=env.luminance.copy(),
                events=event_image(env.events, width, height) if sees_events else None,
                num_events=info["num_events"],
                observation=observations[0].copy(),
                latent=None if encoder is None else encoder.encode_windows(observations)[0],
                probabilities=weights / weights.sum(),
                action=int(actions[0]),
                x_m=info["x_m"],
                y_m=info["y_m"],
                t_us=info["t_us"],
            )
        )
        return actions
