import numpy as np
import pytest
import torch

from envs.config import EnvConfig
from envs.events import EVENT, pack_window
from jobs.rollout.agents import make_agent
from jobs.rollout.diagnostics import DRIFT_METRICS, MAX_WINDOWS, DriftSampler, drift_metrics, mean_drift
from jobs.rollout.episodes import roll_out
from models.encoder.evae import EventVAE, event_targets, validate
from models.encoder.event_batch import batch_packed
from models.encoder.weights import load_encoder
from models.policy.policy import ENCODER
from tests.support.policies import save_untrained


def window(count, seed=0):
    rng = np.random.default_rng(seed)
    events = np.zeros(count, EVENT)
    events["t"] = np.sort(rng.integers(1, 5001, count))
    events["x"], events["y"], events["p"] = rng.integers(64, size=count), rng.integers(64, size=count), 1
    return pack_window(events, 0, 5000, 4096)


@pytest.fixture(scope="module", params=["bytestream", "event_image_vae"])
def evae(request):
    torch.manual_seed(0)
    return EventVAE(variant=request.param, context=16, target="occupancy").freeze()


def test_drift_metrics_are_those_of_the_windows_and_drift_is_the_ratio_to_the_encoders_own(evae):
    windows, state = np.stack([window(50 * n, n) for n in range(6)]), torch.get_rng_state()
    batch = batch_packed(windows, evae.grid)
    expected = validate(evae, batch, event_targets(batch, "occupancy"))
    metrics = drift_metrics(evae, windows, {"reconstruction_step": 0.25})
    assert set(metrics) == set(DRIFT_METRICS)
    assert (metrics["policy_auc"], metrics["policy_kl"]) == (expected["auc"], expected["kl"])
    assert metrics["drift"] == pytest.approx(4 * expected["reconstruction"])
    assert set(drift_metrics(evae, windows, {})) == set(DRIFT_METRICS) - {"drift"}
    assert torch.equal(torch.get_rng_state(), state), "a measurement takes no random number"


def test_windows_without_events_have_metrics_too(evae):
    metrics = drift_metrics(evae, [window(0)[:1]] * 2, {"reconstruction_step": 0.2})
    assert np.isfinite(list(metrics.values())).all()
    assert (metrics["policy_auc"], metrics["policy_explained_loss"]) == (0.5, 0.0)


@pytest.mark.parametrize("episodes", [1, 3, 10])
def test_the_windows_kept_are_few_and_from_all_over_all_episodes(tmp_path, episodes):
    sampler = DriftSampler(save_untrained(tmp_path / "policy"))
    for step in range(2_000):
        for seed in range(episodes):
            observation = np.zeros((3, 4), np.int32)
            observation[0, 2:] = seed, step
            sampler.add(None, seed, observation)
            assert len(sampler.windows) <= MAX_WINDOWS
    seeds, steps = np.array([kept[0, 2:] for kept in sampler.windows]).T
    assert len(steps) > MAX_WINDOWS / 2.5
    assert set(np.bincount(seeds, minlength=episodes)) == {len(steps) // episodes}
    for seed in range(episodes):
        assert len(set(np.diff(steps[seeds == seed]))) == 1
        assert steps[seeds == seed][-1] > 1_900


def test_a_policy_is_measured_by_the_encoder_of_its_folder_on_what_it_saw(tmp_path):
    source = save_untrained(tmp_path / "policy")
    evae, about = load_encoder(source / ENCODER)
    sampler, seen = DriftSampler(source), []
    config, agent = EnvConfig(time_limit_s=0.1, split="eval"), make_agent(str(source))
    roll_out(agent, config, [0, 1], watch=lambda *step: (sampler.add(*step), seen.append(step[2].copy())))
    assert sampler.metrics() == pytest.approx(drift_metrics(evae, seen, about["figures"]), rel=1e-5)


def test_an_agent_without_an_event_vae_or_with_one_for_what_a_simulator_knows_has_no_drift(tmp_path):
    for agent in (save_untrained(tmp_path / "policy", name="event_columns"), "straight"):
        sampler = DriftSampler(agent)
        roll_out(make_agent(str(agent)), EnvConfig(time_limit_s=0.05), [0], watch=sampler.add)
        assert sampler.metrics() == {}
        assert sampler.windows == []
    near = EventVAE(context=16, target="proximity").freeze()
    assert drift_metrics(near, [window(50)], {"reconstruction_step": 0.25}) == {}


def test_the_drift_of_a_group_is_the_mean_of_the_trainings_that_have_an_encoder():
    assert mean_drift([{"drift": 1.0}, {"drift": 2.0}, {}]) == {"evae/drift": pytest.approx(1.5)}
