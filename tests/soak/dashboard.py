"""The dashboard of a soak: MLflow's server over one SQLite store, which can be ended, stopped and started."""

import os
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path

SETTINGS = {
    "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false",
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "MLFLOW_ALLOW_PICKLE_DESERIALIZATION": "false",
}
START_S = 600.0  # a busy machine imports MLflow in a minute


class Dashboard:
    """One server on a port of its own.

    Attributes:
        store: The SQLite file behind it.
        uri: Its address.
        process: The server while it runs.
    """

    def __init__(self, folder: Path) -> None:
        """Keep the store, the artifacts and the log in `folder`, and choose a free port."""
        folder.mkdir()
        self.folder, self.store = folder, folder / "mlflow.db"
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.uri = f"http://127.0.0.1:{self.port}"
        self.process: subprocess.Popen | None = None

    def start(self) -> None:
        """Start the server; it answers some seconds later."""
        words = ["--workers", "1", "--host", "127.0.0.1", "--port", str(self.port)]
        with (self.folder / "server.log").open("a") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "mlflow", "server", *words, "--backend-store-uri", f"sqlite:///{self.store}"],
                env={**os.environ, **SETTINGS}, cwd=self.folder, stdout=log, stderr=log, process_group=0,
            )  # fmt: skip

    def answers(self) -> bool:
        """Whether it serves its page."""
        try:
            with urllib.request.urlopen(f"{self.uri}/", timeout=5) as page:
                return page.status == 200
        except OSError:
            return False

    def wait(self) -> None:
        """Wait until it answers.

        Raises:
            RuntimeError: It does not within `START_S`.
        """
        deadline = time.monotonic() + START_S
        while not self.answers():
            if time.monotonic() > deadline:
                raise RuntimeError(f"the dashboard does not answer; see {self.folder / 'server.log'}")
            time.sleep(0.2)

    def signal(self, number: signal.Signals) -> None:
        """Send a signal to the server and its workers."""
        if self.process is not None:
            os.killpg(self.process.pid, number)

    def kill(self) -> None:
        """End it at once."""
        if self.process is not None:
            self.signal(signal.SIGKILL)
            self.process.wait()
            self.process = None
