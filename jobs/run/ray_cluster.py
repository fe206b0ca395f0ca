"""Start or join Ray: quiet, authenticated, one thread per worker; a local Ray listens on loopback only."""

import contextlib
import logging
import os
import secrets
import stat
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from jobs.config.config import ConfigError
from jobs.config.plugins import with_plugins
from jobs.config.schema import ClusterConfig
from jobs.run.compile import compile_kernels
from jobs.run.device import LEARNER_DEVICE
from jobs.run.head_watch import watching_head
from jobs.run.libraries import of_workers
from jobs.run.locks import locked, private_folder
from jobs.run.provenance import REPOSITORY
from jobs.run.ray_sessions import forget_sessions
from jobs.run.same_code import check_machines
from jobs.run.signals import keeping_handlers

QUIET = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    # At Ray's default of 15, a worker gets a thirtieth of a core that another program uses, too.
    "RAY_worker_niceness": "0",
    # On a busy machine a worker takes minutes to start; after one minute, Ray would start a second one.
    "RAY_worker_register_timeout_seconds": "600",
    "RAY_AIR_NEW_OUTPUT": "0",
    "RAY_CHDIR_TO_TRIAL_DIR": "0",  # relative paths, as of a world, name the same files in a worker
    # Record at once which checkpoint is the newest: after a kill, the record must not name one
    # that newer ones have replaced.
    "TUNE_GLOBAL_CHECKPOINT_S": "0",
    "TUNE_DISABLE_AUTO_CALLBACK_LOGGERS": "1",
    # Tune would treat Ctrl+C as the end of a training.
    "TUNE_DISABLE_SIGINT_HANDLER": "1",
    "TUNE_WARN_EXCESSIVE_EXPERIMENT_CHECKPOINT_SYNC_THRESHOLD_S": "0",
}
# Longest path [bytes]: the path of a socket has at most 107 (103 on macOS), and Ray appends
# "/ray/session_2026-01-31_23-59-59_123456_4194304/sockets/plasma_store".
MAX_RAY_FOLDER = 35
MAX_STARTS = 5  # of a local Ray, which times out after 30 s: too short on a busy machine


class ClusterError(RuntimeError):
    """Ray could not be started; the message says why in one line, and what to do."""


def start_ray(cluster: ClusterConfig, folder: Path) -> None:
    """Start Ray on this machine, or join the configured cluster; do nothing if Ray is running already.

    A local Ray listens on the loopback address only, and keeps its sockets and logs in a private folder.
    It asks every client for a token, which is in a file that only its owner can read. The home folder is
    not used. Workers run one thread each, see `jobs.run.libraries`.

    Args:
        cluster: Where Ray runs.
        folder: Folder for the token of a local Ray.

    Raises:
        ConfigError: If the cluster cannot be joined, one of its machines has different code than this
            one, others can read the token, or RAY_AUTH_MODE does not say whether the cluster requires
            a token.
        ClusterError: If this machine is too busy to start a Ray.
    """
    os.environ.update({name: value for name, value in QUIET.items() if name not in os.environ})
    check_mode(cluster)
    if cluster.name == "local":
        use_token(folder / ".ray" / "token")
    elif os.environ.get("RAY_AUTH_TOKEN_PATH") and not os.environ.get("RAY_AUTH_TOKEN"):
        check_private(Path(os.environ["RAY_AUTH_TOKEN_PATH"]))
    import ray

    if ray.is_initialized():
        return
    compile_kernels()
    for name in ("ray", "ray.rllib", "ray.tune"):
        logging.getLogger(name).setLevel(logging.ERROR)
    # Ray logs the traceback of a trial's error, which it also writes to the trial's folder and jobs report.
    logging.getLogger("ray.tune.execution.tune_controller").setLevel(logging.CRITICAL)
    settings = {
        "runtime_env": with_plugins({"env_vars": of_workers() | {LEARNER_DEVICE: cluster.device}}),
        "job_config": _job_config(),
        "log_to_driver": False,
        "logging_level": logging.ERROR,
    }
    with keeping_handlers():
        if cluster.name == "local":
            os.environ["RAY_TMPDIR"] = str(ray_folder())  # its workers inherit it
            # Two processes that started Ray within seconds of each other have deadlocked.
            with locked(ray_folder() / "start-ray.lock"):
                forget_sessions(ray_folder())
                _start_local({"num_cpus": cluster.num_cpus, **settings})
            return
        _join(cluster.address or "auto", settings)
    check_machines()


