import dataclasses

import numpy as np
import pytest

from envs.config import FaultsConfig
from envs.corridor import CorridorEnv
from envs.events import event_image
from jobs.rollout.agents import PolicyAgent, make_agent
from jobs.rollout.episodes import outcome_of, roll_out
from jobs.rollout.recorded import record_episode
from models.policy import load_policy
from tests.support.policies import HELD_OUT, save_untrained

NOISY = dataclasses.replace(HELD_OUT, time_limit_s=0.3, faults=FaultsConfig(background_activity=0.1))


@pytest.mark.parametrize(("name", "stochastic"), [("bytestream", False), ("rgb", True)])
def test_recording_changes_nothing_and_keeps_every_step(tmp_path, name, stochastic):
    folder = save_untrained(tmp_path, name=name)
    recorded = record_episode(PolicyAgent(load_policy(folder), stochastic), NOISY, 4)
    (episode,) = roll_out(make_agent(str(folder), "stochastic" if stochastic else ""), NOISY, [4])
    assert recorded.episode == episode
    assert len(recorded.moments) == episode["steps"]
    first, *others = (moment.num_events for moment in recorded.moments)
    assert first == 0
    assert sum(others) <= episode["events_per_step"] * episode["steps"]  # those of the last step come after


def test_the_recorded_actions_lead_an_environment_through_what_was_recorded(tmp_path):
    policy = load_policy(save_untrained(tmp_path))
    recorded = record_episode(PolicyAgent(policy, stochastic=True), NOISY, 2)
    env = CorridorEnv(NOISY)
    window, info = env.reset(seed=2)
    policy.reset()
    for moment in recorded.moments:
        np.testing.assert_array_equal(moment.observation, window)
        np.testing.assert_array_equal(moment.luminance, env.luminance)
        np.testing.assert_array_equal(moment.events, event_image(env.events, 64, 64))
        np.testing.assert_array_equal(moment.latent, policy.encoder.encode_windows(window[None])[0])
        assert (moment.x_m, moment.y_m, moment.t_us) == (info["x_m"], info["y_m"], info["t_us"])
        logits = policy.logits(window[None])[0].astype(np.float64)
        np.testing.assert_allclose(moment.probabilities, np.exp(logits - np.logaddexp.reduce(logits)))
        window, _, terminated, truncated, info = env.step(moment.action)
    assert terminated or truncated
    assert (recorded.episode["x_m"], recorded.episode["distance_m"]) == (info["x_m"], info["distance_m"])
    assert outcome_of(recorded.episode) == "time limit"
