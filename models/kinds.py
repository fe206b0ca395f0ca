"""The kinds of policy, and the settings of each (appendix D.1.2).

    observation --feature, once per step--> stack of the last ones --network--> logits and value

To add a kind of policy, add a row to `KINDS`, a module with its feature and network unless existing ones
suffice, and `conf/model/NAME.yaml` with its settings. A network with sizes of its own also needs a dataclass
of its settings. Rows name features and networks as "module:attribute", so that a configuration can be checked
without importing torch.

This module defines the ranges of all settings for configurations, encoder files and policy folders.
"""

import dataclasses
import itertools
from collections.abc import Callable, Mapping
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, TypeVar, cast

import pydantic
from pydantic import AfterValidator, Field, InstanceOf
from pydantic.dataclasses import dataclass

T = TypeVar("T")
STRICT = pydantic.ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)

Variant = Literal["bytestream", "bytestream_xy", "event_image_vae"]
Norm = Literal["batch", "none"]
Target = Literal["signed", "occupancy", "aged", "counts", "proximity"]
Coding = Literal["additive", "eventnet", "none"]

Side = Annotated[int, Field(ge=1, le=4096)]
Context = Annotated[int, Field(ge=2, le=8192, multiple_of=2)]
Latent = Annotated[int, Field(ge=1, le=256)]
TimeBins = Annotated[int, Field(ge=1, le=65536)]
PoolRank = Annotated[int, Field(ge=1, le=8)]
Octaves = Annotated[int, Field(ge=0, le=8)]
Stack = Annotated[int, Field(ge=1, le=32)]
Rows = Annotated[list[Annotated[int, Field(ge=0, le=4096)]], Field(max_length=65)]
Size = Annotated[int, Field(ge=1, le=65536)]
TimesMs = Annotated[list[Annotated[float, Field(gt=0, le=1e6)]], Field(max_length=16)]

MAX_ROW_TIME_BINS = 1 << 15  # for a fine-tuned encoder, whose events are stored as rows of int16
MIN_IMAGE = 36  # pixels; the smallest side for which the third convolution of `nature_layers` outputs a pixel


def _of_a_kind(name: str) -> str:
    if name not in KINDS:
        raise ValueError(f"must be one of {', '.join(KINDS)}, got {name!r}{renamed(name)}")
    return name


KindName = Annotated[str, AfterValidator(_of_a_kind)]


@dataclass(frozen=True, config=STRICT)
class EvaeSettings:
    """Settings of an event VAE, documented in `models.encoder.evae.EventVAE`."""

    variant: Variant
    width: Side
    height: Side
    context: Context
    latent: Latent
    norm: Norm
    target: Target
    time_bins: TimeBins
    coding: Coding
    pool_rank: PoolRank = 1
    octaves: Octaves = 0

    @pydantic.model_validator(mode="after")
    def _fits_its_variant(self) -> "EvaeSettings":
        _check_coding(self.variant, self.coding, self.pool_rank, self.octaves)
        return self


class Model:
    """Settings common to all kinds of policy.

    Attributes:
        name: The kind.
        stack: Number of latest features that the policy reads.
    """

    has_encoder: ClassVar[bool] = False

    name: str
    stack: int


