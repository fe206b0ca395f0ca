import contextlib
import os
import stat
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier
from unittest.mock import Mock, call

import pydantic
import pytest
import ray
from ray.tune import TuneError

from jobs.config.config import ConfigError
from jobs.config.schema import ClusterConfig
from jobs.run import ray_cluster as joining
from jobs.run.ray_cluster import (
    ClusterError,
    check_mode,
    check_private,
    holds,
    make_token,
    storage,
    use_token,
)
from tests.support.patience import HANG_S
from tests.support.sockets import beyond_loopback, listening

ROOT = Path(__file__).resolve().parents[3]
LOCAL = ClusterConfig(name="local", address=None, num_cpus=1, storage=None)
JOINED = ClusterConfig(name="ray", address="127.0.0.1:1", num_cpus=None, storage=None)


def cluster(place):
    return ClusterConfig(name="ray", address="auto", num_cpus=None, storage=place)


def test_what_nodes_write_lies_in_the_run_folder_or_under_its_name_in_a_storage_that_all_find(tmp_path):
    folder = tmp_path / "runs" / "a-smoke-s0-1" / "train"
    assert storage(cluster(None), folder) == str(folder)
    assert storage(cluster("/nfs/evade/"), folder) == "/nfs/evade/a-smoke-s0-1/train"
    assert storage(cluster("s3://bucket/evade"), folder) == "s3://bucket/evade/a-smoke-s0-1/train"
    with pytest.raises(pydantic.ValidationError, match="must be an absolute folder"):
        cluster("checkpoints")


def test_a_folder_is_searched_by_its_path_and_by_its_address(tmp_path):
    (tmp_path / "experiment_state-1.json").touch()
    for place in (str(tmp_path), tmp_path.as_uri()):
        assert holds(place, "experiment_state-")
        assert not holds(place, "tuner")
        assert not holds(f"{place}/none", "experiment_state-")


@pytest.fixture
def no_token(monkeypatch):
    """An environment that names no token; what a test adds to it is undone."""
    for name in ("RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH", "RAY_AUTH_MODE"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)


def test_the_token_of_a_local_ray_can_be_read_by_its_owner_alone(tmp_path, monkeypatch, no_token):
    monkeypatch.setenv("HOME", "/nowhere")
    file = tmp_path / ".ray" / "token"
    use_token(file)
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert stat.S_IMODE(file.parent.stat().st_mode) == 0o700
    assert list(file.parent.iterdir()) == [file]
    assert os.environ["RAY_AUTH_TOKEN_PATH"] == str(file)
    token = file.read_text()
    use_token(tmp_path / "other")
    assert file.read_text() == token
    assert len(token) == 64
    assert not (tmp_path / "other").exists()


def test_who_makes_a_token_at_the_same_time_finds_the_same_one(tmp_path):
    gate = Barrier(8)

    def make(file: Path) -> str:
        gate.wait()
        make_token(file)
        return file.read_text()

    for number in range(5):
        file = tmp_path / str(number) / "token"
        with ThreadPoolExecutor(8) as pool:
            tokens = set(pool.map(make, [file] * 8))
        assert len(tokens) == 1
        assert len(tokens.pop()) == 64
        assert list(file.parent.iterdir()) == [file]


@pytest.mark.parametrize(("mode", "is_given"), [(0o604, True), (0o640, False), (0o620, True)])
def test_a_token_that_others_can_read_is_refused_with_the_remedy(
    tmp_path, monkeypatch, no_token, mode, is_given
):
    file = tmp_path / "token"
    file.write_text("x" * 64)
    file.chmod(mode)
    if is_given:
        monkeypatch.setenv("RAY_AUTH_TOKEN_PATH", str(file))
    with pytest.raises(ConfigError, match=rf"got mode {mode:04o} .* run `chmod 600 {file}`"):
        use_token(tmp_path / "other" if is_given else file)
    file.chmod(0o600)
    use_token(file)
    with pytest.raises(ConfigError, match=r"RAY_AUTH_TOKEN_PATH: .* cannot be read: No such file"):
        check_private(tmp_path / "none")
    owner = os.getuid()
    monkeypatch.setattr(os, "getuid", lambda: owner + 1)
    with pytest.raises(ConfigError, match=f"mode 0600 of user {owner}"):
        check_private(file)


@pytest.mark.parametrize("mode", ["disabled", ""])
def test_the_token_of_a_local_ray_cannot_be_turned_off(monkeypatch, mode):
    monkeypatch.setenv("RAY_AUTH_MODE", mode)
    with pytest.raises(ConfigError, match=rf"RAY_AUTH_MODE: must be token, .* got '{mode}'; unset it"):
        check_mode(LOCAL)


def test_a_cluster_is_joined_without_a_token_only_when_that_is_said(monkeypatch, no_token):
    check_mode(LOCAL)
    with pytest.raises(ConfigError, match=r"RAY_AUTH_MODE: must be token or disabled .* got None; set it to"):
        check_mode(JOINED)
    for mode in ("token", "disabled"):
        monkeypatch.setenv("RAY_AUTH_MODE", mode)
        check_mode(JOINED)


# Serves until its standard input ends; the first line it prints is the address, the second its folders.
HEAD = """
import os
import sys
from pathlib import Path
from jobs.run.ray_cluster import logs_folder, start_ray
from jobs.config.schema import ClusterConfig
start_ray(ClusterConfig(name="local", address=None, num_cpus=1, storage=None), Path(sys.argv[1]))
import ray
from ray.air._internal.filelock import TempFileLock
from ray.train.constants import _get_ray_train_session_dir
@ray.remote
def whoami():
    return os.environ["RAY_AUTH_MODE"]
assert ray.get(whoami.remote()) == "token"
with TempFileLock("something"):
    pass
print(ray.get_runtime_context().gcs_address)
print(logs_folder(), _get_ray_train_session_dir(), sep=os.pathsep, flush=True)
sys.stdin.read()
"""
CLIENT = """
import sys
import ray
ray.init(address=sys.argv[1], log_to_driver=False, logging_level="ERROR")
print("joined")
"""


