"""Encoder files: tensors as safetensors, with a JSON manifest that describes them.

`NAME.safetensors` holds the state of an `EventVAE`; `NAME.json` holds its settings ("model"),
the SHA-256 of the tensors' file and whatever the writer adds, such as sensor settings, their
hash and metrics. Everything is checked before use: size, digest, names, shapes, dtypes, finite
values. No pickle is read or written.
"""

import dataclasses
import errno
import hashlib
import json
import os
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypedDict

import safetensors.torch
import torch
from torch import Tensor

from core.files import write_atomic
from models.encoder.evae import EventVAE
from models.kinds import EvaeSettings, checked, renamed

FORMAT = 1
MAX_MANIFEST_BYTES = 1 << 20
MAX_HEADER_BYTES = 1 << 20
DECODER = "decoder."  # prefix of the names of its tensors
LEAN = {torch.float32: torch.float16}  # dtype that a lean file may round a tensor to
RESERVED = ("format", "model", "sha256")
CHECKSUM = "checksum"  # key of the checksum of a manifest's other values; older manifests have none
ADDED_SETTINGS = {"coding": "additive", "pool_rank": 1, "octaves": 0}  # for files without these keys


class EncoderManifest(TypedDict, total=False):
    """Keys of an encoder's manifest; the first three are required."""

    format: int
    model: EvaeSettings
    sha256: str
    sensor: dict[str, object]
    sensor_hash: str
    figures: dict[str, float]


class EncoderFileError(ValueError):
    """An encoder file is invalid; the message begins with its name."""


class DamagedManifestError(Exception):
    """A manifest was changed after it was written."""


def save_encoder(
    path: str | Path, evae: EventVAE, manifest: Mapping[str, object], lean: bool = False
) -> None:
    """Write an encoder and its manifest; each file appears complete or not at all.

    Args:
        path: The tensors' file, ending in .safetensors; the manifest has the same name with .json.
        evae: float32 model.
        manifest: Other values to record, as JSON: sensor settings, hash, metrics.
        lean: Leave out the decoder and round the weights to float16: a fraction of the size, but the
            model can only encode, not reconstruct.

    Raises:
        EncoderFileError: A tensor is not finite or not float32, or the manifest is too large or
            contains a reserved key or a value that JSON cannot represent.
    """
    target = tensor_path(path)
    taken = [key for key in RESERVED if key in manifest]
    if taken:
        raise EncoderFileError(f"{target}: the manifest's keys {taken} are written here; rename yours")
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in evae.state_dict().items()}
    check_tensors(target, tensors, expected_tensors(evae.settings))
    data = safetensors.torch.save(lean_tensors(tensors) if lean else tensors)
    digest = hashlib.sha256(data).hexdigest()
    model = dataclasses.asdict(evae.settings)
    record = {**manifest, "format": FORMAT, "model": model, "sha256": digest}
    try:
        text = json.dumps(with_checksum(record), indent=2, sort_keys=True, allow_nan=False).encode()
    except (TypeError, ValueError) as error:
        raise EncoderFileError(f"{target}: the manifest must hold finite JSON values: {error}") from None
    if len(text) > MAX_MANIFEST_BYTES:
        raise EncoderFileError(
            f"{target}: manifest of {len(text)} bytes, at most {MAX_MANIFEST_BYTES} are read"
        )
    target.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(target, data)
    write_atomic(target.with_suffix(".json"), text)


def load_encoder(path: str | Path) -> tuple[EventVAE, EncoderManifest]:
    """Read an encoder: the frozen model (eval mode, no gradients) and its manifest.

    A lean file has no decoder: the model's `decoder` is then None.

    Raises:
        EncoderFileError: A file is missing, too large, damaged or does not fit its manifest.
    """
    target = tensor_path(path)
    manifest = read_manifest(target.with_suffix(".json"))
    settings = manifest["model"]
    expected = expected_tensors(settings)
    limit = sum(tensor.nbytes for tensor in expected.values()) + MAX_HEADER_BYTES
    data = read_limited(target, limit)
    digest = hashlib.sha256(data).hexdigest()
    if digest != manifest["sha256"]:
        raise EncoderFileError(f"{target}: damaged: SHA-256 {digest}, the manifest says {manifest['sha256']}")
    try:
        tensors = safetensors.torch.load(data)
    except Exception as error:
        raise EncoderFileError(f"{target}: not a safetensors file: {error}") from None
    check_tensors(target, tensors, expected)
    evae = EventVAE.of(settings)
    if is_lean(tensors):
        evae.decoder = None
    evae.load_state_dict(tensors)
    return evae.freeze(), manifest