class _Path(list[str]):
    """A list of folders that Ray cannot extend."""

    def extend(self, folders: Iterable[str]) -> None:
        """Ignore the current folder: its `envs`, `models` or `jobs` would hide ours."""


def _job_config() -> Any:
    """Return Ray's job settings: workers import this repository's packages, whatever the current folder."""
    from ray.job_config import JobConfig

    return JobConfig(_py_driver_sys_path=_Path([str(REPOSITORY)]))


def _join(address: str, settings: Mapping[str, object]) -> None:
    import ray

    try:
        ray.init(address=address, **settings)
    except (ConnectionError, RuntimeError, ray.exceptions.RayError) as error:
        raise ConfigError(f"cluster.address: cannot join {address!r}: {why_not_joined(error)}") from None


def why_not_joined(error: Exception) -> str:
    """Return in one line why Ray could not join a cluster, with the remedy if it is known."""
    text = f"{error}\n{error.__cause__ or ''}"
    if "InvalidAuthToken" in text or "AuthenticationError" in text:
        return (
            "it asks for another token than this machine's; set RAY_AUTH_MODE=token, and "
            "RAY_AUTH_TOKEN_PATH to the file with the cluster's token"
        )
    if "Version mismatch" in text:
        found = " ".join(text[text.index("Version mismatch") :].split())
        return f"{found.removesuffix(' None')}; install the same packages on every machine"
    return text.strip().splitlines()[0]


def _start_local(settings: Mapping[str, object]) -> None:
    import ray

    for _ in range(MAX_STARTS):
        try:
            with on_loopback():
                ray.init(address="local", include_dashboard=False, **settings)
            return
        except Exception as error:  # Ray raises no specific type
            if "timed out during startup" not in str(error):
                raise
            ray.shutdown()
    raise ClusterError(
        f"Ray did not start in {MAX_STARTS} times 30 s: the machine is too busy; try again later"
    )


@contextlib.contextmanager
def on_loopback() -> Iterator[None]:
    """Let a Ray that starts in the block listen on the loopback address only.

    RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER=0 would do the same, but Ray reads the variable at its import, which
    may be over. `_node_ip_address="127.0.0.1"` has no effect: Ray replaces it.
    """
    from ray._private import ray_constants

    before = ray_constants.ENABLE_RAY_CLUSTER
    ray_constants.ENABLE_RAY_CLUSTER = False
    try:
        yield
    finally:
        ray_constants.ENABLE_RAY_CLUSTER = before


def ray_folder() -> Path:
    """Return the folder of a local Ray's sockets, logs, locks and staged files, private to this user.

    Tune stages the state of an experiment there and unpickles what it finds. The folder is in /tmp if
    the path of the temporary folder is too long for a socket.

    Raises:
        RunError: The folder belongs to someone else, or others may enter it.
    """
    folder = private_folder()
    if len(os.fsencode(folder)) <= MAX_RAY_FOLDER:
        return folder
    return private_folder("/tmp")  # noqa: S108  only its owner can enter it


def logs_folder() -> Path:
    """Return the folder of the running Ray's logs."""
    from ray._private import worker

    return Path(worker._global_node.get_logs_dir_path())


def session_folder() -> Path | None:
    """Return the session folder of the running Ray, deleted together with its logs; None without Ray."""
    from ray._private import worker

    return None if worker._global_node is None else Path(worker._global_node.get_session_dir_path())


def fit(tuner: Any) -> Any:
    """Run a Tuner; if a callback fails, raise its error instead of Tune's error with the traceback as text.

    Raises:
        HeadLostError: The head of the cluster does not answer any more.
    """
    from ray.tune import TuneError

    try:
        with watching_head():
            return tuner.fit()
    except TuneError as error:
        raise (error.__context__ or error) from None