@dataclass(frozen=True, config=STRICT)
class EncoderModel(Model):
    """A policy whose dense layers read the latents of an event VAE (appendix A.1, D.1.2).

    Attributes:
        name: The kind, also the variant of the event VAE.
        context, latent, norm, target, time_bins, coding, pool_rank, octaves: As `EvaeSettings`.
        encoder: What PPO does with the pretrained encoder.
        stack: Latest latents that the policy sees.
        hidden: Neurons of each dense layer.
        memory_ms: If any, it sees the newest latent instead, and means of all that decay with these
            time constants [ms] (`models.policy.memory`).
        own_actions: Whether it also sees the action that it took last, remembered as a latent is.
        own_velocity: Whether it also sees the velocity that the vehicle measures.
    """

    has_encoder: ClassVar[bool] = True

    name: KindName
    context: Context
    latent: Latent
    norm: Norm
    target: Target
    time_bins: TimeBins
    coding: Coding
    encoder: Literal["frozen", "finetuned"]
    stack: Stack
    hidden: list[Size]
    memory_ms: TimesMs = dataclasses.field(default_factory=list)
    pool_rank: PoolRank = 1
    octaves: Octaves = 0
    own_actions: bool = False
    own_velocity: bool = False

    @pydantic.model_validator(mode="after")
    def _fits_its_kind(self) -> "EncoderModel":
        _check_coding(self.name, self.coding, self.pool_rank, self.octaves)
        if self.encoder == "finetuned":
            if not KINDS[self.name].finetuning:
                able = ", ".join(name for name, kind in KINDS.items() if kind.finetuning)
                rule = f"must be frozen for {self.name}; {able} can be fine-tuned"
                raise ValueError(f"encoder {rule}, got 'finetuned'")
            if self.memory_ms:
                rule = "must be [] for encoder=finetuned, whose latents change while it learns"
                raise ValueError(f"memory_ms {rule}, got {self.memory_ms}")
            for name in ("own_actions", "own_velocity"):
                if getattr(self, name):
                    rule = "must be false for encoder=finetuned, whose networks read events"
                    raise ValueError(f"{name} {rule}, got True")
            if self.time_bins > MAX_ROW_TIME_BINS:
                rule = f"must be at most {MAX_ROW_TIME_BINS} for encoder=finetuned"
                raise ValueError(f"time_bins {rule}, got {self.time_bins}")
        return self

    def evae(self, width: int, height: int) -> EvaeSettings:
        """Return the settings of its event VAE for a sensor of width x height pixels."""
        own = (self.context, self.latent, self.norm, self.target, self.time_bins, self.coding)
        added = (self.pool_rank, self.octaves)
        return EvaeSettings(cast(Variant, self.name), width, height, *own, *added)


@dataclass(frozen=True, config=STRICT)
class DenseModel(Model):
    """A policy whose dense layers read features that are computed without an encoder; see `EncoderModel`."""

    name: KindName
    stack: Stack
    hidden: list[Size]
    memory_ms: TimesMs = dataclasses.field(default_factory=list)
    own_actions: bool = False
    own_velocity: bool = False


@dataclass(frozen=True, config=STRICT)
class ColumnsModel(DenseModel):
    """A policy whose dense layers read event counts per image column; see `EncoderModel`.

    Attributes:
        bands: Rows at which the horizontal bands of the image start, and the row at which the last one ends.
            Each band has its own counts; other rows are not seen. Empty: the whole image is one band. Several
            bands show how high an object is, which matters if obstacles hang in the air.
    """

    bands: Rows = dataclasses.field(default_factory=list)

    @pydantic.model_validator(mode="after")
    def _rises(self) -> "ColumnsModel":
        if len(self.bands) == 1 or any(a >= b for a, b in itertools.pairwise(self.bands)):
            raise ValueError(f"bands must be [] or two and more rising rows, got {self.bands}")
        return self


@dataclass(frozen=True, config=STRICT)
class FixedModel(Model):
    """A policy whose network has fixed sizes and is trained end to end on a stack of features."""

    name: KindName
    stack: Stack


@dataclass(frozen=True, config=STRICT)
class RecurrentModel(Model):
    """A policy with a recurrent network, such as a GRU (Cho et al. 2014).

    Attributes:
        units: Size of its state.
        own_actions, own_velocity: See `EncoderModel`.
    """

    name: KindName
    stack: Stack
    units: Size
    own_actions: bool = False
    own_velocity: bool = False


class Kind(NamedTuple):
    """A kind of policy: the parts that turn observations into actions.

    Attributes:
        observation: Name of the observation that it needs (`envs.observations`).
        feature: Reference to the feature stored for each step, a `models.policy.features.Feature`.
        network: Reference to the network that reads the features, a `models.policy.networks.Network`.
        settings: The dataclass of its settings, which also defines whether it has an event VAE.
        onnx: Reference to the feature as a function of tensors (`models.policy.onnx`); None: no ONNX export.
        min_side: Smallest side of the sensor that its network supports [pixels].
        finetuning: Whether PPO may fine-tune its encoder (`encoder: finetuned`).
    """

    observation: str
    feature: str
    network: str
    settings: type[Model]
    onnx: str | None = None
    min_side: int = 1
    finetuning: bool = False

    @property
    def encoder(self) -> bool:
        """Whether it needs a pretrained event VAE."""
        return self.settings.has_encoder


