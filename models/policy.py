"""What flies: frozen encoder, a stack of the last latents, two small networks, one folder.

A policy folder turns event windows into actions with the preprocessing of training, on a
machine without Ray and without running anyone's code: two safetensors files and their JSON
manifests, each checked against its SHA-256 before use.
"""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch
from torch import nn

from models.evae import EventVAE
from models.networks import build_heads, push_latents
from models.table import EncoderTable
from models.weights import load_encoder, save_encoder, write_atomic

MANIFEST, ENCODER, HEADS = "policy.json", "encoder.safetensors", "heads.safetensors"
REQUIRED = ("format", "sha256", "stack", "latent", "hidden", "num_actions", "sensor", "sensor_hash")
FORMAT = 1
MAX_BYTES = 1 << 28  # of one file, which is read whole
MAX_SIZE = 1 << 16  # of a layer


class PolicyFileError(ValueError):
    """A policy folder that was refused; the message names the file and the reason."""


class Policy:
    """Event windows in, actions out; remembers the last latents of each flight.

    Attributes:
        manifest: Sensor settings and hash, network sizes, training settings and figures.
        deterministic: True: the most likely action; False: one drawn from the distribution.
    """

    def __init__(
        self,
        table: EncoderTable,
        head: nn.Module,
        manifest: dict[str, Any],
        deterministic: bool = True,
        rng: np.random.Generator | None = None,
    ) -> None:
        """Join an encoder and a policy network; a stochastic policy needs `rng`."""
        if not deterministic and rng is None:
            raise ValueError("rng must be given for a stochastic policy (deterministic=False), got None")
        self.table, self.head, self.manifest = table, head, manifest
        self.deterministic, self.rng = deterministic, rng
        self.reset()

    def reset(self, num_envs: int = 1) -> None:
        """Forget everything: the next windows are the first of `num_envs` flights."""
        size = self.manifest["stack"] * self.manifest["latent"]
        self._stacks = np.zeros((num_envs, size), np.float32)
        self._first = np.ones(num_envs, bool)

    def __call__(self, windows: np.ndarray, restarted: np.ndarray | None = None) -> np.ndarray:
        """Choose an action for each flight.

        Args:
            windows: int32 (B, capacity + 1, 4), one event window per flight.
            restarted: bool (B,), True where the window is the first of a new flight (with
                Gymnasium's NEXT_STEP autoreset: where the step before was terminated or
                truncated); None: nowhere.

        Returns:
            int64 (B,) actions.
        """
        return self._choose(self.logits(windows, restarted))

    def act(self, events: np.ndarray, start_us: int, window_us: int) -> int:
        """Choose the action of one flight from the events of its control step.

        Args:
            events: EVENT array of the step, t in (start_us, start_us + window_us].
            start_us: Start of the step on the clock of the events [us].
            window_us: Length of the step [us].
        """
        latent = self.table.encode(events, start_us, window_us)
        return int(self._choose(self._logits(latent[None], None))[0])

    def logits(self, windows: np.ndarray, restarted: np.ndarray | None = None) -> np.ndarray:
        """Unnormalised log-probabilities float32 (B, actions); arguments as in a call."""
        return self._logits(self.table.encode_windows(windows), restarted)

    def _logits(self, latents: np.ndarray, restarted: np.ndarray | None) -> np.ndarray:
        if len(latents) != len(self._stacks):
            raise ValueError(
                f"windows must be one for each of {len(self._stacks)} flights, got {len(latents)}: "
                "call reset(num_envs) first"
            )
        first = self._first if restarted is None else self._first | restarted
        self._stacks = push_latents(self._stacks, latents, first)
        self._first = np.zeros(len(latents), bool)
        with torch.inference_mode():
            return self.head(torch.from_numpy(self._stacks)).numpy()

    def _choose(self, logits: np.ndarray) -> np.ndarray:
        if self.deterministic or self.rng is None:
            return logits.argmax(axis=1)
        weights = np.exp(logits.astype(np.float64) - logits.max(axis=1, keepdims=True))
        cumulative = np.cumsum(weights, axis=1)
        drawn = self.rng.random((len(logits), 1)) * cumulative[:, -1:]
        return (cumulative <= drawn).sum(axis=1)