def storage(cluster: ClusterConfig, folder: Path) -> str:
    """Return the path or address at which the nodes of a cluster store a folder of a run.

    Args:
        cluster: Names the storage, if it is not the run folder itself.
        folder: A folder of the run, `<runs_dir>/<run>/<name>`.
    """
    if cluster.storage is None:
        return str(folder)
    return f"{cluster.storage.rstrip('/')}/{folder.parent.name}/{folder.name}"


def holds(place: str, start: str) -> bool:
    """Whether a path or an address contains a file whose name starts with `start`."""
    import pyarrow.fs

    system, root = pyarrow.fs.FileSystem.from_uri(place)
    inside = system.get_file_info(pyarrow.fs.FileSelector(root, allow_not_found=True))
    return any(info.base_name.startswith(start) for info in inside)


def check_mode(cluster: ClusterConfig) -> None:
    """Reject a Ray without authentication, unless the user states that the cluster has none.

    Raises:
        ConfigError: RAY_AUTH_MODE turns a local Ray's token off, or is not given for another.
    """
    mode = os.environ.get("RAY_AUTH_MODE")
    if cluster.name == "local" and mode not in (None, "token"):
        rule = "must be token, or not set, for cluster=local: without it, anyone who reaches Ray runs code"
        raise ConfigError(f"RAY_AUTH_MODE: {rule}, got {mode!r}; unset it")
    if cluster.name == "ray" and mode not in ("token", "disabled"):
        remedy = (
            "set it to token, and RAY_AUTH_TOKEN_PATH to the file with the cluster's token "
            "(disabled joins a cluster that asks nobody for one)"
        )
        raise ConfigError(f"RAY_AUTH_MODE: must be token or disabled for cluster=ray, got {mode!r}; {remedy}")


def use_token(file: Path) -> None:
    """Let this process's Ray authenticate by the token in a private file, created if missing.

    If the environment names a token, that token is used. RAY_AUTH_MODE is not changed: a Ray that
    starts without it turns authentication on, and a Ray that is already imported would ignore it.

    Raises:
        ConfigError: If the file is another user's, or others can read it.
    """
    if os.environ.get("RAY_AUTH_TOKEN"):
        return
    if not os.environ.get("RAY_AUTH_TOKEN_PATH"):
        make_token(file)
        os.environ["RAY_AUTH_TOKEN_PATH"] = str(file)
    check_private(Path(os.environ["RAY_AUTH_TOKEN_PATH"]))


def make_token(file: Path) -> None:
    """Write a new token to a file that nobody else can read, unless the file exists."""
    if file.is_file() and not file.stat().st_size:  # truncated by a power failure
        file.unlink()
    if file.exists():
        return
    file.parent.mkdir(parents=True, exist_ok=True)
    file.parent.chmod(0o700)
    handle, part = tempfile.mkstemp(dir=file.parent)  # only its owner can read it
    with os.fdopen(handle, "w") as stream:
        stream.write(secrets.token_hex(32))
    with contextlib.suppress(FileExistsError):
        os.link(part, file)  # atomic, and never replaces the token of another process
    Path(part).unlink()


def check_private(file: Path) -> None:
    """Reject a token that anyone but this user could read.

    Raises:
        ConfigError: If there is no such file, it is another user's, or its mode lets others in.
    """
    try:
        info = file.stat()
    except OSError as error:
        raise ConfigError(f"RAY_AUTH_TOKEN_PATH: {str(file)!r} cannot be read: {error.strerror}") from None
    mode = stat.S_IMODE(info.st_mode)
    if not stat.S_ISREG(info.st_mode) or info.st_uid != os.getuid() or mode & 0o077:
        rule = "must be a file that its owner alone can read, and yours"
        found = f"mode {mode:04o} of user {info.st_uid}"
        raise ConfigError(
            f"RAY_AUTH_TOKEN_PATH: {rule}, got {found} ({str(file)!r}); if nobody else has read it, "
            f"run `chmod 600 {file}`, else delete it for a new one"
        )
