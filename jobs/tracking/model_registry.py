"""Trained policies in MLflow's model registry: one name per experiment, one version per training.

A version is complete in itself: the policy folder (safetensors and JSON), the script `tracking.served_policy`
and the packages `core` and `models`. Nothing is pickled, and nothing is installed to find its requirements.
"""

import importlib.metadata
import shutil
import tempfile
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from envs.config import settings_hash
from jobs.run.files import read_json
from jobs.run.provenance import REPOSITORY
from jobs.tracking.tracker import Tracker
from models.kinds import find_kind
from models.policy.policy import MANIFEST, read_policy_manifest

if TYPE_CHECKING:
    from mlflow.models import ModelSignature

PREFIX = "evade-"
# Packages that `jobs.tracking.served_policy` and `models` import.
NEEDED = ("mlflow", "numba", "numpy", "pandas", "pydantic", "safetensors", "torch")
ABOUT = """\
Policies of `{group}`, a version for each training; its tags name seed, length, commit and metrics.

    model = mlflow.pyfunc.load_model("models:/{name}/1")
    actions = model.predict(observations_of_an_episode)["action"]

Loading a policy runs the code in its folder, as for any MLflow model; the weights alone are in
the artifacts of the model, `artifacts/policy`, for `models.policy.load_policy`.
"""
INTERFACE = (
    "The observations of one episode, from its start: events t [us], x, y, p (-1 or +1), or pictures of "
    "luminance. Out come, for its start and after each control step, the likeliest action (0 forward, "
    "1 left, 2 right) and the logits of all."
)
SHOWN = ("eval/success_rate", "eval/success_rate_low", "eval/success_rate_high", "eval/distance_m",
         "train/success_rate", "sim/event_error")  # fmt: skip


def register_training(tracker: Tracker, path: Path) -> str:
    """Register the policy of a run folder whose training is finished, with the metrics of its stages.

    Returns:
        The version's name, as `register`.
    """
    config = read_json(path / "config.json")
    train, evaluated = (path / "stages" / f"{stage}.json" for stage in ("train", "evaluate"))
    about = read_json(train)
    metrics = about["figures"]
    if evaluated.is_file():
        metrics |= read_json(evaluated)["figures"]["figures"]
    tags = {name: config[name] for name in ("seed", "budget")} | {"run": path.name, "commit": about["commit"]}
    tags["env_steps"] = config["train"]["env_steps"]  # all lengths are versions of one model
    tags |= {name: metrics[name] for name in SHOWN if name in metrics}
    return register(tracker, path / "policy", config["exp"], tags)


def register(tracker: Tracker, policy: Path, group: str, tags: Mapping[str, object]) -> str:
    """Register the policy of a training once; an existing version gets the new tags.

    Args:
        tracker: The MLflow run of the training.
        policy: The policy folder.
        group: The experiment to which the training belongs.
        tags: Facts for readers of the version; floats are shortened.

    Returns:
        The version's name, "evade-bytestream/2".
    """
    client, name = tracker.client, PREFIX + group
    manifest = read_policy_manifest(policy / MANIFEST)
    identity = settings_hash(manifest)
    if not client.search_registered_models(f"name = '{name}'"):
        client.create_registered_model(name, description=ABOUT.format(group=group, name=name))
    versions = client.search_model_versions(f"name = '{name}'")
    found = next((one for one in versions if one.tags.get("policy") == identity), None)
    version = found or _add_version(tracker, policy, name, manifest)
    for key, value in {**tags, "policy": identity}.items():
        text = f"{value:.4g}" if isinstance(value, float) else value
        client.set_model_version_tag(name, version.version, key, text)
    return f"{name}/{version.version}"


def _add_version(tracker: Tracker, policy: Path, name: str, manifest: Mapping[str, Any]) -> Any:
    """Write the model's files into the store; return a new version that points to them."""
    from mlflow import pyfunc
    from mlflow.entities import LoggedModelOutput

    client = tracker.client
    with tempfile.TemporaryDirectory() as place:
        code, files = [str(Path(place) / room) for room in ("core", "models")], Path(place) / "model"
        for copy in code:
            unused = shutil.ignore_patterns("pretrained", "__pycache__")
            shutil.copytree(REPOSITORY / Path(copy).name, copy, ignore=unused)
        with warnings.catch_warnings():  # MLflow asks for an example of the input
            warnings.simplefilter("ignore", UserWarning)
            pyfunc.save_model(
                files,
                python_model=str(REPOSITORY / "jobs" / "tracking" / "served_policy.py"),
                artifacts={"policy": str(policy)},
                code_paths=code,
                signature=signature(manifest),
                pip_requirements=[f"{package}=={importlib.metadata.version(package)}" for package in NEEDED],
            )
        model = client.create_logged_model(tracker.experiment_id, name, tracker.run_id)
        client.log_model_artifacts(model.model_id, str(files))
    client.finalize_logged_model(model.model_id, "READY")
    client.log_outputs(tracker.run_id, [LoggedModelOutput(model.model_id, step=0)])
    return client.create_model_version(
        name,
        model.artifact_location,
        tracker.run_id,
        model_id=model.model_id,
        description=INTERFACE,
        await_creation_for=None,
    )


def signature(manifest: Mapping[str, Any]) -> "ModelSignature":
    """Return the signature of `ServedPolicy.predict` for the policy of a manifest."""
    import numpy as np
    from mlflow.models import ModelSignature
    from mlflow.types import ColSpec, ParamSchema, ParamSpec, Schema, TensorSpec

    from models.policy.policy import action_names

    logits = [ColSpec("float", name) for name in action_names(manifest)]
    given = Schema([ColSpec("long", "step"), ColSpec("long", "action"), *logits])
    if find_kind(manifest["name"]).observation == "luminance":
        shape = (-1, manifest["height"], manifest["width"], 1)
        return ModelSignature(Schema([TensorSpec(np.dtype(np.float32), shape)]), given)
    window_us = round(1e6 / manifest["sensor"]["control_hz"])
    return ModelSignature(
        Schema([ColSpec("long", name) for name in "txyp"]),
        given,
        ParamSchema([ParamSpec("window_us", "long", window_us)]),
    )
