"""Run folders: where one experiment keeps everything it made, and how it is found again.

A folder is named after the configuration that fills it, so that the same command finds
the same folder and continues there. Each finished stage leaves a marker with its figures.
"""

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from envs.config import settings_hash
from jobs.config.config import Config, ConfigError, as_dict, parse
from jobs.run.files import read_json, write_atomic, write_json
from jobs.run.provenance import provenance

# Where a run is computed and written down, and how its policy is flown afterwards, does not
# change what is trained.
UNNAMED = (
    "job", "resume", "runs_dir", "cluster", "tracking",
    "evaluate", "sweep", "trade", "trade_simulator", "trade_encoder", "probe",
)  # fmt: skip
# Settings that older run folders lack, with the value that does what they did.
LATER: dict[str, dict[str, Any]] = {"collect": {"recordings": []}, "train": {"conditions": [{}]}}
COMPARED_STEPS = 500_000  # the paper's; of every training that is compared with others


@dataclass(frozen=True)
class Run:
    """One run folder and the configuration that fills it."""

    path: Path
    config: Config

    @property
    def data(self) -> Path:
        """Recordings."""
        return self.path / "data"

    @property
    def encoder(self) -> Path:
        """The frozen encoder, its manifest and checkpoints."""
        return self.path / "encoder"

    @property
    def train(self) -> Path:
        """Checkpoints of the policy's training."""
        return self.path / "train"

    @property
    def policy(self) -> Path:
        """The trained policy, ready to fly."""
        return self.path / "policy"

    @property
    def evaluation(self) -> Path:
        """Episodes, tables, figures and videos."""
        return self.path / "eval"


def open_run(config: Config) -> Run:
    """The folder of a configuration: the one it names, the one to resume, or a new one.

    Raises:
        ConfigError: If `resume` names no run folder.
    """
    run = locate_run(config)
    if not (run.path / "config.json").exists():
        values = as_dict(config)
        write_atomic(run.path / "config.yaml", yaml.safe_dump(values, sort_keys=False))
        write_json(run.path / "config.json", values)
    return run


def locate_run(config: Config) -> Run:
    """The same as `open_run`, without making anything: for jobs that may refuse to begin."""
    if config.resume is not None:
        return reopen(Path(config.resume), config)
    return Run(Path(config.runs_dir).resolve() / run_name(config), config)


def reopen(path: Path, config: Config) -> Run:
    """An existing run folder with its own stored configuration; only `UNNAMED` is taken from `config`."""
    stored = path.resolve() / "config.json"
    if not stored.is_file():
        raise ConfigError(
            f"resume: must be a run folder (one that holds config.json), got {str(path)!r}; "
            f"run folders are in {str(Path(config.runs_dir).resolve())!r}"
        )
    here = {name: value for name, value in as_dict(config).items() if name in UNNAMED}
    values = read_json(stored)
    values |= {section: {**late, **values[section]} for section, late in LATER.items()}
    run = parse({**values, **here})
    return Run(stored.parent, dataclasses.replace(run, tracking=config.tracking))  # with its password


def run_name(config: Config) -> str:
    """`<exp>-<budget>-s<seed>-<hash>`; the hash covers every setting that can change what is trained.

    A setting of `LATER` counts only where it changes something, so that older folders keep their names.
    """
    settings = {name: value for name, value in as_dict(config).items() if name not in UNNAMED}
    for section, late in LATER.items():
        values = settings[section].items()
        settings[section] = {name: value for name, value in values if late.get(name, ...) != value}
    return f"{config.exp}-{config.budget}-s{config.seed}-{settings_hash(settings)[:8]}"


def group_name(exp: str, env_steps: int) -> str:
    """What a training is one of: its experiment, with its length if that is not the compared one."""
    return exp + ("" if env_steps == COMPARED_STEPS else f"_{env_steps // 1000}k")


def finished(run: Run, stage: str) -> dict[str, Any] | None:
    """The figures of a finished stage, or None while it is not finished."""
    marker = run.path / "stages" / f"{stage}.json"
    return read_json(marker)["figures"] if marker.is_file() else None


def finish(run: Run, stage: str, figures: dict[str, Any]) -> dict[str, Any]:
    """Mark a stage as finished, with its figures; return them."""
    write_json(run.path / "stages" / f"{stage}.json", {"figures": figures, **provenance()})
    return figures


def latest_policies(runs_dir: str | Path) -> dict[str, Path]:
    """The policy folder that was finished last of each kind: name of the model -> folder."""
    manifests = Path(runs_dir).resolve().glob("*/policy/policy.json")
    ordered = sorted(manifests, key=lambda path: path.stat().st_mtime_ns)
    return {json.loads(path.read_text()).get("name", ""): path.parent for path in ordered}


def named_policy(name: str) -> Path | None:
    """The policy folder that a path names, itself or as its run folder; None if there is none."""
    found = (path for path in (Path(name), Path(name) / "policy") if (path / "policy.json").is_file())
    return next((path.resolve() for path in found), None)
