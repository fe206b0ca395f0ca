"""The policy of a training: the specification of its networks, its manifest, and its encoder."""

import dataclasses
from pathlib import Path

from gymnasium.spaces import Discrete

from envs.config import sensor_settings, settings_hash
from envs.vehicles.dynamics import make_dynamics
from jobs.config.config import Config, ConfigError
from jobs.config.errors import differences
from jobs.config.plugins import plugin_digests
from jobs.run.files import RunError
from models.encoder.weights import EncoderFileError, EncoderManifest, load_encoder
from models.kinds import KINDS, PolicySpec


def policy_spec(config: Config) -> PolicySpec:
    """Return the specification of the policy's networks."""
    camera, actions = config.env.camera, make_dynamics(config.env).action_space
    if not isinstance(actions, Discrete):  # `jobs.config` rejects such vehicles
        raise ValueError(f"a policy chooses among discrete actions, got {actions}")
    return PolicySpec(config.model, camera.width, camera.height, int(actions.n))


def policy_about(config: Config) -> dict[str, object]:
    """Return what a policy's manifest states about environment and training, besides its `policy_spec`."""
    sensor, commands = sensor_settings(config.env), make_dynamics(config.env).commands
    own = {name: getattr(config.env, name) for name in ("action_delay_ms", "velocity_noise_mps")}
    return {
        "exp": config.exp,
        "observation": KINDS[config.model.name].observation,
        "window_capacity": config.env.window_capacity,
        "sensor": sensor,
        "sensor_hash": settings_hash(sensor),
        "world": {name: getattr(config.env, name) for name in ("scene", "layout")}
        | {"faults": dataclasses.asdict(config.env.faults)}
        | {name: value for name, value in own.items() if value > 0},
        "conditions": config.train.conditions,
        "seed": config.seed,
        "algo": dataclasses.asdict(config.algo),
        **({} if commands is None else {"commands": commands.tolist()}),
        **({} if config.train.init is None else {"init": config.train.init}),
        **({"plugins": plugin_digests()} if config.plugins else {}),
    }


def pretrained_encoder(config: Config, path: str | Path | None) -> tuple[str | Path, EncoderManifest] | None:
    """Return the encoder file with its manifest; None for a policy without one.

    Raises:
        ConfigError: The encoder was trained for another sensor, or is another model than to be fine-tuned.
        RunError: The encoder file is damaged.
        ValueError: A policy that needs an encoder got none, or a policy without one got a file.
    """
    name, spec = config.model.name, policy_spec(config)
    needed = KINDS[name].encoder
    if spec.finetuned and config.train.init is not None:  # in its networks
        return None
    if needed != (path is not None):
        raise ValueError(f"encoder_path must be {'a file' if needed else 'None'} for {name}, got {path!r}")
    if path is None:
        return None
    try:
        _, about = load_encoder(path)
    except EncoderFileError as error:
        marker = Path(path).parent.parent / "stages" / "pretrain.json"
        raise RunError(f"{error}; delete {marker}, and the same command makes the encoder again") from None
    differ = differences(about["sensor"], sensor_settings(config.env))
    if differ:
        remedy = "use its settings, or pretrain an encoder for these"
        raise ConfigError(f"encoder: was made for another sensor: {differ}; {remedy}")
    if spec.finetuned and spec.evae != about["model"]:
        raise ConfigError(f"encoder: must be one of {spec.evae} to be fine-tuned, got {about['model']}")
    return path, about