def save_policy(
    path: str | Path, evae: EventVAE, heads: Mapping[str, nn.Module], manifest: Mapping[str, Any]
) -> Path:
    """Write a policy folder that is sufficient alone; its manifest comes last, and seals it.

    Args:
        path: Folder, made if missing.
        evae: The frozen event VAE.
        heads: Networks of `build_heads`: "pi", and "vf" for those who train on.
        manifest: At least `stack`, `latent`, `hidden`, `num_actions`, `sensor` and
            `sensor_hash`; anything else that JSON holds, such as training figures.

    Returns:
        The folder.
    """
    folder = Path(path)
    folder.mkdir(parents=True, exist_ok=True)
    about = {key: manifest[key] for key in ("sensor", "sensor_hash")}
    save_encoder(folder / ENCODER, evae, about)
    tensors = {
        f"{name}.{key}": value.detach().contiguous()
        for name, head in heads.items()
        for key, value in head.state_dict().items()
    }
    write_atomic(folder / HEADS, safetensors.torch.save(tensors))
    sums = {name: _digest(folder / name) for name in (ENCODER, HEADS)}
    text = json.dumps({**manifest, "format": FORMAT, "sha256": sums}, indent=2, allow_nan=False)
    write_atomic(folder / MANIFEST, text.encode())
    return folder


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
    evae, _ = load_encoder(folder / ENCODER)
    heads = nn.ModuleDict(build_heads(manifest)).requires_grad_(False)
    _load_heads(folder / HEADS, heads)
    return Policy(EncoderTable.from_evae(evae), heads["pi"], manifest, deterministic, rng)


def _read_manifest(file: Path) -> dict[str, Any]:
    try:
        manifest = json.loads(_read(file))
    except (ValueError, RecursionError) as error:
        raise PolicyFileError(f"{file}: not a JSON file: {error}") from None
    missing = [key for key in REQUIRED if not isinstance(manifest, dict) or key not in manifest]
    if missing:
        raise PolicyFileError(f"{file}: the manifest lacks {missing}; export the policy again")
    if manifest["format"] != FORMAT:
        raise PolicyFileError(f"{file}: format {manifest['format']!r}, this version reads {FORMAT}")
    if not isinstance(manifest["sha256"], dict) or set(manifest["sha256"]) != {ENCODER, HEADS}:
        raise PolicyFileError(f"{file}: sha256 must name {ENCODER} and {HEADS}, got {manifest['sha256']!r}")
    hidden = manifest["hidden"] if isinstance(manifest["hidden"], list) else [None]
    sizes = [manifest["stack"], manifest["latent"], manifest["num_actions"], *hidden]
    if not all(type(size) is int and 1 <= size <= MAX_SIZE for size in sizes):
        rule = f"must be integers in 1..{MAX_SIZE}"
        raise PolicyFileError(f"{file}: stack, latent, num_actions and hidden {rule}")
    return manifest


def _load_heads(file: Path, heads: nn.Module) -> None:
    """Put the file's tensors into the networks; they must fit one by one and be finite."""
    try:
        tensors = safetensors.torch.load(_read(file))
        heads.load_state_dict(tensors)
    except (safetensors.SafetensorError, RuntimeError) as error:
        raise PolicyFileError(f"{file}: not the networks of this policy: {error}") from None
    bad = [name for name, value in tensors.items() if not torch.isfinite(value).all()]
    if bad:
        raise PolicyFileError(f"{file}: weights must be finite, those of {bad} are not")


def _digest(file: Path) -> str:
    return hashlib.sha256(_read(file)).hexdigest()


def _read(file: Path) -> bytes:
    try:
        size = file.stat().st_size
        if size > MAX_BYTES:
            raise PolicyFileError(f"{file}: {size} bytes, at most {MAX_BYTES} are read")
        return file.read_bytes()
    except OSError as error:
        raise PolicyFileError(f"{file}: cannot be read: {error.strerror}") from None
