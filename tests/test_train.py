import dataclasses
import json
import math
import os
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import hydra
import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from ray.rllib.core.rl_module.rl_module import RLModule
from ray.rllib.env.single_agent_env_runner import SingleAgentEnvRunner

from envs.config import sensor_settings, settings_hash
from jobs import train as training
from jobs.cluster import use_token
from jobs.config import ConfigError, parse
from jobs.ppo import FlightMetrics, build_ppo, network_settings
from jobs.runs import open_run
from jobs.train import TrainingError, read_metrics, reported_so_far
from models.evae import EventVAE
from models.policy import load_policy, save_policy
from models.table import EncoderTable
from models.weights import load_encoder, save_encoder

ROOT = Path(__file__).resolve().parents[1]
# Seven steps to a flight: every flight is truncated, and no chunk of samples ends with one.
SHORT = ("env.time_limit_s=0.035", "algo.num_envs_per_env_runner=2", "algo.reward_scale=0.5")


def make_config(*overrides):
    with hydra.initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        composed = hydra.compose("config", ["+exp=train", *overrides])
    values = OmegaConf.to_container(composed, resolve=True)
    values.pop("hydra", None)
    return parse(values)


def write_encoder(folder, config):
    torch.manual_seed(0)
    evae = EventVAE(variant=config.model.name)
    for parameter in evae.ecn.parameters():  # random weights see little; make latents differ
        parameter.data.mul_(1.5)
    sensor = sensor_settings(config.env_config())
    path = folder / "encoder.safetensors"
    save_encoder(path, evae.freeze(), {"sensor": sensor, "sensor_hash": settings_hash(sensor)})
    return path


@pytest.fixture(scope="module")
def encoder(tmp_path_factory):
    return write_encoder(tmp_path_factory.mktemp("encoder"), make_config())


@pytest.fixture(scope="module")
def ppo(encoder):
    return build_ppo(make_config(*SHORT), encoder)


class Recorder:
    """Stands between an env runner and its environments; remembers what they showed."""

    def __init__(self, runner):
        self.env, self.flights = runner.env.unwrapped, {}
        self.reset, self.step = self.env.reset, self.env.step
        self.env.reset = lambda **kwargs: self.keep(self.reset(**kwargs))
        self.env.step = lambda actions: self.keep(self.step(actions))

    def keep(self, results):
        observations, infos = results[0], results[-1]
        for row, window in enumerate(observations):
            flight = infos["episode_seed"][row], infos["episode"][row]
            self.flights.setdefault(flight, []).append(window.copy())
        return results

    def stacks(self, table):
        """(seed, episode, step) -> the last three latents, by a plain loop."""
        found = {}
        for flight, windows in self.flights.items():
            latents = list(table.encode_windows(np.array(windows)))
            for step in range(len(latents)):
                last = [latents[max(0, step - back)] for back in (2, 1, 0)]
                found[(*flight, step)] = np.concatenate(last)
        return found


def keys(chunk, control_hz=200.0):
    """(seed, episode, step) of a chunk's observations."""
    infos = chunk.get_infos()
    return [(info["episode_seed"], info["episode"], round(info["t_us"] * control_hz / 1e6)) for info in infos]


@pytest.fixture
def runner(ppo):
    runner = SingleAgentEnvRunner(config=ppo, worker_index=0)
    yield runner
    runner.stop()


def learner_batch(learner, samples, monkeypatch, **updates):
    """What the value network is asked about the whole batch, before the first epoch."""
    module, batches = learner.module["default_policy"], []
    compute = module.compute_values
    watch = lambda batch, **kwargs: batches.append(batch) or compute(batch, **kwargs)  # noqa: E731
    monkeypatch.setattr(module, "compute_values", watch)
    learner.update(episodes=samples, **{"num_epochs": 1, "minibatch_size": 32, **updates})
    return batches[0]


def test_the_settings_are_those_of_the_appendix(encoder):
    config = make_config("budget=paper")
    built = build_ppo(config, encoder)
    built.validate()
    stated = {
        "lr": 3e-4,
        "gamma": 0.99,
        "lambda_": 0.95,
        "clip_param": 0.2,
        "num_epochs": 10,
        "minibatch_size": 32,
        "train_batch_size_per_learner": 2048,
        "vf_loss_coeff": 0.5,
        "grad_clip": 0.5,
        "entropy_coeff": 0.0,
        "vf_clip_param": math.inf,
        "use_kl_loss": False,
        "kl_coeff": 0.0,
        "grad_clip_by": "global_norm",
    }
    spec = built.rl_module_spec
    learner = built.build_learner(spaces={"default_policy": (spec.observation_space, spec.action_space)})
    assert {name: getattr(learner.config, name) for name in stated} == stated
    assert network_settings(config) == {"stack": 3, "latent": 8, "hidden": [64, 64], "num_actions": 3}
    assert learner.module["default_policy"].observation_space.shape == (24,)


