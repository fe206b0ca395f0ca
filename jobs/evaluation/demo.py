"""Show a policy in one held-out corridor: its result as a line of numbers, and a film.

Run: make demo, or python -m platform.launch +exp=demo demo.policy=bytestream-s1 env.scene=gates seed=3
Expect: half a minute. The film is in the run folder under `demo/`, with up to 100 frames per second of
flight, and opens if there is a display. Nothing is trained, and Ray and MLflow are not started.
"""

import dataclasses
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
from pydantic.dataclasses import dataclass

from envs.config import STRICT, EnvConfig
from jobs.analysis.demo_film import write_film
from jobs.analysis.tables import events_texts, show_table
from jobs.analysis.video import latent_decoder
from jobs.config.config import Config
from jobs.config.schema import Name
from jobs.rollout.agents import PolicyAgent
from jobs.rollout.episodes import outcome_of
from jobs.rollout.policies import EvaluatedPolicy, find_one_policy, own_sensor_differences, with_own_parts
from jobs.rollout.recorded import RecordedEpisode, record_episode
from jobs.run.compile import compile_kernels
from jobs.run.folder import locate_run, open_run
from jobs.run.progress import console
from models.policy import load_policy
from models.policy.policy import ENCODER

HEADINGS = (
    *("Policy", "Scene", "Corridor", "Success", "Ends by"),
    *("Distance [m]", "Steps", "Events/step", "Dropped", "Time [s]"),
)


@dataclass(frozen=True, config=STRICT)
class Settings:
    """The policy to demonstrate: a name in models/pretrained, "newest", or a path."""

    policy: Name


def find_shown(config: Config) -> tuple[EvaluatedPolicy, EnvConfig, PolicyAgent]:
    """Find the policy and the environment that `config` names.

    Returns:
        The policy; the held-out corridors, with the filter and the vehicle of its training; and its agent,
        which takes the likeliest or drawn actions, as `evaluate.action` says.

    Raises:
        ConfigError: There is no such policy.
    """
    policy = find_one_policy("demo.policy", config.own.policy, config, locate_run(config))
    asked = dataclasses.replace(config.env, split="eval")
    env = with_own_parts(policy, asked)
    if env.vehicle != asked.vehicle:
        env = at_own_pace(policy, env)
    return policy, env, PolicyAgent(load_policy(policy.agent), config.evaluate.action == "stochastic")


def at_own_pace(policy: EvaluatedPolicy, env: EnvConfig) -> EnvConfig:
    """Return the simulation with speed and control rate of a policy's training instead of the defaults.

    A configured speed or rate stays. The time limit changes with the speed, to allow the same distance.
    """
    usual = {name: getattr(env, name) == getattr(EnvConfig, name) for name in ("speed_mps", "control_hz")}
    own = {name: policy.sensor[name] for name, is_default in usual.items() if is_default}
    time_limit_s = env.time_limit_s * env.speed_mps / own.get("speed_mps", env.speed_mps)
    if own:
        said = f"{own.get('speed_mps', env.speed_mps):g} m/s, {own.get('control_hz', env.control_hz):g} Hz"
        console.print(f"As in training: {said}; vehicle={env.vehicle} keeps what is configured", markup=False)
    return dataclasses.replace(env, **own, time_limit_s=time_limit_s)


def run(config: Config) -> np.void:
    """Record one episode of `demo.policy`, print its line and write its film; return the EPISODE ().

    Raises:
        ConfigError: There is no such policy.
    """
    policy, env, agent = find_shown(config)
    compile_kernels()
    name = f"{policy.group}-s{policy.training}"
    differ = own_sensor_differences(policy, env)
    if differ:
        said = ", ".join(f"{key}={ours!r} (trained: {theirs!r})" for key, (theirs, ours) in differ.items())
        console.print(f"Another sensor than in training: {said}", markup=False)
    recorded = record_episode(agent, env, config.seed)
    show_table("One episode in a held-out corridor", HEADINGS, [line(name, recorded)], words=5)
    file = Path(policy.agent) / ENCODER
    decode = latent_decoder(Path(policy.agent)) if file.is_file() else None
    if decode is None and file.is_file():
        console.print("The policy is lean, without a decoder: the film shows its latent as numbers alone.")
    film = open_run(config).path / "demo" / f"{name}.mp4"
    write_film(film, recorded, title_of(name, env, config.seed), decode)
    console.print(f"Film: {film}", markup=False)
    show(film)
    return recorded.episode


def title_of(name: str, env: EnvConfig, seed: int) -> str:
    """Return the title of a film."""
    amounts = dataclasses.asdict(env.faults)
    amounts |= amounts.pop("added")
    faults = [f"{key} {value:g}" for key, value in amounts.items() if value]
    late = [f"actions {env.action_delay_ms:g} ms late"] if env.action_delay_ms else []
    return "   ".join([name, f"{env.scene} {seed}", f"{env.control_hz:g} Hz", *late, *faults])


def line(name: str, recorded: RecordedEpisode) -> tuple[str, ...]:
    """Return a text for each of `HEADINGS`."""
    row, env = recorded.episode, recorded.env
    return (
        *(name, env.scene, str(row["seed"]), "yes" if row["success"] else "no", outcome_of(row)),
        *(f"{row['distance_m']:.1f}", str(row["steps"])),
        *events_texts(row["events_per_step"], row["dropped"]),
        f"{row['steps'] / env.control_hz:.2f}",
    )


def show(path: Path) -> None:
    """Open a file if there is a display and a terminal; otherwise do nothing."""
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    opener = shutil.which("xdg-open")
    if display and opener and sys.stdout.isatty():
        subprocess.Popen([opener, str(path)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)  # noqa: S603
