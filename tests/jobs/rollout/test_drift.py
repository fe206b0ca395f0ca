import numpy as np
import pytest
import torch

from envs.config import EnvConfig
from envs.events import EVENT, pack_window
from jobs.rollout.agents import make_agent
from jobs.rollout.drift import FIGURES, MAX_WINDOWS, DriftWatch, drift_figures, mean_figures
from jobs.rollout.episodes import fly
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


def test_the_figures_are_those_of_the_windows_and_drift_is_the_ratio_to_the_encoders_own(evae):
    windows = np.stack([window(50 * n, n) for n in range(6)])
    batch = batch_packed(windows, evae.grid)
    expected = validate(evae, batch, event_targets(batch, "occupancy"))
    figures = drift_figures(evae, windows, {"reconstruction_step": 0.25})
    assert set(figures) == set(FIGURES)
    assert figures["policy_auc"] == expected["auc"]
    assert figures["policy_kl"] == expected["kl"]
    assert figures["drift"] == pytest.approx(4 * expected["reconstruction"])
    at_home = drift_figures(evae, windows, {"reconstruction_step": expected["reconstruction"]})
    assert at_home["drift"] == 1.0
    assert set(drift_figures(evae, windows, {})) == set(FIGURES) - {"drift"}


def test_windows_without_events_have_figures_too(evae):
    figures = drift_figures(evae, [window(0)[:1]] * 2, {"reconstruction_step": 0.2})
    assert np.isfinite(list(figures.values())).all()
    assert (figures["policy_auc"], figures["policy_explained_loss"]) == (0.5, 0.0)


@pytest.mark.parametrize("flights", [1, 2, 3, 7, 8, 9, 10])
def test_the_windows_kept_are_few_and_from_all_over_all_flights(tmp_path, flights):
    watch = DriftWatch(save_untrained(tmp_path / "policy"))
    for step in range(2_000):
        for seed in range(flights):
            observation = np.zeros((3, 4), np.int32)
            observation[0, 2:] = seed, step
            watch.add(None, seed, observation, {})
            assert len(watch.windows) <= MAX_WINDOWS
    seeds, steps = np.array([kept[0, 2:] for kept in watch.windows]).T
    assert len(steps) > MAX_WINDOWS / 2.5
    assert set(np.bincount(seeds, minlength=flights)) == {len(steps) // flights}
    for seed in range(flights):
        assert len(set(np.diff(steps[seeds == seed]))) == 1
        assert steps[seeds == seed][-1] > 1_900


def test_a_flown_policy_is_measured_by_the_encoder_of_its_folder_on_what_it_saw(tmp_path):
    source = save_untrained(tmp_path / "policy")
    evae, about = load_encoder(source / ENCODER)
    watch, seen = DriftWatch(source), []
    config = EnvConfig(time_limit_s=0.1, split="eval")
    agent = make_agent(str(source))
    fly(agent, config, [0, 1], watch=lambda *step: (watch.add(*step), seen.append(step[2].copy())))
    figures = drift_figures(evae, seen, {"reconstruction_step": 0.5})
    assert watch.figures() == pytest.approx(figures, rel=1e-5)
    assert about["figures"] == {"reconstruction_step": 0.5}


@pytest.mark.parametrize("name", ["event_image", "event_columns"])
def test_a_agent_without_an_event_vae_has_no_drift(tmp_path, name):
    for agent in (save_untrained(tmp_path / name, name=name), "straight"):
        watch = DriftWatch(agent)
        fly(make_agent(str(agent)), EnvConfig(time_limit_s=0.05), [0], watch=watch.add)
        assert watch.figures() == {}
        assert watch.windows == []


def test_a_measurement_takes_no_random_number(evae):
    state = torch.get_rng_state()
    drift_figures(evae, [window(20)], {})
    assert torch.equal(torch.get_rng_state(), state)


def test_encoder_figures_are_means_of_the_trainings_that_have_them():
    kept = [{"encoder": {"drift": 1.0}}, {"encoder": {"drift": 2.0}}, {"encoder": {}}]
    assert mean_figures(kept) == {"evae/drift": pytest.approx(1.5)}
