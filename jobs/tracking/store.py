"""The address of the tracking store, and checks of what is written to it."""

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from jobs.config.config import Config, ConfigError
from jobs.config.errors import HIDDEN, redacted
from jobs.config.flat import flat
from jobs.run.provenance import REPOSITORY

SECTIONS = ("collect", "evae", "train", "eval", "sim", "perf", "sweep", "tune")
MAX_METRICS = 40  # of one call; a page with hundreds of charts can be neither read nor drawn
MAX_PARAM_CHARACTERS = 6000  # MLflow cuts longer values and only warns
# Of addresses that MLflow supports for runs.
SCHEMES = ("sqlite:///", "http://", "https://", "postgresql", "mysql")
RULE = "must begin with sqlite:/// or http:// or https://"
LOCAL_PAGE = "http://127.0.0.1:5000"


def store_uri(config: Config) -> str:
    """Return the store's address; a relative SQLite file lies in the parent folder of `runs_dir`.

    Raises:
        ConfigError: MLflow does not support runs at this kind of address, or the address is a copy
            with a hidden password.
    """
    uri = config.tracking.uri
    if HIDDEN in uri:
        remedy = (
            "give it again, or leave it out and set MLFLOW_TRACKING_USERNAME and MLFLOW_TRACKING_PASSWORD "
            "(of a server) or PGPASSFILE (of PostgreSQL)"
        )
        raise ConfigError(f"tracking.uri: must hold the password itself, got {uri!r}; {remedy}")
    if uri.startswith("sqlite:///"):
        folder = quoted(str(Path(config.runs_dir).resolve().parent))
        return f"sqlite:///{Path(folder, uri.removeprefix('sqlite:///'))}"
    if uri.startswith(SCHEMES):
        return uri
    raise ConfigError(f"tracking.uri: {RULE}, got {redacted(uri)!r}")


def quoted(path: str) -> str:
    """Return a path for use in an address, where `%` and `?` have special meanings."""
    return path.replace("%", "%25").replace("?", "%3F")


def sqlite_file(uri: str) -> Path | None:
    """Return the file of an SQLite store; None for an address of another kind."""
    if not uri.startswith("sqlite:///"):
        return None
    return Path(unquote(uri.removeprefix("sqlite:///").partition("?")[0]))


def of_environment(values: dict[str, Any], words: Sequence[str], variables: Mapping[str, str]) -> list[str]:
    """Let MLflow's own variables name the store and the experiment, unless the command line does.

    Args:
        values: A composed configuration, changed in place.
        words: The command line's words.
        variables: The environment.

    Returns:
        A line for the user for each variable that is set: that it is used, or why it is not.
    """
    lines = []
    for variable, name in (("MLFLOW_TRACKING_URI", "uri"), ("MLFLOW_EXPERIMENT_NAME", "experiment")):
        value, key = variables.get(variable), f"tracking.{name}"
        if not value:
            continue
        if any(re.match(rf"\+*(?:{re.escape(key)}|tracking)=", word) for word in words):
            lines.append(f"{variable} is not used: the command line gives {key}")
        elif name == "uri" and not value.startswith(SCHEMES):
            lines.append(f"{variable} is not used: {RULE}, got {redacted(value)!r}")
        else:
            values["tracking"][name] = value
            lines.append(f"{variable} sets {key}={redacted(value)}")
    return lines


def page(uri: str) -> str:
    """Return the address of a tracking store in a browser, which will ask for the password."""
    return redacted(uri).replace(f"{HIDDEN}@", "").rstrip("/") if uri.startswith("http") else LOCAL_PAGE


def dashboard_command(uri: str) -> str:
    """Return the command that serves a store to browsers of this machine only."""
    return "make mlflow" if uri == f"sqlite:///{quoted(str(REPOSITORY))}/mlflow.db" else server_command(uri)


def server_command(uri: str) -> str:
    """Return the shell command, with its variables, that serves any store."""
    lean = (
        "MLFLOW_SERVER_ENABLE_JOB_EXECUTION=false MLFLOW_DISABLE_TELEMETRY=true "
        "MLFLOW_ALLOW_PICKLE_DESERIALIZATION=false"
    )
    server = "mlflow server --workers 1 --host 127.0.0.1 --port 5000"
    return f"{lean} {server} --backend-store-uri {redacted(uri)}"


def check_metrics(metrics: Mapping[str, float]) -> dict[str, float]:
    """Return the metrics as floats; raise ValueError as `jobs.tracking.tracker.Tracker.log` describes."""
    values = {name: float(value) for name, value in metrics.items()}
    infinite = [f"{name} = {value}" for name, value in values.items() if math.isinf(value)]
    if infinite:
        raise ValueError(f"metrics must be finite, got {', '.join(infinite)}; leave out the unmeasured")
    stray = [name for name in values if name.partition("/")[0] not in SECTIONS or "/" not in name]
    if stray:
        raise ValueError(f"metric names must be section/name with a section of {SECTIONS}, got {stray}")
    if len(values) > MAX_METRICS:
        raise ValueError(f"metrics must be at most {MAX_METRICS} a call, got {len(values)}; choose some")
    return values


def flatten(values: Mapping[str, object]) -> dict[str, str]:
    """Return nested settings as `outer.inner` -> text; raise ValueError for a text that MLflow would cut."""
    texts = {name: str(value) for name, value in flat(values)}
    for name, text in texts.items():
        if len(text) > MAX_PARAM_CHARACTERS:
            raise ValueError(f"{name} must be at most {MAX_PARAM_CHARACTERS} characters, got {len(text)}")
    return texts
