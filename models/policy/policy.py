"""Policies and their folders: encoder, stack of the last features, networks.

A policy folder turns observations or events into actions with the preprocessing of training. It needs
no Ray and contains no executable code: only safetensors files and their JSON manifests, each checked
against its SHA-256 before use. A fine-tuned encoder is stored in the networks' file, and runs from a
lookup table like a frozen one.
"""

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
import safetensors.torch
import torch
from torch import Tensor, nn

from core.files import write_atomic
from models.encoder.evae import EventVAE
from models.encoder.finetuned import EVENTS
from models.encoder.frozen import Encoder, encoder_of, tabulate
from models.encoder.weights import (
    DamagedManifestError,
    EncoderFileError,
    EncoderManifest,
    lean_tensors,
    load_encoder,
    read_limited,
    save_encoder,
    with_checksum,
    without_checksum,
)
from models.kinds import PolicySpec, needed_plugins, read_spec
from models.policy.event_filter import filter_of
from models.policy.features import LATENT, Step, Windows, feature_of
from models.policy.given import check_step, read_fields, read_observations
from models.policy.memory import kept_shape, remember, windows_us
from models.policy.networks import TWO_MLPS, assemble, network_of

PRETRAINED = Path(__file__).parents[1] / "pretrained"  # the shipped policies, a folder each
MANIFEST, NETWORKS, ENCODER = "policy.json", "networks.safetensors", "encoder.safetensors"
ENCODER_FILES = (ENCODER, "encoder.json")
REQUIRED = ("sha256", "name", "sensor", "sensor_hash")
FORMAT = 2
# Keys of a manifest's sensor settings that belong to the environment, and to its simulation.
ENV_FIELDS = ("control_hz", "speed_mps", "filter_support", "filter_tau_us", "vehicle", "body")
FIDELITY_FIELDS = ("tolerance", "max_step_m", "samples", "cull_m")
HEADINGS = ("forward", "left", "right")  # the actions of the kinematic vehicle
REMEDY = "copy it again, or delete stages/train.json of its run folder and give the command again"
OBSERVED = {"event_image": np.uint8, "luminance": np.float32}  # types of observations, else int32
PREPARED = ("feature", "_network", "_run")  # attributes of a policy that are functions
MAX_BYTES = 1 << 28  # limit of one file, which is read whole


class PolicyFileError(ValueError):
    """A policy folder is invalid; the message names the file and the reason."""


class PolicyManifest(TypedDict, total=False):
    """Keys of a policy's manifest besides the settings that `models.kinds.read_spec` reads."""

    format: int
    sha256: dict[str, str]
    name: str
    exp: str
    run: str
    seed: int
    observation: str
    window_capacity: int | None
    sensor: dict[str, object]
    sensor_hash: str
    world: dict[str, Any]
    conditions: list[dict[str, Any]]
    commands: list[list[float]]
    figures: dict[str, float]