def test_each_window_is_encoded_exactly_once(runner):
    recorder, rows = Recorder(runner), []
    encode = runner.module.encode
    runner.module.encode = lambda windows: rows.append(len(windows)) or encode(windows)
    samples = [chunk for _ in range(2) for chunk in runner.sample(num_timesteps=30)]
    steps = sum(len(chunk) for chunk in samples)
    shown = sum(len(windows) for windows in recorder.flights.values())
    assert steps >= 60
    assert sum(rows) == shown == steps + len(recorder.flights)
    assert max(rows) == 2


def test_the_learner_sees_the_latents_of_the_windows_that_were_shown(runner, ppo, encoder, monkeypatch):
    recorder = Recorder(runner)
    learner = ppo.build_learner(env=runner.env)
    table = EncoderTable.from_evae(load_encoder(encoder)[0])
    truncated = cut = 0
    for _ in range(3):
        samples = runner.sample(num_timesteps=31)
        shown = [key for chunk in samples for key in keys(chunk)]
        rewards = np.concatenate([[*chunk.get_rewards(), 0.0] for chunk in samples])
        truncated += sum(chunk.is_truncated for chunk in samples)
        cut += sum(not chunk.is_done for chunk in samples)
        batch = learner_batch(learner, samples, monkeypatch)
        stacks = recorder.stacks(table)
        np.testing.assert_array_equal(batch["obs"].numpy(), [stacks[key] for key in shown])
        np.testing.assert_allclose(batch["rewards"].numpy(), 0.5 * rewards, rtol=1e-6)
    assert truncated >= 6
    assert cut >= 3
    assert len({tuple(row) for row in stacks.values()}) > 30


def test_training_moves_the_networks_and_never_the_encoder(runner, ppo, encoder):
    learner = ppo.build_learner(env=runner.env)
    module = learner.module["default_policy"]
    before = {name: value.clone() for name, value in module.state_dict().items()}
    learner.update(episodes=runner.sample(num_timesteps=64), num_epochs=2, minibatch_size=32)
    runner.set_state({"rl_module": learner.get_state(components="rl_module")["rl_module"]})
    after, flying = module.state_dict(), runner.module.state_dict()
    whole = load_encoder(encoder)[0].state_dict()
    for name, value in before.items():
        frozen = name.startswith("encoder.")
        assert torch.equal(after[name], value) is frozen, name
        if frozen:
            assert torch.equal(value, whole[name.removeprefix("encoder.")]), name
        if name in flying:
            assert torch.equal(flying[name], after[name]), name
    trained = sum(value.numel() for value in module.parameters())
    assert trained == 2 * (24 * 64 + 64 + 64 * 64 + 64) + (64 * 3 + 3) + (64 + 1)
    assert not any(part.training for part in module.encoder.modules())


def test_a_weight_sync_keeps_the_table_and_another_encoder_replaces_it(runner):
    windows = np.zeros((1, 4097, 4), np.int32)
    windows[0, :2] = [1, 0, 5000, 0], [4000, 20, 30, 1]
    latent = runner.module.encode(windows)
    table, state = runner.module._table, runner.module.get_state()
    runner.module.set_state(state)
    assert runner.module._table is table
    state["encoder.encoder.2.bias"] = state["encoder.encoder.2.bias"] + 1
    runner.module.set_state(state)
    np.testing.assert_allclose(runner.module.encode(windows), latent + 1, atol=1e-5)


def test_a_module_checkpoint_alone_restores_encoder_and_logits(runner, ppo, encoder, tmp_path, monkeypatch):
    module = ppo.build_learner(env=runner.env).module["default_policy"]
    module.save_to_path(tmp_path / "module")
    monkeypatch.setattr("models.networks.load_encoder", lambda path: (_ for _ in ()).throw(file_gone()))
    restored = RLModule.from_checkpoint(tmp_path / "module")
    for name, value in module.state_dict().items():
        assert torch.equal(restored.state_dict()[name], value), name
    window = np.zeros((1, 4097, 4), np.int32)
    window[0, 0, 2] = 5000
    np.testing.assert_array_equal(restored.encode(window), runner.module.encode(window))


def file_gone():
    from models.weights import EncoderFileError

    return EncoderFileError("gone")


