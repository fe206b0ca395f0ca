"""Inputs of a training: a pretrained encoder, or a complete policy that was trained before.

`train.init` names such a policy. The run folder stores a copy, so a stopped training resumes even if the
original is gone. The training uses the policy's encoder; nothing is collected or pretrained.
"""

from pathlib import Path

from ray._private.utils import get_num_cpus

from jobs.config.config import Config, ConfigError
from jobs.config.errors import differences
from jobs.rollout.policies import load_trained
from jobs.run.files import read_json, write_atomic
from jobs.run.folder import Run, finished, locate_run, named_policy
from jobs.tracking.tracker import Tracker
from jobs.training.policy import policy_spec
from jobs.training.pretrain import check_sources, encoder_file, prepare_encoder
from models.policy.policy import ENCODER, ENCODER_FILES, MANIFEST, NETWORKS, Policy


def check_inputs(config: Config) -> None:
    """Check the inputs of a training, its CPUs and its GPU before the run writes anything.

    Raises:
        ConfigError: `train.init` names no policy, or one that does not fit; or `check_sources` or
            `check_cpus` fails.
    """
    check_sources(config)
    check_cpus(config)
    folder = locate_run(config)
    if folder.config.train.init is not None:
        check_init(folder)


def check_cpus(config: Config) -> None:
    """Check that a local Ray has a CPU for each env runner; otherwise Tune would wait forever.

    Raises:
        ConfigError: There are more env runners than CPUs.
    """
    needed, cpus = config.algo.num_env_runners, config.cluster.num_cpus or get_num_cpus()
    if config.cluster.name == "local" and needed > cpus:
        rule = f"needs as many CPUs, and Ray has {cpus} (algo=ppo needs one)"
        raise ConfigError(f"algo.num_env_runners: {rule}, got {needed}")


def prepare_inputs(folder: Run, tracker: Tracker) -> Path | None:
    """Copy the initial policy or create the encoder; return the encoder file, None if there is none."""
    if folder.config.train.init is None:
        return prepare_encoder(folder, tracker)
    source, policy = check_init(folder)
    if source != folder.init:
        parent = tracker.of(source.parent).run_id
        lineage = {"init": source, "init_sha256": policy.manifest["sha256"][NETWORKS]}
        tracker.tags(lineage | ({"init_run": parent} if parent != tracker.run_id else {}))
        # The manifest is last: a copy with a manifest is complete.
        names = (*(ENCODER_FILES if policy.spec.frozen else ()), NETWORKS, MANIFEST)
        for name in names:
            write_atomic(folder.init / name, (source / name).read_bytes())
    return folder.init / ENCODER if policy.spec.frozen else None


def check_init(folder: Run) -> tuple[Path, Policy]:
    """Return folder and policy from which a run starts; the folder is the run's own copy if it has one.

    Raises:
        ConfigError: `train.init` names no policy, or one with another model, sensor or encoder.
    """
    config, kept = folder.config, str(folder.init)
    name = kept if named_policy(kept) else str(config.train.init)
    path, policy = load_trained("train.init", name, config.env)
    differ = differences(policy.spec.manifest(), policy_spec(config).manifest())
    if differ:
        remedy = "set model as it is there, or begin from another"
        raise ConfigError(f"train.init: must be a policy of the same model, got {differ}; {remedy}")
    if policy.spec.frozen and finished(folder, "pretrain") is not None:
        files = path / ENCODER, encoder_file(folder)
        theirs, own = (read_json(file.with_suffix(".json"))["sha256"] for file in files)
        if theirs != own:
            remedy = f"delete {folder.path / 'stages' / 'pretrain.json'} to take its encoder"
            raise ConfigError(f"train.init: must have the encoder of this run, {own}, got {theirs}; {remedy}")
    return path, policy
