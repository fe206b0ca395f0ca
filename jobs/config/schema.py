"""The settings that all jobs share, by section: names, types, ranges. Their values and units are in conf/.

A field added to a section in `jobs.run.identity.TRAINED_BY` needs a default that reproduces the old
behaviour, because older run folders lack the field. The settings of a single job are in the class `Settings`
of its module.
"""

import dataclasses
from typing import Annotated, Literal

import pydantic
from pydantic import Field
from pydantic.dataclasses import dataclass

from envs.config import STRICT, Fraction, Positive
from jobs.config.conditions import Conditions

Count = Annotated[int, Field(ge=1)]
NonNegative = Annotated[float, Field(ge=0)]
Name = Annotated[str, Field(min_length=1)]
Pixels = Annotated[int, Field(ge=1, le=65536)]


@dataclass(frozen=True, config=STRICT)
class RecordingConfig:
    """Settings for reading event files, for what the file itself does not say (docs/recordings.md).

    Attributes:
        format: One of `envs.recordings.FORMATS`; None: recognized from the file.
        columns: Text files: names of the columns in their order; npz and HDF5: names of t, x, y and p.
        time_unit: Unit of the times; None: as the file says.
        width, height: Pixels of the sensor; None: as the file says.
        topic: Topic of a ROS bag.
        group: Group or data set of an HDF5 file, array of an npz file.
        stream: Number of a stream of an AEDAT file.
        start_us, end_us: Read events from the first time and before the second [us]; None: all.
        max_events: Most events to read at once; None: the default of `envs.recordings.read_events`.
        strict: Whether a damaged file is an error; otherwise damaged parts are skipped with a warning.
    """

    format: Name | None = None
    columns: list[Name] | None = None
    time_unit: Literal["s", "ms", "us", "ns"] | None = None
    width: Pixels | None = None
    height: Pixels | None = None
    topic: Name | None = None
    group: Name | None = None
    stream: Annotated[int, Field(ge=0)] | None = None
    start_us: Annotated[int, Field(ge=0)] | None = None
    end_us: Annotated[int, Field(ge=1)] | None = None
    max_events: Count | None = None
    strict: bool = False


@dataclass(frozen=True, config=STRICT)
class CollectConfig:
    """The data set of the event VAE; each scene and recording gets an equal share of the steps.

    Attributes:
        scenes: Layouts in which episodes are recorded.
        recordings: Event files of real cameras; a short file contributes all its events.
        policy: Run or policy folder of a policy to record in addition to random actions.
        policy_share: Share of the control steps in which the policy acts.
        conditions: Conditions of the recorded episodes, as in `TrainConfig`.
    """

    scenes: list[Name]
    num_steps: Count
    num_validation_steps: Count
    policy: str | None
    policy_share: Fraction
    recordings: list[Name] = dataclasses.field(default_factory=list)
    conditions: Conditions = dataclasses.field(default_factory=lambda: [{}])


@dataclass(frozen=True, config=STRICT)
class PretrainConfig:
    """Training of the event VAE (appendix B.2).

    Attributes:
        denoise: Whether the decoder reconstructs the events as they were before the faults of the sensor.
    """

    encoder: str | None
    iterations: Count
    batch_windows: Count
    window_events: Count
    windows: Literal["mixed", "count"]
    lr: Positive
    weight_decay: NonNegative
    beta: NonNegative
    beta_schedule: Literal["appendix", "constant"]
    validate_every: Count
    checkpoint_every: Count
    denoise: bool = False


@dataclass(frozen=True, config=STRICT)
class TrainConfig:
    """Training of the policy: length, checkpoints, initial policy and conditions.

    Attributes:
        init: Run or policy folder whose policy the training starts from; None: random weights.
        value_warmup: First environment steps of a training with `init`, in which only the value network
            learns.
        conditions: Settings of the simulation that are replaced together, as in a study; each episode
            draws one condition (`jobs.config.conditions`). [{}] changes nothing.
        candidates: Number of seeds to train; the policy is the best of them under drawn faults.
    """

    env_steps: Count
    checkpoint_every: Count
    init: str | None = None
    value_warmup: Annotated[int, Field(ge=0)] = 20_000
    conditions: Conditions = dataclasses.field(default_factory=lambda: [{}])
    candidates: Count = 1


@dataclass(frozen=True, config=STRICT)
class EvaluateConfig:
    """Evaluation of a policy: held-out corridors and renderers.

    Attributes:
        beside: Published policies to evaluate in the same corridors, each a name in models/pretrained.
    """

    episodes: Count
    renderers: Annotated[list[Literal["raycast", "pyrender"]], Field(min_length=1)]
    pyrender_episodes: Count
    action: Literal["deterministic", "stochastic"]
    beside: list[Name]
    video: bool


@dataclass(frozen=True, config=STRICT)
class ClusterConfig:
    """Where Ray runs, and where its nodes store checkpoints and artifacts.

    Attributes:
        address: Address of a running cluster; None to start Ray on this machine.
        num_cpus: Number of cores that jobs may use; None for all.
        storage: A folder that every node sees (NFS), or an address such as s3://bucket/evade;
            None for the run folder, if there is only one machine.
        device: Device on which event VAEs learn, and on which PPO computes the gradients of networks over
            pictures or sets of events; cuda: this machine's GPU. Results of the two differ by rounding.
    """

    name: Literal["local", "ray"]
    address: str | None
    num_cpus: Count | None
    storage: str | None
    device: Literal["cpu", "cuda"] = "cpu"

    @pydantic.model_validator(mode="after")
    def _has_a_gpu_here(self) -> "ClusterConfig":
        if self.device == "cuda" and self.name != "local":
            raise ValueError(
                "device must be cpu on a cluster, whose machines are not asked for GPUs; got 'cuda'"
            )
        return self

    @pydantic.field_validator("storage")
    @classmethod
    def _every_node_sees_it(cls, storage: str | None) -> str | None:
        if storage is not None and not storage.startswith("/") and "://" not in storage:
            raise ValueError("must be an absolute folder, an address such as s3://bucket/evade, or null")
        return storage


@dataclass(frozen=True, config=STRICT)
class TrackingConfig:
    """The address of the MLflow store that records results, and the experiment's name there."""

    uri: Name
    experiment: Name