def test_the_exported_policy_gives_the_logits_of_the_path_through_rllib(runner, ppo, encoder, tmp_path):
    module = ppo.build_learner(env=runner.env).module["default_policy"]
    config = make_config(*SHORT)
    manifest = {**network_settings(config), "sensor": {}, "sensor_hash": ""}
    heads = {"pi": module.pi, "vf": module.vf}
    policy = load_policy(save_policy(tmp_path, load_encoder(encoder)[0], heads, manifest))
    recorder = Recorder(runner)
    samples = [chunk for _ in range(2) for chunk in runner.sample(num_timesteps=40)]
    compared = 0
    for chunk in samples:
        for (seed, episode, step), logits in zip(
            keys(chunk), chunk.get_extra_model_outputs("action_dist_inputs"), strict=False
        ):
            policy.reset(1)
            for window in recorder.flights[seed, episode][: step + 1]:
                own = policy.logits(window[None])[0]
            np.testing.assert_allclose(own, logits, rtol=0, atol=1e-6)
            compared += 1
    assert compared >= 80


def test_returns_are_reported_unscaled(runner):
    done = [chunk for chunk in runner.sample(num_timesteps=16) if chunk.is_done]
    metrics = runner.get_metrics()
    metrics = {name: getattr(value, "peek", lambda value=value: value)() for name, value in metrics.items()}
    assert metrics["flight_return"] == pytest.approx(np.mean([chunk.get_return() for chunk in done]))
    distances = [chunk.get_infos(-1)["distance_m"] for chunk in done]
    assert metrics["distance_m"] == pytest.approx(np.mean(distances))
    assert metrics["flight_return"] == pytest.approx(metrics["distance_m"])  # no bonus: truncated
    assert metrics["success_rate"] == metrics["collision_rate"] == 0.0
    assert metrics["dropped_events"] == 0.0
    assert metrics["events_per_step"] > 0.0


def test_the_same_seed_gives_the_same_flights(ppo):
    runs = []
    for _ in range(2):
        runner = SingleAgentEnvRunner(config=ppo, worker_index=0)
        runs.append(runner.sample(num_timesteps=30))
        runner.stop()
    for one, other in zip(*runs, strict=True):
        np.testing.assert_array_equal(one.get_observations(), other.get_observations())
        np.testing.assert_array_equal(one.get_actions(), other.get_actions())


def test_an_encoder_of_another_sensor_is_refused_with_both_values(encoder):
    with pytest.raises(ConfigError, match=r"another sensor.*contrast_threshold: 0\.2 there, 0\.3 here"):
        build_ppo(make_config("camera.contrast_threshold=0.3"), encoder)


def result(**learner):
    losses = {
        "policy_loss": 0.1,
        "vf_loss": 2.0,
        "vf_explained_var": 0.5,
        "entropy": 1.0,
        "gradients_default_optimizer_global_norm": 0.7,
    }
    return {
        "num_env_steps_sampled_lifetime": 4096,
        "time_this_iter_s": 2.0,
        "env_runners": {
            "num_env_steps_sampled": 2048,
            "flight_return": 12.5,
            "num_episodes_lifetime": 3,
        },
        "learners": {"default_policy": losses | learner},
        "fault_tolerance": {"num_remote_worker_restarts": 0},
    }


def test_metrics_are_read_from_a_result_and_what_was_not_measured_is_nan():
    metrics = read_metrics(result())
    assert metrics["train/episode_return"] == 12.5
    assert metrics["train/value_loss"] == 2.0
    assert metrics["perf/env_steps_per_second"] == 1024.0
    assert math.isnan(metrics["train/success_rate"])
    assert 12 <= len(metrics) <= 16


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_loss_that_is_not_finite_stops_the_training(bad):
    with pytest.raises(TrainingError, match=r"train/value_loss = .* at environment step 4096"):
        read_metrics(result(vf_loss=bad))


def test_a_results_file_cut_by_a_kill_counts_its_whole_lines(tmp_path):
    file = tmp_path / "results.jsonl"
    assert reported_so_far(file)[0] == 0
    file.write_text('{"env_steps": 64}\n{"env_steps": 128}\n{"env_st')
    assert reported_so_far(file)[0] == 128


def test_half_a_line_left_by_a_kill_is_not_written_on_to(tmp_path):
    config = make_config(f"runs_dir={tmp_path}")
    folder = open_run(config)
    file = folder.train / "results.jsonl"
    file.parent.mkdir(parents=True)
    file.write_text('{"env_steps": 64, "train/entropy": 0.5}\n{"env_st')
    with training._listening(config, folder, lambda step, metrics: None) as last:
        assert last == {"train/entropy": 0.5}
        training._LISTENERS[training.LISTENER]({**result(), "num_env_steps_sampled_lifetime": 128})
    assert [json.loads(line)["env_steps"] for line in file.read_text().splitlines()] == [64, 128]