_FEATURES, _NETWORKS, _ONNX = "models.policy.features", "models.policy.networks", "models.policy.onnx"
_LATENT = Kind(
    observation="window",
    feature=f"{_FEATURES}:LATENT",
    network=f"{_NETWORKS}:TWO_MLPS",
    settings=EncoderModel,
    onnx=f"{_ONNX}:table_latent",
)
KINDS = {
    "bytestream": _LATENT._replace(finetuning=True),
    "bytestream_xy": _LATENT._replace(finetuning=True),
    "event_columns": Kind(
        observation="window",
        feature=f"{_FEATURES}:COLUMNS",
        network=f"{_NETWORKS}:TWO_MLPS",
        settings=ColumnsModel,
        onnx=f"{_ONNX}:columns",
    ),
    "event_columns_gru": Kind(
        observation="window",
        feature=f"{_FEATURES}:COLUMNS",
        network="models.policy.recurrent:GRU",
        settings=RecurrentModel,
        onnx=f"{_ONNX}:columns",
    ),
    "event_set": Kind(
        observation="window",
        feature=f"{_FEATURES}:EVENT_SET",
        network=f"{_NETWORKS}:EVENT_SET",
        settings=FixedModel,
        onnx=f"{_ONNX}:event_set",
    ),
    "event_image": Kind(
        observation="event_image",
        feature=f"{_FEATURES}:EVENT_IMAGE",
        network=f"{_NETWORKS}:NATURE_CNN",
        settings=FixedModel,
        onnx=f"{_ONNX}:event_image",
        min_side=MIN_IMAGE,
    ),
    "event_image_vae": _LATENT._replace(onnx=f"{_ONNX}:picture_latent", min_side=MIN_IMAGE),
    "rgb": Kind(
        observation="luminance",
        feature=f"{_FEATURES}:GREY",
        network=f"{_NETWORKS}:NATURE_CNN",
        settings=FixedModel,
        onnx=f"{_ONNX}:grey",
        min_side=MIN_IMAGE,
    ),
}
# Settings that older files lack, each with the value that gives the behaviour of the older version.
ADDED_MODEL_SETTINGS: dict[str, object] = {
    "memory_ms": [],
    "pool_rank": 1,
    "octaves": 0,
    "own_actions": False,
    "own_velocity": False,
    "bands": [],
}
RENAMED = {
    "brp_full": "bytestream",
    "brp_xy": "bytestream_xy",
    "eip": "event_image",
    "eivae": "event_image_vae",
}


class TrialError(ValueError):
    """The results of a feature or network do not match its row in `KINDS`."""


@dataclass(frozen=True, config=STRICT)
class PolicySpec:
    """Everything needed to build a policy's networks.

    Attributes:
        model: Settings of its kind.
        width, height: Pixels of the sensor.
        num_actions: Actions to choose from.
    """

    model: InstanceOf[Model]
    width: Size
    height: Size
    num_actions: Size = 3

    @property
    def kind(self) -> Kind:
        """Return the row in `KINDS`; with a fine-tuned encoder it has another feature and network."""
        kind = KINDS[self.model.name]
        if not self.finetuned:
            return kind
        return kind._replace(feature=f"{_FEATURES}:EVENT_ROWS", network=f"{_NETWORKS}:FINETUNED_MLPS")

    @property
    def finetuned(self) -> bool:
        """Whether PPO fine-tunes the encoder as part of the networks."""
        return isinstance(self.model, EncoderModel) and self.model.encoder == "finetuned"

    @property
    def frozen(self) -> bool:
        """Whether its features come from a frozen encoder, which is stored in its own file."""
        return self.model.has_encoder and not self.finetuned

    @property
    def evae(self) -> EvaeSettings:
        """Return the settings of its event VAE.

        Raises:
            ValueError: It has no event VAE.
        """
        if not isinstance(self.model, EncoderModel):
            raise ValueError(f"{self.model.name} has no event VAE")
        return self.model.evae(self.width, self.height)

    @property
    def memory_ms(self) -> list[float]:
        """Return the time constants of its memory [ms]; none if it reads a stack of features."""
        return list(getattr(self.model, "memory_ms", []))

    @property
    def bands(self) -> list[int]:
        """Return the rows at which its bands start, and the row at which the last one ends."""
        return list(getattr(self.model, "bands", [])) or [0, self.height]

    @property
    def own_actions(self) -> bool:
        """Whether it also sees its last action."""
        return bool(getattr(self.model, "own_actions", False))

    @property
    def own_velocity(self) -> bool:
        """Whether it also sees the velocity that the vehicle measures."""
        return bool(getattr(self.model, "own_velocity", False))

    @property
    def own_size(self) -> int:
        """Return the number of values about the vehicle (action, velocity) appended to each feature."""
        return self.num_actions * self.own_actions + 2 * self.own_velocity

    @property
    def depth(self) -> int:
        """Return the number of features (or means) stored per episode, see `models.policy.memory`."""
        return 1 + len(self.memory_ms) if self.memory_ms else self.model.stack

    @property
    def hidden(self) -> list[int]:
        """Return the neurons of each of its dense layers.

        Raises:
            ValueError: It has no dense layers.
        """
        if not hasattr(self.model, "hidden"):
            raise ValueError(f"{self.model.name} has no dense layers")
        return list(self.model.hidden)

    def manifest(self) -> dict[str, object]:
        """Return its settings as JSON values, for `read_spec`."""
        sizes = {"width": self.width, "height": self.height, "num_actions": self.num_actions}
        return {**dataclasses.asdict(cast(Any, self.model)), **sizes}


