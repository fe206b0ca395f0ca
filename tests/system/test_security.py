"""What no part may do, read from its text; and that no secret is written down, whoever asks for it."""

import ast
import dataclasses
import os
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from jobs.config.config import ConfigError, as_dict
from jobs.config.errors import redacted
from jobs.run.folder import open_run
from jobs.tracking import tracker as tracking
from jobs.tracking.store import dashboard_command, page, store_uri
from jobs.tracking.tracker import open_tracker
from tests.support.configs import small_config
from tests.support.stores import place_store

ROOT = Path(__file__).resolve().parents[2]
SOURCES = [path for room in ("envs", "models", "jobs", "platform") for path in (ROOT / room).rglob("*.py")]

# Calls that run whatever a file or a text holds. numpy loads no pickle unless told to.
RUNS_CODE = re.compile(
    r"(builtins\.)?(eval|exec|compile|__import__)"
    r"|(pickle|cloudpickle|ray\.cloudpickle|dill|joblib|marshal|shelve|jsonpickle|pandas)\.\w*(load|open|read_pickle|Unpickler)\w*"
    r"|yaml\.(load|load_all|unsafe_load|full_load|Loader|UnsafeLoader|FullLoader)|numpy\.lib\.format\.read_array"
    r"|os\.(system|popen|exec\w+|spawn\w+)|subprocess\.(getoutput|getstatusoutput)|pty\.spawn"
    r"|hydra\.utils\..*|hydra\._internal\..*|omegaconf\.OmegaConf\.(register_new_resolver|resolve)"
    r"|mlflow\.(\w+\.)*(log_model|load_model|save_model)|runpy\..*|tempfile\.mktemp|socket\..*"
)
# The rooms' own door: `platform` becomes the standard library's module by its own text.
DOORS = {
    ("platform/__init__.py", "exec"),
    ("platform/__main__.py", "runpy.run_path"),
    ("jobs/run/ray_sessions.py", "socket.socket"),  # asks a Unix socket of one's own whether it is served
    (
        "jobs/tracking/model_registry.py",
        "mlflow.pyfunc.save_model",
    ),  # a script's path and plain files, no pickle
}


def names_of(tree: ast.AST) -> dict[str, str]:
    """What each imported name stands for."""
    names = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names.update({a.asname: a.name for a in node.names if a.asname})
        elif isinstance(node, ast.ImportFrom):
            names.update({a.asname or a.name: f"{node.module}.{a.name}" for a in node.names})
    return names


def dangers(text: str) -> list[str]:
    """The calls and arguments in a program's text that could run what a file holds."""
    tree = ast.parse(text)
    names, found = names_of(tree), []
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        first, dot, rest = ast.unparse(node.func).partition(".")
        called = names.get(first, first) + dot + rest
        arguments = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
        if RUNS_CODE.fullmatch(called):
            found.append(called)
        if called == "torch.load" and arguments.get("weights_only") != "True":
            found.append("torch.load without weights_only=True")
        if arguments.get("allow_pickle", "False") != "False":
            found.append(f"{called} with allow_pickle")
        if arguments.get("shell", "False") != "False":
            found.append(f"{called} with shell")
    return found


def test_no_part_runs_what_a_file_or_a_text_holds():
    found = {
        (str(path.relative_to(ROOT)), danger) for path in SOURCES for danger in dangers(path.read_text())
    }
    assert found == DOORS
    assert len(SOURCES) > 90


@pytest.mark.parametrize(
    "text",
    [
        "from torch import load as l\nl('x', weights_only=False)",
        "import numpy as np\nnp.load('x', allow_pickle=True)",
        "from pickle import loads\nloads(b'')",
        "import subprocess as s\ns.run('ls', shell=True)",
        "eval('1')",
    ],
)  # fmt: skip
def test_the_search_for_such_calls_finds_them(text):
    assert len(dangers(text)) == 1


def keys_in(node: object) -> Iterator[object]:
    """Every key of every mapping in a YAML document."""
    if isinstance(node, dict):
        yield from node
    for child in node.values() if isinstance(node, dict) else node if isinstance(node, list) else ():
        yield from keys_in(child)


def test_configurations_name_no_code():
    for path in (ROOT / "conf").rglob("*.yaml"):
        keys = keys_in(yaml.safe_load(path.read_text()))
        assert [key for key in keys if re.fullmatch(r"_\w+_", str(key))] == [], path
        assert "${oc." not in path.read_text(), path


PASSWORD = "Sesame0pen"
ADDRESSES = {
    f"http://ann:{PASSWORD}@tracker:5000": "http://***@tracker:5000",
    f"https://{PASSWORD}@tracker/": "https://***@tracker/",
    f"postgresql://ann:{PASSWORD}@db:5432/mlflow": "postgresql://***@db:5432/mlflow",
    f"postgresql+psycopg://ann:{PASSWORD}/@{PASSWORD}@db/mlflow": "postgresql+psycopg://***@db/mlflow",
    f"mysql://ann:{PASSWORD}:@db/m?charset=utf8": "mysql://***@db/m?charset=utf8",
    f"postgresql://db/m?user=ann&password={PASSWORD}&x=1": "postgresql://db/m?user=ann&password=***&x=1",
    f"http://tracker?access_token={PASSWORD}": "http://tracker?access_token=***",
}


