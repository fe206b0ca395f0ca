"""Start or join Ray: quietly, authenticated, one thread per worker; a local one on loopback alone."""

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
from jobs.run.device import device_variables
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
    "RAY_DEDUP_LOGS": "1",
    # Ray's own 15 leaves a worker a thirtieth of a core that any other program wants.
    "RAY_worker_niceness": "0",
    # A busy machine starts a worker in minutes; after a minute, Ray would start a second one.
    "RAY_worker_register_timeout_seconds": "600",
    "RAY_AIR_NEW_OUTPUT": "0",
    # Write down at once which checkpoint is the newest: a kill must not leave the name of one
    # that newer ones have replaced.
    "TUNE_GLOBAL_CHECKPOINT_S": "0",
    "TUNE_DISABLE_AUTO_CALLBACK_LOGGERS": "1",
    # Tune would take Ctrl+C for the end of a training.
    "TUNE_DISABLE_SIGINT_HANDLER": "1",
    "TUNE_WARN_EXCESSIVE_EXPERIMENT_CHECKPOINT_SYNC_THRESHOLD_S": "0",
}
# Of a path [bytes]: a socket's has room for 107 (103 on macOS), and Ray appends
# "/ray/session_2026-01-31_23-59-59_123456_4194304/sockets/plasma_store".
MAX_RAY_FOLDER = 35
MAX_STARTS = 5  # of a local Ray, which gives itself 30 s: too little on a busy machine


class ClusterError(RuntimeError):
    """Ray could not be started; the message says why in one line, and what to do."""


def start_ray(cluster: ClusterConfig, folder: Path) -> None:
    """Start Ray on this machine, or join the configured cluster; do nothing if Ray is running already.

    A local Ray listens on the loopback address alone, keeps its sockets and logs in a private folder,
    and asks every client for a token, which lies in a file that its owner alone can read; the home
    folder is not touched. Workers run one thread each, see `jobs.run.libraries`.

    Args:
        cluster: Where Ray runs.
        folder: Where the token of a local Ray is kept.

    Raises:
        ConfigError: If the cluster cannot be joined, one of its machines has other code than this
            one, others can read the token, or RAY_AUTH_MODE does not say whether the cluster asks
            for one.
        ClusterError: If this machine is too busy to start one.
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
        "runtime_env": with_plugins({"env_vars": of_workers() | device_variables(cluster.device)}),
        "job_config": _job_config(),
        "log_to_driver": False,
        "logging_level": logging.ERROR,
        "configure_logging": True,
    }
    with keeping_handlers():
        if cluster.name == "local":
            os.environ["RAY_TMPDIR"] = str(ray_folder())  # of its workers, too
            # Two processes that started Ray within seconds of each other have waited for each other forever.
            with locked(ray_folder() / "start-ray.lock"):
                forget_sessions(ray_folder())
                _start_local({"num_cpus": cluster.num_cpus, **settings})
            return
        _join(cluster.address or "auto", settings)
    check_machines()


class _Path(list[str]):
    """Folders that Ray cannot add to."""

    def extend(self, folders: Iterable[str]) -> None:
        """Leave out the current folder: its own `envs`, `models` or `jobs` would come before ours."""


def _job_config() -> Any:
    """Return Ray's settings of a job whose workers import this repository's packages from any folder."""
    from ray.job_config import JobConfig

    return JobConfig(_py_driver_sys_path=_Path([str(REPOSITORY)]))


def _join(address: str, settings: Mapping[str, object]) -> None:
    import ray

    try:
        ray.init(address=address, **settings)
    except (ConnectionError, RuntimeError, ray.exceptions.RayError) as error:
        raise ConfigError(f"cluster.address: cannot join {address!r}: {why_not_joined(error)}") from None


def why_not_joined(error: Exception) -> str:
    """Why Ray could not join a cluster, in one line, with the remedy where it is known."""
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
        except Exception as error:  # Ray's own has no type of its own
            if "timed out during startup" not in str(error):
                raise
            ray.shutdown()
    raise ClusterError(
        f"Ray did not start in {MAX_STARTS} times 30 s: the machine is too busy; try again later"
    )


@contextlib.contextmanager
def on_loopback() -> Iterator[None]:
    """Let a Ray that starts take the loopback address for this machine's, and listen nowhere else.

    That is what RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER=0 does; but Ray reads the variable when it is
    imported, which may have been before. `_node_ip_address="127.0.0.1"` has no effect: Ray replaces it.
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

    Tune copies the state of an experiment through it and unpickles what it finds there. It lies in
    /tmp where the path of the temporary folder is too long for a socket.

    Raises:
        RunError: The folder belongs to someone else, or others may enter it.
    """
    folder = private_folder()
    if len(os.fsencode(folder)) <= MAX_RAY_FOLDER:
        return folder
    return private_folder("/tmp")  # noqa: S108  entered by its owner alone


def logs_folder() -> Path:
    """Return the logs of the running Ray."""
    from ray._private import worker

    return Path(worker._global_node.get_logs_dir_path())


def session_folder() -> Path | None:
    """Return a folder of the running Ray, which goes when its logs do; None without Ray."""
    from ray._private import worker

    return None if worker._global_node is None else Path(worker._global_node.get_session_dir_path())


def fit(tuner: Any) -> Any:
    """Run a Tuner; raise an error of its callbacks itself, not the text of its traceback.

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
    """Return where the nodes of a cluster store the files of a run's folder: a path or an address.

    Args:
        cluster: Names the storage, if it is not the run folder itself.
        folder: A folder of the run, `<runs_dir>/<run>/<name>`.
    """
    if cluster.storage is None:
        return str(folder)
    return f"{cluster.storage.rstrip('/')}/{folder.parent.name}/{folder.name}"


def holds(place: str, start: str) -> bool:
    """Whether a path or an address holds a file whose name begins with `start`."""
    import pyarrow.fs

    system, root = pyarrow.fs.FileSystem.from_uri(place)
    inside = system.get_file_info(pyarrow.fs.FileSelector(root, allow_not_found=True))
    return any(info.base_name.startswith(start) for info in inside)


def check_mode(cluster: ClusterConfig) -> None:
    """Reject a Ray without authentication, unless the user says that a cluster has none.

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
    """Let this process's Ray authenticate by the token in a private file, made if missing.

    A token that the environment already names is kept. RAY_AUTH_MODE stays as it is: a Ray
    that starts without it turns authentication on, whereas a Ray that is already imported
    would not notice it.

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
    """Write a new token to a file that nobody else can read; one that is there stays."""
    if file.is_file() and not file.stat().st_size:  # a power failure cut it
        file.unlink()
    if file.exists():
        return
    file.parent.mkdir(parents=True, exist_ok=True)
    file.parent.chmod(0o700)
    handle, part = tempfile.mkstemp(dir=file.parent)  # for its owner alone
    with os.fdopen(handle, "w") as stream:
        stream.write(secrets.token_hex(32))
    with contextlib.suppress(FileExistsError):
        os.link(part, file)  # whole or not at all, and never over one that another process made
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
