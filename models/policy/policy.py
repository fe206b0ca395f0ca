"""What flies: a stack of the last features, a network, the encoder if there is one; one folder.

A policy folder turns observations, or events, into actions with the preprocessing of training,
on a machine without Ray and without running anyone's code: safetensors files and their JSON
manifests, each checked against its SHA-256 before use. An encoder that learnt on with its policy is
in the networks' file, and flies from a table like a frozen one.
"""

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch
from torch import Tensor, nn

from models.encoder.evae import EventVAE
from models.encoder.event_images import PictureEncoder
from models.encoder.finetuned import EVENTS, evae_settings
from models.encoder.frozen import encoder_of, tabulate
from models.encoder.table import EncoderTable
from models.encoder.weights import (
    EncoderFileError,
    lean_tensors,
    load_encoder,
    read_limited,
    save_encoder,
    write_atomic,
)
from models.kinds import FINETUNED, KINDS, MIN_IMAGE, kind_of
from models.policy.features import FEATURES, feature_of, push_features
from models.policy.networks import assemble

MANIFEST, NETWORKS, ENCODER = "policy.json", "networks.safetensors", "encoder.safetensors"
ENCODER_FILES = (ENCODER, "encoder.json")
SIZES = ("stack", "num_actions", "width", "height")
REQUIRED = ("sha256", "name", *SIZES, "latent", "hidden", "sensor", "sensor_hash")
FORMAT = 2
MAX_BYTES = 1 << 28  # of one file, which is read whole
MAX_SIZE = 1 << 16  # of a layer


class PolicyFileError(ValueError):
    """A policy folder that was refused; the message names the file and the reason."""


class Policy:
    """Observations in, actions out; remembers the last features of each flight.

    Attributes:
        manifest: Name, sensor settings and hash, network sizes, training settings and figures.
        deterministic: True: the most likely action; False: one drawn from the distribution.
    """

    def __init__(
        self,
        networks: nn.ModuleDict,
        manifest: Mapping[str, Any],
        encoder: EncoderTable | PictureEncoder | None = None,
        deterministic: bool = True,
        rng: np.random.Generator | None = None,
    ) -> None:
        """Join the networks and the encoder, if any; a stochastic policy needs `rng`.

        With an encoder the networks read its latents, however it was trained.
        """
        if not deterministic and rng is None:
            raise ValueError("rng must be given for a stochastic policy (deterministic=False), got None")
        self.networks, self.manifest, self.encoder = networks, manifest, encoder
        self.deterministic, self.rng = deterministic, rng
        self._feature = feature_of(manifest) if encoder is None else FEATURES["latent"]
        self.reset()

    @property
    def observation(self) -> str:
        """What the environment must show it: "window", "event_image" or "luminance"."""
        return KINDS[self.manifest["name"]].observation

    def reset(self, num_envs: int = 1) -> None:
        """Forget everything: the next observations are the first of `num_envs` flights."""
        shape = (num_envs, self.manifest["stack"], *self._feature.shape(self.manifest))
        self._stacks = np.zeros(shape, self._feature.dtype)
        self._first = np.ones(num_envs, bool)

    def __call__(self, observations: np.ndarray, restarted: np.ndarray | None = None) -> np.ndarray:
        """Choose an action for each flight.

        Args:
            observations: (B, ...), one per flight, of the kind that `observation` names:
                windows int32 (B, capacity + 1, 4), event images uint8 (B, H, W) or luminance
                float32 (B, H, W).
            restarted: bool (B,), True where the observation is the first of a new flight
                (with Gymnasium's NEXT_STEP autoreset: where the step before was terminated
                or truncated); None: nowhere.

        Returns:
            int64 (B,) actions.
        """
        return self._choose(self.logits(observations, restarted))

    def act(self, events: Any, start_us: int, window_us: int) -> int:
        """Choose the action of one flight from the events of its control step; see `event_logits`."""
        return int(self._choose(self.event_logits(events, start_us, window_us)[None])[0])

    def event_logits(self, events: Any, start_us: int, window_us: int) -> np.ndarray:
        """Unnormalised log-probabilities float32 (actions,) of one flight's next step, from its events.

        Args:
            events: Integer arrays t, x, y, p by name, such as an EVENT array: the events of the
                step in time order, t in (start_us, start_us + window_us].
            start_us: Start of the step on the clock of the events [us].
            window_us: Length of the step [us].

        Raises:
            ValueError: The policy does not see events.
        """
        if self._feature.from_events is None:
            rule = f"a policy that sees {self.observation}: call it with observations"
            raise ValueError(f"events say nothing to {rule}")
        feature = self._feature.from_events((events, start_us, window_us), self.manifest, self.encoder)
        return self._logits(feature[None], None)[0]

    def logits(self, observations: np.ndarray, restarted: np.ndarray | None = None) -> np.ndarray:
        """Unnormalised log-probabilities float32 (B, actions); arguments as in a call."""
        features = self._feature.from_observations(observations, self.manifest, self.encoder)
        return self._logits(features, restarted)

    def _logits(self, features: np.ndarray, restarted: np.ndarray | None) -> np.ndarray:
        if len(features) != len(self._stacks):
            raise ValueError(
                f"observations must be one for each of {len(self._stacks)} flights, got {len(features)}: "
                "call reset(num_envs) first"
            )
        first = self._first if restarted is None else self._first | restarted
        self._stacks = push_features(self._stacks, features, first)
        self._first = np.zeros(len(features), bool)
        with torch.inference_mode():
            logits = self.networks["pi"](self.networks["trunk"](torch.from_numpy(self._stacks))).numpy()
        if not np.isfinite(logits).all():
            raise ValueError("the policy's logits must be finite, got NaN or infinity; train it anew")
        return logits

    def _choose(self, logits: np.ndarray) -> np.ndarray:
        if self.deterministic or self.rng is None:
            return logits.argmax(axis=1)
        weights = np.exp(logits.astype(np.float64) - logits.max(axis=1, keepdims=True))
        cumulative = np.cumsum(weights, axis=1)
        drawn = self.rng.random((len(logits), 1)) * cumulative[:, -1:]
        return (cumulative <= drawn).sum(axis=1)