def find_kind(name: object) -> Kind:
    """Return the kind with this name.

    Raises:
        ValueError: There is no such kind.
    """
    if not isinstance(name, str) or name not in KINDS:
        checked(read_model, {"name": name})  # raises
    return KINDS[str(name)]


def needed_plugins(manifest: Mapping[str, object]) -> str:
    """Return a hint for an error message if the policy was trained with plug-ins, else an empty string."""
    plugins = manifest.get("plugins")
    if not isinstance(plugins, Mapping) or not plugins:
        return ""
    return f"; trained with the plug-ins {', '.join(plugins)}: import them first, in a job by plugins=[...]"


def renamed(name: object) -> str:
    """Return a hint for an error message if a kind has been renamed, else an empty string."""
    now = RENAMED.get(name) if isinstance(name, str) else None
    return f", which is called {now} now" if now else ""


def read_model(**values: object) -> Model:
    """Return the checked settings of a model; `name` selects the kind and thus the settings that it has.

    Raises:
        pydantic.ValidationError: A setting is missing, unknown to this kind, or has a wrong value.
    """
    name = values.get("name")
    section: Any = KINDS[name].settings if isinstance(name, str) and name in KINDS else None
    return FixedModel(name=cast(str, name), stack=1) if section is None else section(**values)


def model_keys(*kinds: str) -> list[str]:
    """Return the names of the settings of these kinds, or of all kinds if none is given."""
    sections: list[Any] = [KINDS[name].settings for name in kinds or KINDS]
    return list(dict.fromkeys(field.name for section in sections for field in dataclasses.fields(section)))


def read_spec(values: Mapping[str, object]) -> PolicySpec:
    """Read a policy's specification from a manifest, whose other keys are ignored.

    Raises:
        ValueError: A setting is missing, of another type or out of its range; the message names it.
    """
    values = {**ADDED_MODEL_SETTINGS, **values}
    name, sizes = values.get("name"), ("width", "height", "num_actions")
    own = model_keys(name) if isinstance(name, str) and name in KINDS else ["name"]
    missing = [key for key in (*own, *sizes) if key not in values]
    if missing:
        raise ValueError(f"the settings lack {', '.join(missing)}")
    model = checked(read_model, {key: values[key] for key in own})
    spec = checked(PolicySpec, {"model": model} | {key: values[key] for key in sizes})
    if min(spec.width, spec.height) < spec.kind.min_side:
        rule = f"must be at least {spec.kind.min_side} for {model.name}"
        raise ValueError(f"width and height {rule}, got {spec.width} x {spec.height}")
    return spec


def checked(section: Callable[..., T], values: Mapping[str, object]) -> T:
    """Create a dataclass from values.

    Raises:
        ValueError: A setting is invalid. The message lists each one with its rule and value on one line.
    """
    try:
        return section(**values)
    except pydantic.ValidationError as error:
        raise ValueError("; ".join(map(_one_line, error.errors()))) from None


def _check_coding(name: str, coding: str, pool_rank: int, octaves: int) -> None:
    """Raise ValueError if this encoder cannot have this time coding, pool rank or number of octaves."""
    if coding == "eventnet" and name != "bytestream":
        raise ValueError(f"coding must be additive or none for {name}, which has no time, got 'eventnet'")
    if pool_rank > 1 and (coding == "eventnet" or name == "event_image_vae"):
        pooled = "coding=eventnet, whose phase is the largest value's" if coding == "eventnet" else name
        raise ValueError(f"pool_rank must be 1 for {pooled}, got {pool_rank}")
    if octaves and name == "event_image_vae":
        raise ValueError(f"octaves must be 0 for {name}, whose convolutions know places, got {octaves}")


def _one_line(problem: Mapping[str, Any]) -> str:
    """Format one of pydantic's errors as key, rule and value."""
    key = ".".join(str(part) for part in problem["loc"])
    if problem["type"] == "value_error":
        return f"{key} {problem['msg'].removeprefix('Value error, ')}".strip()
    return f"{key}: {problem['msg']}, got {problem['input']!r}"