def lean_tensors(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return the tensors without the decoder: weights and biases in float16, statistics unchanged."""
    kept = {name: tensor for name, tensor in tensors.items() if not name.startswith(DECODER)}
    rounded = (".weight", ".bias")
    return {name: tensor.half() if name.endswith(rounded) else tensor for name, tensor in kept.items()}


def is_lean(tensors: dict[str, Tensor]) -> bool:
    """Whether the decoder was left out."""
    return not any(name.startswith(DECODER) for name in tensors)


def read_manifest(path: Path) -> EncoderManifest:
    """Read and check a manifest.

    Raises:
        EncoderFileError: Not a JSON object with the keys and model settings of this format.
    """
    try:
        manifest = without_checksum(json.loads(read_limited(path, MAX_MANIFEST_BYTES)))
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise EncoderFileError(f"{path}: not a JSON file: {error}") from None
    except DamagedManifestError as error:
        raise EncoderFileError(f"{path}: {error}") from None
    missing = [key for key in RESERVED if not isinstance(manifest, dict) or key not in manifest]
    if missing:
        raise EncoderFileError(f"{path}: the manifest lacks {missing}")
    if manifest["format"] != FORMAT:
        raise EncoderFileError(f"{path}: format {manifest['format']!r}, this version reads {FORMAT}")
    try:
        settings = {**ADDED_SETTINGS, **manifest["model"]}
        if now := renamed(settings.get("variant")):
            raise ValueError(f"variant {settings['variant']!r}{now}")
        manifest["model"] = checked(EvaeSettings, settings)
    except (TypeError, ValueError) as error:
        raise EncoderFileError(f"{path}: the model's settings are refused: {error}") from None
    return manifest


def with_checksum(manifest: Mapping[str, object]) -> dict[str, object]:
    """Return a copy of a manifest with the checksum of its JSON values added."""
    text = json.dumps(manifest, allow_nan=False)
    canonical = json.dumps(json.loads(text), sort_keys=True, separators=(",", ":"))
    return {**manifest, CHECKSUM: hashlib.sha256(canonical.encode()).hexdigest()[:12]}


def without_checksum(manifest: Any) -> Any:
    """Check a manifest's checksum and return the manifest without it; unchanged if it has none.

    Raises:
        DamagedManifestError: The values do not match the checksum.
    """
    if not isinstance(manifest, dict) or CHECKSUM not in manifest:
        return manifest
    own = {name: value for name, value in manifest.items() if name != CHECKSUM}
    if with_checksum(own) != manifest:
        raise DamagedManifestError("damaged: other values than its checksum says; copy or make it again")
    return own


def expected_tensors(settings: EvaeSettings) -> dict[str, Tensor]:
    """Return the state of a model with these settings: shapes and dtypes, without memory for values."""
    with torch.device("meta"):
        return EventVAE.of(settings).state_dict()


def check_tensors(path: Path, tensors: dict[str, Tensor], expected: dict[str, Tensor]) -> None:
    """Check tensors against the `expected_tensors` of the model that they belong to.

    Raises:
        EncoderFileError: A name, shape or dtype differs, a value is not finite, or a variance is negative.
    """
    if is_lean(tensors):
        expected = {name: model for name, model in expected.items() if not name.startswith(DECODER)}
    if set(tensors) != set(expected):
        names = sorted(set(tensors) ^ set(expected))
        raise EncoderFileError(f"{path}: unexpected or missing tensors: {names}")
    for name, model in expected.items():
        tensor = tensors[name]
        form, rule = (tensor.dtype, tuple(tensor.shape)), (model.dtype, tuple(model.shape))
        if form not in (rule, (LEAN.get(model.dtype), rule[1])):
            raise EncoderFileError(f"{path}: tensor {name} is {form}, the model needs {rule}")
        if not torch.isfinite(tensor).all():
            raise EncoderFileError(f"{path}: tensor {name} has values that are not finite")
        if name.endswith("running_var") and (tensor < 0).any():
            raise EncoderFileError(f"{path}: tensor {name} has negative variances")


def tensor_path(path: str | Path) -> Path:
    """Return the tensors' file as a Path.

    Raises:
        EncoderFileError: The path does not end in .safetensors.
    """
    target = Path(path)
    if target.suffix != ".safetensors":
        raise EncoderFileError(f"{target}: an encoder file ends in .safetensors")
    return target


def read_limited(path: Path, limit: int) -> bytes:
    """Return the bytes of a file of at most `limit` bytes.

    Raises:
        EncoderFileError: The file cannot be read, is a link, a pipe or a device, or is larger. All
            of this is checked before a byte is read.
    """
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)  # a pipe would block
        with os.fdopen(handle, "rb") as file:
            info = os.fstat(handle)
            if not stat.S_ISREG(info.st_mode):
                raise EncoderFileError(f"{path}: cannot be read: no regular file")
            if info.st_size > limit:
                raise EncoderFileError(f"{path}: {info.st_size} bytes, at most {limit} are read")
            return file.read(limit)
    except OSError as error:
        is_link = error.errno == errno.ELOOP
        reason = "a link, which could name any file; copy the file itself" if is_link else error.strerror
        raise EncoderFileError(f"{path}: cannot be read: {reason}") from None