def test_a_step_is_reported_once_even_after_a_restart(tmp_path):
    config = make_config(f"runs_dir={tmp_path}")
    folder, seen = open_run(config), []
    for steps in ((64, 128), (128, 192)):
        with training._listening(config, folder, lambda step, metrics: seen.append(step)) as last:
            for step in steps:
                training._LISTENERS[training.LISTENER]({**result(), "num_env_steps_sampled_lifetime": step})
    assert seen == [64, 128, 192]
    assert last["train/episode_return"] == 12.5
    lines = (folder.train / "results.jsonl").read_text().splitlines()
    assert [json.loads(line)["env_steps"] for line in lines] == seen
    assert json.loads(lines[0])["train/success_rate"] is None
    assert training._LISTENERS == {}


def test_the_token_of_a_local_ray_can_be_read_by_its_owner_alone(tmp_path, monkeypatch):
    monkeypatch.delenv("RAY_AUTH_TOKEN_PATH", raising=False)
    monkeypatch.delenv("RAY_AUTH_TOKEN", raising=False)
    monkeypatch.setenv("HOME", "/nowhere")
    file = tmp_path / ".ray" / "token"
    use_token(file)
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert stat.S_IMODE(file.parent.stat().st_mode) == 0o700
    assert os.environ["RAY_AUTH_TOKEN_PATH"] == str(file)
    token = file.read_text()
    use_token(tmp_path / "other")
    assert file.read_text() == token
    assert len(token) == 64
    assert not (tmp_path / "other").exists()


TINY = (
    *SHORT,
    "algo.train_batch_size_per_learner=64",
    "algo.num_epochs=1",
    "train.env_steps=4000",
    "train.checkpoint_every=1",
)
SCRIPT = """
import sys
from pathlib import Path
sys.path.insert(0, "tests")
from jobs.train import train
from test_train import TINY, make_config, open_run
config = make_config(*TINY, f"runs_dir={sys.argv[1]}")
train(config, open_run(config), Path(sys.argv[2]), lambda step, metrics: None)
"""


def test_a_killed_training_continues_and_its_policy_flies(tmp_path, encoder):
    command = [sys.executable, "-c", SCRIPT, str(tmp_path), str(encoder)]
    config = make_config(*TINY, f"runs_dir={tmp_path}")
    folder = open_run(config)
    results = folder.train / "results.jsonl"
    killed = subprocess.Popen(command, cwd=ROOT, env=os.environ | {"HOME": "/nowhere"})
    deadline = time.monotonic() + 120
    while reported_so_far(results)[0] < 400 and killed.poll() is None and time.monotonic() < deadline:
        time.sleep(0.1)
    killed.send_signal(signal.SIGKILL)
    killed.wait()
    before = reported_so_far(results)[0]
    assert 400 <= before < 4000
    subprocess.run(command, cwd=ROOT, check=True, timeout=200)
    steps = [json.loads(line)["env_steps"] for line in results.read_text().splitlines()]
    assert steps == sorted(set(steps))
    assert steps[-1] >= 4000
    episodes = [json.loads(line)["train/episodes"] for line in results.read_text().splitlines()]
    assert episodes == sorted(episodes)  # counted on, not anew
    policy = load_policy(folder.policy)
    window = np.zeros((1, 4097, 4), np.int32)
    window[0, 0, 2] = 5000
    assert np.isfinite(policy.logits(window)).all()
    assert policy.manifest["ppo"] == dataclasses.asdict(config.algo)


class Chunk:
    """A piece of an episode, as RLlib hands it to callbacks."""

    def __init__(self, name, rewards, done, success=False):
        self.id_, self.rewards, self.is_done = name, rewards, done
        self.info = {
            "num_events": 3,
            "dropped_events": 0,
            "success": success,
            "collision": not success,
            "distance_m": 7.0,
        }

    def get_return(self):
        return sum(self.rewards)

    def get_infos(self, index=None):
        return self.info if index == -1 else [self.info] * (1 + len(self.rewards))


class Logger(dict):
    def log_value(self, name, value, window):
        self[name] = value


def test_flights_count_whole_and_stay_in_the_mean_over_iterations():
    metrics, logger = FlightMetrics(), Logger()
    metrics.on_sample_end(
        metrics_logger=logger, samples=[Chunk("a", [1.0, 2.0], False), Chunk("b", [4.0], True)]
    )
    assert (logger["flight_return"], logger["success_rate"]) == (4.0, 0.0)
    metrics.on_sample_end(metrics_logger=logger, samples=[Chunk("a", [5.0], True, success=True)])
    assert (logger["flight_return"], logger["success_rate"]) == (6.0, 0.5)  # 8 for a, 4 for b
    metrics.on_sample_end(metrics_logger=logger, samples=[Chunk("c", [1.0], False)])
    assert (logger["flight_return"], logger["success_rate"]) == (6.0, 0.5)