def join(address: str, environment: dict[str, str], **more: str) -> str:
    """What a process says that joins a Ray."""
    command, told = [sys.executable, "-c", CLIENT, address], {"capture_output": True, "text": True}
    client = subprocess.run(command, env=environment | more, timeout=HANG_S, check=False, **told)
    return client.stdout.strip() or client.stderr


@pytest.mark.system
def test_a_local_ray_is_reached_from_here_alone_by_who_has_its_token_and_keeps_its_files_private(
    tmp_path, no_token
):
    environment = {name: value for name, value in os.environ.items() if not name.startswith("RAY_AUTH")}
    environment["RAY_NUM_REDIS_GET_RETRIES"] = "1"  # of joining; Ray's own 20 take as many seconds
    environment["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"  # else it asks another address than 127.0.0.1
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as shared:
        Path(shared).chmod(0o1777)
        command = [sys.executable, "-c", HEAD, str(tmp_path)]
        with subprocess.Popen(command, cwd=ROOT, env=environment | {"TMPDIR": shared}, **pipes) as head:
            address, folders = (head.stdout.readline().strip() for _ in range(2))
            found = listening(head.pid)
            token = (tmp_path / ".ray" / "token").read_text()
            without = join(address, environment, RAY_AUTH_MODE="disabled")
            wrong = join(address, environment, RAY_AUTH_MODE="token", RAY_AUTH_TOKEN="0" * 64)
            right = join(address, environment, RAY_AUTH_MODE="token", RAY_AUTH_TOKEN=token)
            head.stdin.close()
            assert head.wait(HANG_S) == 0
        private = Path(shared, f"evade-{os.getuid()}")
        assert all(Path(folder).is_relative_to(private / "ray") for folder in folders.split(os.pathsep))
        assert (private / "ray" / "session_latest" / "logs" / "raylet.out").exists()
        assert stat.S_IMODE(private.stat().st_mode) == 0o700
        assert list(Path(shared).iterdir()) == [private]
    assert right == "joined"
    for refused in (without, wrong):
        assert "joined" not in refused
        assert "uthenticat" in refused
    assert address.startswith("127.0.0.1:")
    assert {"gcs_server", "raylet"} <= {name for name, _, _ in found}, found
    assert len(found) >= 6, found  # gcs_server, raylet (2), its agent, the driver, a worker
    assert beyond_loopback(found) == []


def test_rays_folder_leaves_room_for_the_names_of_sockets(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", "/tmp")
    assert joining.ray_folder() == Path(f"/tmp/evade-{os.getuid()}")
    (tmp_path / ("x" * 50)).mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / ("x" * 50)))
    assert joining.ray_folder() == Path(f"/tmp/evade-{os.getuid()}")


BUSY = Exception("The current node timed out during startup. ...")


@pytest.mark.parametrize(
    ("raised", "started", "error"),
    [
        ([None], 1, None),
        ([BUSY, None], 2, None),
        ([BUSY] * joining.MAX_STARTS, joining.MAX_STARTS, (ClusterError, "the machine is too busy")),
        ([ValueError("no such setting")], 1, (ValueError, "no such setting")),
    ],
)
def test_a_busy_machine_gets_more_than_one_chance_to_start_ray(monkeypatch, raised, started, error):
    init, shutdown = Mock(side_effect=raised), Mock()
    monkeypatch.setattr(ray, "init", init)
    monkeypatch.setattr(ray, "shutdown", shutdown)
    with pytest.raises(error[0], match=error[1]) if error else contextlib.nullcontext():
        joining._start_local({"num_cpus": 1})
    assert init.mock_calls == [call(address="local", include_dashboard=False, num_cpus=1)] * started
    assert shutdown.call_count == raised.count(BUSY)


def test_what_a_callback_raises_comes_out_of_tune_as_it_is():
    error = TuneError("Traceback ...")
    error.__context__ = ClusterError("the reason")
    with pytest.raises(ClusterError, match="the reason"):
        joining.fit(Mock(fit=Mock(side_effect=error)))


def refused_join(monkeypatch, error):
    """What is said when Ray raises this as it joins."""
    monkeypatch.setattr(ray, "init", Mock(side_effect=error))
    with pytest.raises(ConfigError) as caught:
        joining._join("h:6379", {})
    return str(caught.value)


def test_who_cannot_join_is_told_why_in_one_line(monkeypatch):
    unreachable = ConnectionError("Failed to connect to Ray cluster at h:6379")
    assert refused_join(monkeypatch, unreachable) == f"cluster.address: cannot join 'h:6379': {unreachable}"
    unreachable.__cause__ = RuntimeError("Traceback ...\nRPC error: InvalidAuthToken: Authentication ...")
    said = refused_join(monkeypatch, unreachable)
    assert "it asks for another token" in said
    assert "RAY_AUTH_TOKEN_PATH" in said
    versions = "Version mismatch: The cluster was started with:\n    Ray: 2.59.0\n    Python: 3.11.7\n"
    said = refused_join(monkeypatch, RuntimeError(versions))
    assert said.endswith("with: Ray: 2.59.0 Python: 3.11.7; install the same packages on every machine")