def save_policy(
    path: str | Path,
    networks: nn.ModuleDict,
    manifest: Mapping[str, Any],
    evae: EventVAE | None = None,
    encoder_figures: Mapping[str, float] | None = None,
    lean: bool = False,
) -> Path:
    """Write a policy folder that is sufficient alone; its manifest comes last, and seals it.

    Args:
        path: Folder, made if missing.
        networks: Those of `models.policy.networks.assemble`; with the value, for those who train on.
        manifest: At least `name`, `stack`, `num_actions`, `width`, `height`, `latent` and
            `hidden` (or None), `sensor` and `sensor_hash`, for an encoder that learnt on also
            `encoder` and `models.encoder.finetuned.SETTINGS`; anything else that JSON holds, such as
            training figures.
        evae: The frozen event VAE, for a policy that has one.
        encoder_figures: Its own held-out figures, for the encoder's manifest.
        lean: Weights in float16 and no decoder, a fraction of the size: it flies, but draws nothing.

    Returns:
        The folder.

    Raises:
        ValueError: An event VAE is missing or too many.
    """
    needed = kind_of(manifest).encoder
    if needed != (evae is not None):
        raise ValueError(f"evae must be {'given' if needed else 'None'} for {manifest['name']}, got {evae!r}")
    folder = Path(path)
    folder.mkdir(parents=True, exist_ok=True)
    if evae is not None:
        facts = {key: manifest[key] for key in ("sensor", "sensor_hash")}
        save_encoder(folder / ENCODER, evae, {**facts, "figures": dict(encoder_figures or {})}, lean)
    tensors = {name: value.detach().contiguous() for name, value in networks.state_dict().items()}
    write_atomic(folder / NETWORKS, safetensors.torch.save(lean_tensors(tensors) if lean else tensors))
    sums = {name: _digest(folder / name) for name in _files(manifest)}
    text = json.dumps({**manifest, "format": FORMAT, "sha256": sums}, indent=2, allow_nan=False)
    write_atomic(folder / MANIFEST, text.encode())
    return folder


def save_lean_policy(source: str | Path, path: str | Path, about: Mapping[str, Any]) -> Path:
    """Write the policy of a folder once more, lean, with `about` added to its manifest; return the new one.

    Raises:
        PolicyFileError: As `load_policy`.
    """
    folder = Path(source)
    load_policy(folder)  # checks every file
    manifest = _read_manifest(folder / MANIFEST)
    evae, own = load_encoder(folder / ENCODER) if kind_of(manifest).encoder else (None, {})
    networks = _load_networks(folder / NETWORKS, manifest)
    return save_policy(path, networks, {**manifest, **about}, evae, own.get("figures"), lean=True)


def load_policy(
    path: str | Path, deterministic: bool = True, rng: np.random.Generator | None = None
) -> Policy:
    """Read a policy folder and check it: format, SHA-256, shapes, finite weights.

    Raises:
        PolicyFileError: If the folder is not a whole, unchanged policy of this format.
    """
    folder = Path(path)
    manifest = _read_manifest(folder / MANIFEST)
    for name, expected in manifest["sha256"].items():
        if _digest(folder / name) != expected:
            raise PolicyFileError(f"{folder / name}: SHA-256 must be {expected}: another or a damaged file")
    kind = kind_of(manifest)
    table = _load_encoder(folder, manifest) if kind.encoder else None
    networks = _load_networks(folder / NETWORKS, manifest)
    if kind.network == "finetuned":
        table, networks["trunk"] = _tabulated(networks["trunk"], manifest), nn.Flatten()
    return Policy(networks, manifest, table, deterministic, rng)