class Policy:
    """Choose actions from observations or events; remember the last features of each episode.

    Attributes:
        spec: Specification that its networks were built from.
        manifest: Sensor settings and hash, training settings and metrics; empty if not loaded from a folder.
        encoder: Computes the latents that the networks read, frozen or fine-tuned; None without an encoder.
        deterministic: True: choose the most likely action; False: draw one from the distribution.
        commands: float64 (K, C), the command of each action of a vehicle with a body, as in its Box;
            None for the kinematic vehicle's three headings.
        taken: int64 (B,), the action of each episode's last step, which a policy with `own_actions` sees: the
            one chosen last or, after `logits` alone, the most likely. Set it if another one was taken.
        velocity_mps: float (B, 2), velocity that each vehicle measures, to the right and ahead [m/s]; set it
            before each step of a policy with `own_velocity`.
    """

    def __init__(
        self,
        networks: nn.ModuleDict,
        spec: PolicySpec,
        encoder: Encoder | None = None,
        deterministic: bool = True,
        rng: np.random.Generator | None = None,
        manifest: PolicyManifest | None = None,
    ) -> None:
        """Combine networks, whose weights must no longer change, with the encoder, if any.

        `rng` draws the actions if `deterministic` is False.
        """
        if not deterministic and rng is None:
            raise ValueError("rng must be given for a stochastic policy (deterministic=False), got None")
        self.networks, self.spec, self.encoder = networks, spec, encoder
        self.deterministic, self.rng = deterministic, rng
        self.manifest: PolicyManifest = {} if manifest is None else manifest
        self.commands = _commands_of(self.manifest, spec)
        self._prepare()
        self.reset()

    def __getstate__(self) -> dict[str, Any]:
        """Return all attributes but functions, so that a policy can be copied or pickled in mid-episode."""
        return {name: value for name, value in self.__dict__.items() if name not in PREPARED}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore a copy or pickle; its episodes continue from the same state."""
        self.__dict__.update(state)
        self._prepare()

    def _prepare(self) -> None:
        """Look up the feature and the network, and prepare the network with its current weights."""
        tabulated = self.encoder is not None
        self.feature = LATENT if tabulated else feature_of(self.spec)
        self._network = TWO_MLPS if tabulated and self.spec.finetuned else network_of(self.spec)
        self._run = self._network.run(self.networks["trunk"], self.networks["pi"])

    @property
    def observation(self) -> str:
        """Return the observation that the policy needs: "window", "event_image" or "luminance"."""
        return self.spec.kind.observation

    @property
    def env_fields(self) -> dict[str, Any]:
        """Return the fields of `envs.config.EnvConfig` that reproduce the observations of training.

        `CorridorEnv(**policy.env_fields)` observes as in training, including the neighbour filter.
        """
        sensor = dict(self.manifest.get("sensor", {}))
        own = {name: sensor.pop(name) for name in ENV_FIELDS if name in sensor}
        fidelity = {name: sensor.pop(name) for name in FIDELITY_FIELDS if name in sensor}
        parts = {name: part for name, part in (("camera", sensor), ("fidelity", fidelity)) if part}
        capacity = {"window_capacity": self.manifest.get("window_capacity")}
        return {"observation": self.observation, **capacity, **own, **parts}

    @property
    def stack_shape(self) -> tuple[int, ...]:
        """Return the shape of the networks' input for one episode: (depth, *feature), the newest last."""
        return kept_shape(self.spec, self.feature)

    def reset(self, num_envs: int = 1) -> None:
        """Forget everything: the next observations are the first of `num_envs` episodes."""
        self._stacks: np.ndarray = np.zeros((num_envs, *self.stack_shape), self.feature.dtype)
        self._state = np.zeros((num_envs, self._network.state(self.spec)), np.float32)
        self._first = np.ones(num_envs, bool)
        self.taken = np.zeros(num_envs, np.int64)
        self.velocity_mps = np.full((num_envs, 2), np.nan)
        self._filter = filter_of(self.manifest.get("sensor", {}), self.spec.width, self.spec.height)

    def keep(self, places: np.ndarray) -> None:
        """Keep only the episodes at these indices, int (n,); later batches must follow this order."""
        parts = self._stacks, self._state, self._first, self.taken, self.velocity_mps
        kept = (part[places] for part in parts)
        self._stacks, self._state, self._first, self.taken, self.velocity_mps = kept

    def __call__(self, observations: Windows, restarted: np.ndarray | None = None) -> np.ndarray:
        """Choose an action for each episode.

        Args:
            observations: One per episode, as environments with `env_fields` return them, of the kind
                `observation`: windows int32 (B, capacity + 1, 4), or a sequence of (count + 1, 4)
                of any lengths; event images uint8 or luminance float32, (B, H, W, 1) or (B, H, W).
                Lists and tensors are converted to arrays.
            restarted: bool (B,), True where the observation is the first of a new episode
                (with Gymnasium's NEXT_STEP autoreset: where the step before was terminated
                or truncated); None: nowhere.

        Returns:
            int64 (B,) actions.
        """
        return self._choose(self.logits(observations, restarted))

    @property
    def action_names(self) -> tuple[str, ...]:
        """Return a name for each action: its heading, or the numbers of its command."""
        return action_names(self.manifest)

    def act(self, events: Any, start_us: int, window_us: int) -> Any:
        """Choose the action of one episode from the events of its control step; see `event_logits`.

        Returns:
            The number of the heading; the command, float64 (C,), for a vehicle with a body.
        """
        action = int(self._choose(self.event_logits(events, start_us, window_us)[None])[0])
        return action if self.commands is None else self.commands[action].copy()

    def event_logits(self, events: Any, start_us: int, window_us: int) -> np.ndarray:
        """Return unnormalised log-probabilities float32 (actions,) of one episode's step from its events.

        The events are filtered as in training (`env_fields`).

        Args:
            events: The events of the step in time order, t in (start_us, start_us + window_us]: integers
                t, x, y, p by name, such as an EVENT array, or rows of these four; arrays, lists or tensors.
                If p is boolean, true is ON.
            start_us: Start of the step on the clock of the events [us].
            window_us: Length of the step [us].

        Raises:
            ValueError: The policy does not see events, or the events do not belong to this step.
        """
        if self.feature.from_events is None:
            rule = f"this policy takes {self.observation} images, not events"
            raise ValueError(f"{rule}: call it with observations")
        events = read_fields(events)
        check_step(events, start_us, window_us)
        if self._filter is not None:
            events = self._filter(events)
        feature = self.feature.from_events(Step(events, start_us, window_us), self.spec, self.encoder)
        return self._logits(feature[None], window_us, None)[0]

    def logits(self, observations: Windows, restarted: np.ndarray | None = None) -> np.ndarray:
        """Return unnormalised log-probabilities float32 (B, actions); arguments as in a call."""
        seen = read_observations(observations, OBSERVED.get(self.observation, np.int32))
        features = self.feature.from_observations(seen, self.spec, self.encoder)
        return self._logits(features, windows_us(seen, self.spec), restarted)

    def _logits(
        self, features: np.ndarray, window_us: np.ndarray | int, restarted: np.ndarray | None
    ) -> np.ndarray:
        if len(features) != len(self._stacks):
            raise ValueError(
                f"observations must be one for each of {len(self._stacks)} episodes, got {len(features)}: "
                "call reset(num_envs) first"
            )
        first = self._first if restarted is None else self._first | np.asarray(restarted, bool)
        own = self.taken, self.velocity_mps
        self._stacks = remember(self._stacks, features, first, self.spec, window_us, *own)
        self._first = np.zeros(len(features), bool)
        state = np.where(first[:, None], np.float32(0.0), self._state)
        logits, self._state = self._run(self._stacks, state)
        if not np.isfinite(logits).all():
            raise ValueError("the policy's logits must be finite, got NaN or infinity; train it again")
        self.taken = logits.argmax(axis=1)
        return logits

    def _choose(self, logits: np.ndarray) -> np.ndarray:
        if self.deterministic or self.rng is None:
            return self.taken.copy()
        weights = np.exp(logits.astype(np.float64) - logits.max(axis=1, keepdims=True))
        cumulative = np.cumsum(weights, axis=1)
        drawn = self.rng.random((len(logits), 1)) * cumulative[:, -1:]
        self.taken = (cumulative <= drawn).sum(axis=1)
        return self.taken.copy()


