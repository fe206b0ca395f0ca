"""Run folders: all files of one experiment, found again by its configuration.

A folder is named after the configuration that fills it, so that the same command finds
the same folder and continues there. Each finished stage leaves a marker with its results.
"""

import contextlib
import dataclasses
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import yaml

from envs.config import settings_hash
from jobs.config.config import Config, ConfigError, as_dict, parse
from jobs.run.files import RunError, read_json, write_atomic, write_json
from jobs.run.identity import TRAINED_BY, identity
from jobs.run.progress import console
from jobs.run.provenance import provenance
from jobs.run.undo import keep_what_was_made, undo_if_refused
from models.kinds import RENAMED, renamed

# Files of a run folder before it has any result.
NEW_FILES = ("config.yaml", "config.json", "tracking.json", ".lock")
COMPARED_STEPS = 500_000  # length of the trainings that are compared, as in the paper

Results = TypeVar("Results", bound=Mapping[str, object])


@dataclass(frozen=True)
class Run:
    """A run folder and its configuration."""

    path: Path
    config: Config

    @property
    def data(self) -> Path:
        """Return the folder of the recordings."""
        return self.path / "data"

    @property
    def encoder(self) -> Path:
        """Return the folder of the frozen encoder, its manifest and checkpoints."""
        return self.path / "encoder"

    @property
    def init(self) -> Path:
        """Return the folder with a copy of the policy from which the training starts."""
        return self.path / "init"

    @property
    def train(self) -> Path:
        """Return the folder of the checkpoints of the policy's training."""
        return self.path / "train"

    @property
    def policy(self) -> Path:
        """Return the folder of the trained policy, as `models.policy.load_policy` reads it."""
        return self.path / "policy"

    @property
    def evaluation(self) -> Path:
        """Return the folder of episodes, tables, plots and videos."""
        return self.path / "eval"


def open_run(config: Config) -> Run:
    """Return the run folder of a configuration; write the configuration to it if the folder is new.

    Raises:
        ConfigError: If `resume` names no run folder, or one that this version cannot continue.
    """
    run = locate_run(config)
    if not (run.path / "config.json").exists():
        undo_if_refused(partial(_remove_new, run.path))
        values = as_dict(config)
        write_atomic(run.path / "config.yaml", yaml.safe_dump(values, sort_keys=False))
        write_json(run.path / "config.json", values)
    return run


def locate_run(config: Config) -> Run:
    """Return the run folder of a configuration, like `open_run`, without writing anything."""
    if config.resume is not None:
        return reopen(Path(config.resume), config)
    path = Path(config.runs_dir).resolve() / run_name(config)
    if not path.exists():
        check_writable("runs_dir", path.parent)
    return Run(path, config)


def check_writable(key: str, folder: Path) -> None:
    """Check that a folder is writable, or can be created if it is missing; leave nothing behind.

    Raises:
        ConfigError: It is not; the message gives the reason.
    """
    missing = [place for place in (folder, *folder.parents) if not place.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        rule = f"must be in a folder that you can write, got {str(folder)!r} ({error.strerror})"
        raise ConfigError(f"{key}: {rule}; give another, such as runs_dir=/tmp/evade/runs") from None
    finally:
        for place in missing:
            with contextlib.suppress(OSError):
                place.rmdir()


def _remove_new(path: Path) -> None:
    """Remove a run folder that has a configuration and no results."""
    for file in [path / name for name in NEW_FILES]:
        file.unlink(missing_ok=True)
    shutil.rmtree(path / ".ray", ignore_errors=True)
    for place in (path / "train", path, path.parent):  # folders with other files stay
        with contextlib.suppress(OSError):
            place.rmdir()


def reopen(path: Path, config: Config) -> Run:
    """Return an existing run folder: the sections in `TRAINED_BY` as stored there, the rest from `config`.

    Raises:
        ConfigError: If `path` is no run folder, or its model has been renamed since.
    """
    stored = path.resolve() / "config.json"
    if not stored.is_file():
        raise ConfigError(
            f"resume: must be a run folder (one that holds config.json), got {str(path)!r}; "
            f"run folders are in {str(Path(config.runs_dir).resolve())!r}"
        )
    values = read_json(stored)
    model = values["model"]["name"]
    if model in RENAMED:
        raise ConfigError(
            f"resume: {str(path)!r} was made with model {model}{renamed(model)}, and cannot be continued; "
            "train it again, or check out the commit that its stages/ name"
        )
    # Older versions wrote null for the settings that a kind of model does not have.
    values["model"] = {name: value for name, value in values["model"].items() if value is not None}
    run = parse({**as_dict(config), **{name: values.get(name) for name in TRAINED_BY}})
    return Run(stored.parent, dataclasses.replace(run, tracking=config.tracking))  # not stored: its password


def run_name(config: Config) -> str:
    """Return `<exp>-<budget>-s<seed>-<hash>`; the hash covers `identity`."""
    return f"{config.exp}-{config.budget}-s{config.seed}-{settings_hash(identity(config))[:8]}"


def group_name(settings: Mapping[str, Any]) -> str:
    """Return the name of the group to which a training with these settings belongs.

    It is the experiment, followed by the length unless that is `COMPARED_STEPS` or a planner is imitated.
    """
    env_steps, taught = settings["train"]["env_steps"], settings["algo"].get("imitation") is not None
    return str(settings["exp"]) + ("" if taught or env_steps == COMPARED_STEPS else f"_{env_steps // 1000}k")


def finished(run: Run, stage: str) -> dict[str, Any] | None:
    """Return the results of a finished stage; None while it is not finished."""
    marker = run.path / "stages" / f"{stage}.json"
    return read_json(marker)["figures"] if marker.is_file() else None


def finish(run: Run, stage: str, results: Results) -> Results:
    """Mark a stage as finished, with its results; return them.

    Raises:
        ValueError: If a result is NaN or infinite.
    """
    keep_what_was_made()
    made = {**provenance(), "device": run.config.cluster.device}
    write_json(run.path / "stages" / f"{stage}.json", {"figures": results, **made})
    return results


def latest_policies(runs_dir: str | Path) -> dict[str, Path]:
    """Return the newest policy folder of each kind: name of the model -> folder."""
    manifests = Path(runs_dir).resolve().glob("*/policy/policy.json")
    ordered = sorted(manifests, key=lambda path: path.stat().st_mtime_ns)
    found = {}
    for path in ordered:
        try:
            found[read_json(path).get("name", "")] = path.parent
        except RunError:  # of another run, whose own commands report it
            console.print(f"Damaged, not considered: {path}")
    return found


def named_policy(name: str) -> Path | None:
    """Return the policy folder at a path, or in the run folder at that path; None if there is none."""
    found = (path for path in (Path(name), Path(name) / "policy") if (path / "policy.json").is_file())
    return next((path.resolve() for path in found), None)