PLAIN = (
    "sqlite:////data/a@b/mlflow.db", "http://127.0.0.1:5000", "https://tracker/path", "a: b@c", "/data/x@y",
    "http://127.0.0.1:5000/#/experiments/1/runs?viewStateShareKey=results", "postgresql://db/m",
)  # fmt: skip


@pytest.mark.parametrize(("address", "shown"), [*ADDRESSES.items(), *zip(PLAIN, PLAIN, strict=True)])
def test_an_address_is_shown_without_its_password_and_otherwise_as_it_is(address, shown):
    assert redacted(address) == shown
    assert redacted(f"cannot open '{address}': it is shut") == f"cannot open '{shown}': it is shut"


SECRETS = {
    "AWS_SECRET_ACCESS_KEY": "aws-" + PASSWORD,
    "RAY_AUTH_TOKEN": "ray-" + PASSWORD,
    "MLFLOW_TRACKING_PASSWORD": "mlflow-" + PASSWORD,
    "MLFLOW_TRACKING_TOKEN": "token-" + PASSWORD,
    "PGPASSWORD": "pg-" + PASSWORD,
}


def with_address(config, uri: str):
    return dataclasses.replace(config, tracking=dataclasses.replace(config.tracking, uri=uri))


@pytest.mark.parametrize("uri", [next(iter(ADDRESSES)), f"postgresql://ann:{PASSWORD}@db/mlflow"])
def test_no_secret_reaches_run_folders_the_tracker_or_what_is_printed(tmp_path, monkeypatch, uri):
    for name, value in SECRETS.items():
        monkeypatch.setenv(name, value)
    place_store(tmp_path / "mlflow.db")
    open_store, stores = tracking.open_store, []

    def open_local_store(asked: str, experiment: str, storage: str | None):
        stores.append(asked)
        return open_store(f"sqlite:///{tmp_path}/mlflow.db", experiment, storage)

    monkeypatch.setattr(tracking, "open_store", open_local_store)
    config = with_address(small_config(tmp_path), uri)
    folder = open_run(config)
    for _ in range(2):  # the second time continues the first
        with open_tracker(config, folder) as tracker:
            tracker.log(0, {"eval/success_rate": 1.0})
        said = tracker.dashboard() + repr(tracker) + dashboard_command(uri) + page(uri)
        assert PASSWORD not in said
    assert stores == [uri, uri]  # it is asked for with the password
    run = tracker.client.get_run(tracker.run_id)
    assert run.data.params["tracking.uri"] == redacted(uri)
    assert len(tracker.client.search_runs([tracker.experiment_id])) == 1
    written = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert {"config.yaml", "config.json", "tracking.json", "mlflow.db"} <= {path.name for path in written}
    assert [path for path in written if PASSWORD.encode() in path.read_bytes()] == []
    again = open_run(dataclasses.replace(config, resume=str(folder.path)))
    assert store_uri(again.config) == uri  # from the command, not from the folder


def test_mlflow_does_not_print_the_address_with_its_password_either(tmp_path, monkeypatch):
    place_store(tmp_path / "mlflow.db")
    monkeypatch.setenv("MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT", "false")
    tracking.open_store(f"sqlite:///{tmp_path}/mlflow.db", "evade")
    assert os.environ["MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT"] == "true"


def test_an_address_that_was_written_down_without_its_password_is_refused(tmp_path):
    config = with_address(small_config(tmp_path), f"https://ann:{PASSWORD}@tracker")
    stored = as_dict(config)["tracking"]["uri"]
    with pytest.raises(ConfigError, match=r"got 'https://\*\*\*@tracker'; give it again, or leave it out"):
        store_uri(with_address(config, stored))


@pytest.mark.parametrize(
    "words",
    [
        ["--cfg", "job", "+exp=train", f"tracking.uri=http://ann:{PASSWORD}@tracker"],
        ["+exp=train", f"tracking.uri=ftp://ann:{PASSWORD}@tracker"],
        ["+exp=train", f"tracking.ury=http://ann:{PASSWORD}@tracker"],
        ["+exp=train", f"tracking={{uri:ftp://ann:{PASSWORD}@tracker,experiment:x}}"],
        ["+exp=train", f"tracking.uri='http://ann:{PASSWORD}@${{seed}}'"],
        ["+exp=train", f"tracking.uri=http://ann:{PASSWORD}@tracker", "seed=-1"],
        ["+exp=train", f"tracking.uri=http://ann:{PASSWORD}@tracker", "budget=smoke"],
    ],
)
def test_the_launcher_prints_no_password_whatever_it_answers(launch, job, monkeypatch, words):
    def fail(config):
        if config.tracking.uri.startswith("http"):
            raise KeyError(f"nobody at {config.tracking.uri}")
        store_uri(config)

    job(fail)
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    status, out, err = launch(*words)
    assert PASSWORD not in out + err
    assert status == (0 if words[0] == "--cfg" else 1 if words[-1] == "budget=smoke" else 2)