def _files(manifest: Mapping[str, Any]) -> tuple[str, ...]:
    """The files that a policy's manifest vouches for."""
    return (*(ENCODER_FILES if kind_of(manifest).encoder else ()), NETWORKS)


def _read_manifest(file: Path) -> dict[str, Any]:
    try:
        manifest = json.loads(_read(file))
    except (ValueError, RecursionError) as error:
        raise PolicyFileError(f"{file}: not a JSON file: {error}") from None
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        found = manifest.get("format") if isinstance(manifest, dict) else None
        raise PolicyFileError(f"{file}: format {found!r}, this version reads {FORMAT}; train it anew")
    missing = [key for key in REQUIRED if key not in manifest]
    if missing:
        raise PolicyFileError(f"{file}: the manifest lacks {missing}; export the policy again")
    name = manifest["name"]
    known = FINETUNED if manifest.get("encoder") == "finetuned" else KINDS
    if not isinstance(name, str) or name not in known:
        raise PolicyFileError(f"{file}: name must be one of {', '.join(known)}, got {name!r}")
    if not isinstance(manifest["sha256"], dict) or set(manifest["sha256"]) != set(_files(manifest)):
        wanted = ", ".join(_files(manifest))
        raise PolicyFileError(f"{file}: sha256 must name {wanted}, got {manifest['sha256']!r}")
    _check_sizes(file, manifest)
    return manifest


def _check_sizes(file: Path, manifest: Mapping[str, Any]) -> None:
    """Refuse sizes of which no network can be built."""
    kind = KINDS[manifest["name"]]
    used = [*SIZES, *(["latent"] if kind.encoder else [])]
    hidden = manifest["hidden"] if kind.network == "mlp" else []
    sizes = [manifest[name] for name in used] + (hidden if isinstance(hidden, list) else [None])
    if not all(type(size) is int and 1 <= size <= MAX_SIZE for size in sizes):
        raise PolicyFileError(f"{file}: {', '.join(used)} and hidden must be integers in 1..{MAX_SIZE}")
    if kind_of(manifest).network == "finetuned":
        try:
            evae_settings(manifest)
        except ValueError as error:
            raise PolicyFileError(f"{file}: {error}") from None
    if kind.network == "cnn" and min(manifest["width"], manifest["height"]) < MIN_IMAGE:
        rule = f"must be at least {MIN_IMAGE} for {manifest['name']}"
        raise PolicyFileError(f"{file}: width and height {rule}")


def _load_encoder(folder: Path, manifest: Mapping[str, Any]) -> EncoderTable | PictureEncoder:
    evae, _ = load_encoder(folder / ENCODER)
    ours = {"variant": manifest["name"], **{key: manifest[key] for key in ("latent", "width", "height")}}
    theirs = {key: evae.settings[key] for key in ours}
    if ours != theirs:
        raise PolicyFileError(f"{folder / ENCODER}: must be the encoder of {ours}, got one of {theirs}")
    return encoder_of(evae)


def _tabulated(trunk: nn.Module, manifest: Mapping[str, Any]) -> EncoderTable | PictureEncoder:
    """The table of an encoder that learnt on; it sees windows thinned as in training."""
    table: Any = tabulate(trunk, evae_settings(manifest))
    return dataclasses.replace(table, most_events=EVENTS)


def _load_networks(file: Path, manifest: Mapping[str, Any]) -> nn.ModuleDict:
    """The networks of the file's tensors, which must fit one by one and be finite.

    They are put together without memory for their weights: sizes that the file does not
    bear out cost nothing.
    """
    try:
        read = safetensors.torch.load(_read(file))
    except safetensors.SafetensorError as error:
        raise PolicyFileError(f"{file}: not a safetensors file: {error}") from None
    tensors = {name: value.float() if value.dtype == torch.half else value for name, value in read.items()}
    with torch.device("meta"):
        networks = assemble(manifest)
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


def _forms(tensors: Mapping[str, Tensor]) -> dict[str, tuple[Any, ...]]:
    return {name: (tensor.dtype, tuple(tensor.shape)) for name, tensor in tensors.items()}


def _digest(file: Path) -> str:
    return hashlib.sha256(_read(file)).hexdigest()


def _read(file: Path) -> bytes:
    try:
        return read_limited(file, MAX_BYTES)
    except EncoderFileError as error:
        raise PolicyFileError(str(error)) from None