def action_names(manifest: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the name of each action of a policy's manifest, in the order of its logits."""
    if "commands" not in manifest:
        return HEADINGS
    return tuple(" ".join(f"{number:+.3f}" for number in command) for command in manifest["commands"])


def _commands_of(manifest: PolicyManifest, spec: PolicySpec) -> np.ndarray | None:
    """Return the commands of a manifest.

    Raises:
        PolicyFileError: The commands are not finite, or not one for each action.
    """
    if "commands" not in manifest:
        return None
    try:
        commands = np.array(manifest["commands"], np.float64)
    except (ValueError, TypeError):
        commands = np.empty(0)
    if commands.ndim != 2 or len(commands) != spec.num_actions or not np.isfinite(commands).all():
        rule = f"commands must be {spec.num_actions} lists of finite numbers, one for each action"
        raise PolicyFileError(f"{MANIFEST}: {rule}, got {manifest['commands']!r:.80}")
    return commands


def save_policy(
    path: str | Path,
    networks: nn.ModuleDict,
    spec: PolicySpec,
    about: Mapping[str, object],
    evae: EventVAE | None = None,
    encoder_metrics: Mapping[str, float] | None = None,
    lean: bool = False,
) -> Path:
    """Write a self-contained policy folder. The manifest, with the SHA-256 of all files, is written last.

    Args:
        path: Folder, created if missing.
        networks: From `models.policy.networks.assemble`; with the value network, for further training.
        spec: Specification that the networks were built from.
        about: `sensor` and `sensor_hash`, and any other JSON values, such as metrics.
        evae: The frozen event VAE, for a policy that has one.
        encoder_metrics: Held-out metrics of the event VAE, for the encoder's manifest.
        lean: Round weights to float16 and leave out the decoder: a fraction of the size; the policy acts but
            cannot reconstruct.

    Returns:
        The folder.

    Raises:
        ValueError: The policy needs an event VAE and `evae` is None, or the other way round.
    """
    if spec.frozen != (evae is not None):
        rule = f"evae must be {'given' if spec.frozen else 'None'} for {spec.model.name}"
        raise ValueError(f"{rule}, got {evae!r}")
    folder = Path(path)
    folder.mkdir(parents=True, exist_ok=True)
    if evae is not None:
        facts = {key: about[key] for key in ("sensor", "sensor_hash")}
        save_encoder(folder / ENCODER, evae, {**facts, "figures": dict(encoder_metrics or {})}, lean)
    tensors = {name: value.detach().contiguous() for name, value in networks.state_dict().items()}
    write_atomic(folder / NETWORKS, safetensors.torch.save(lean_tensors(tensors) if lean else tensors))
    sums = {name: _digest(folder / name) for name in _files(spec)}
    manifest = {**about, **spec.manifest(), "format": FORMAT, "sha256": sums}
    text = json.dumps(with_checksum(manifest), indent=2, allow_nan=False)
    write_atomic(folder / MANIFEST, text.encode())
    return folder


def save_lean_policy(source: str | Path, path: str | Path, about: Mapping[str, object]) -> Path:
    """Write a lean copy of a policy folder, with `about` added to its manifest; return the new folder.

    Raises:
        PolicyFileError: As in `load_policy`.
    """
    folder = Path(source)
    load_policy(folder)  # checks every file
    manifest, spec = _read_manifest(folder / MANIFEST)
    evae, own = load_encoder(folder / ENCODER) if spec.frozen else (None, EncoderManifest())
    networks = load_networks(folder / NETWORKS, spec)
    return save_policy(path, networks, spec, {**manifest, **about}, evae, own.get("figures"), lean=True)


def load_policy(
    path: str | Path, deterministic: bool = True, rng: np.random.Generator | None = None
) -> Policy:
    """Read a policy folder and check it: format, SHA-256, shapes, finite weights.

    The number of torch's threads is not changed: call `torch.set_num_threads(1)` if other processes are busy.

    Raises:
        PolicyFileError: The folder is not a complete, unchanged policy of this format.
    """
    folder = Path(path)
    manifest, spec = _read_manifest(folder / MANIFEST)
    for name, expected in manifest["sha256"].items():
        if _digest(folder / name) != expected:
            raise PolicyFileError(
                f"{folder / name}: SHA-256 must be {expected}: another or a damaged file; {REMEDY}"
            )
    encoder = _load_encoder(folder, spec) if spec.frozen else None
    networks = load_networks(folder / NETWORKS, spec)
    if spec.finetuned:
        encoder, networks["trunk"] = _tabulated(networks["trunk"], spec), nn.Flatten()
    return Policy(networks, spec, encoder, deterministic, rng, manifest)


def _files(spec: PolicySpec) -> tuple[str, ...]:
    """Return the names of a policy's files other than the manifest, which holds their SHA-256."""
    return (*(ENCODER_FILES if spec.frozen else ()), NETWORKS)


def read_policy_manifest(file: Path) -> dict[str, Any]:
    """Return a policy's manifest without its checksum; empty if the file holds no JSON object.

    Raises:
        PolicyFileError: The file cannot be read, is not JSON, or does not match its checksum.
    """
    try:
        read = without_checksum(json.loads(_read(file)))
    except (ValueError, RecursionError) as error:
        raise PolicyFileError(f"{file}: not a JSON file: {error}; {REMEDY}") from None
    except DamagedManifestError as error:
        raise PolicyFileError(f"{file}: {error}") from None
    return read if isinstance(read, dict) else {}


def _read_manifest(file: Path) -> tuple[PolicyManifest, PolicySpec]:
    manifest: Any = read_policy_manifest(file)
    if (found := manifest.get("format")) != FORMAT:
        raise PolicyFileError(f"{file}: format {found!r}, this version reads {FORMAT}; train it again")
    missing = [key for key in REQUIRED if key not in manifest]
    if missing:
        raise PolicyFileError(f"{file}: the manifest lacks {missing}; export the policy again")
    try:
        spec = read_spec(manifest)
    except ValueError as error:
        raise PolicyFileError(f"{file}: {error}{needed_plugins(manifest)}") from None
    if not isinstance(manifest["sha256"], dict) or set(manifest["sha256"]) != set(_files(spec)):
        wanted = ", ".join(_files(spec))
        raise PolicyFileError(f"{file}: sha256 must name {wanted}, got {manifest['sha256']!r}")
    return manifest, spec


def _load_encoder(folder: Path, spec: PolicySpec) -> Encoder:
    evae, _ = load_encoder(folder / ENCODER)
    if evae.settings != spec.evae:
        raise PolicyFileError(f"{folder / ENCODER}: must be that of {spec.evae}, got one of {evae.settings}")
    return encoder_of(evae)


def _tabulated(trunk: nn.Module, spec: PolicySpec) -> Encoder:
    """Return the lookup table of a fine-tuned encoder; it thins windows as in training."""
    table: Any = tabulate(trunk, spec.evae)
    return dataclasses.replace(table, most_events=EVENTS)


def load_networks(file: Path, spec: PolicySpec) -> nn.ModuleDict:
    """Return the networks stored in a file; names, shapes and dtypes must match, values must be finite.

    The networks are built without memory for their weights, so that wrong sizes in a manifest cost nothing.
    """
    try:
        read = safetensors.torch.load(_read(file))
    except safetensors.SafetensorError as error:
        raise PolicyFileError(f"{file}: not a safetensors file: {error}") from None
    tensors = {name: value.float() if value.dtype == torch.half else value for name, value in read.items()}
    with torch.device("meta"):
        networks = assemble(spec)
    if _forms(tensors) != _forms(networks.state_dict()):
        raise PolicyFileError(f"{file}: not the networks of this policy: other tensors than it needs")
    bad = [name for name, value in tensors.items() if not torch.isfinite(value).all()]
    if bad:
        raise PolicyFileError(f"{file}: weights must be finite, those of {bad} are not")
    bad = [name for name, value in tensors.items() if name.endswith("running_var") and (value < 0).any()]
    if bad:
        raise PolicyFileError(f"{file}: variances must not be negative, those of {bad} are")
    networks.load_state_dict(tensors, assign=True)
    return networks.requires_grad_(False)


def _forms(tensors: Mapping[str, Tensor]) -> dict[str, tuple[object, ...]]:
    return {name: (tensor.dtype, tuple(tensor.shape)) for name, tensor in tensors.items()}


def _digest(file: Path) -> str:
    return hashlib.sha256(_read(file)).hexdigest()


def _read(file: Path) -> bytes:
    try:
        return read_limited(file, MAX_BYTES)
    except EncoderFileError as error:
        raise PolicyFileError(str(error)) from None
