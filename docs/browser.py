"""Open the dashboard in a headless Chromium, for tests and for the pictures of the documentation.

The browser is controlled through its debugging pipe, which needs no package. It can reach this machine only.
"""

import base64
import contextlib
import json
import os
import shlex
import shutil
import socket
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from jobs.tracking.store import server_command

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run",
    "--remote-debugging-pipe", "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
)  # fmt: skip
ERRORS = ("Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded")
PATIENCE_S = 300.0  # a busy machine takes minutes to start the server
# Closes MLflow's assistant, which otherwise covers a quarter of each page.
NO_ASSISTANT = "localStorage.setItem('mlflow.assistant.fab.autoOpenedOnFirstLoad_v1', 'true')"


@contextlib.contextmanager
def served(uri: str, bin_folder: Path) -> Iterator[str]:
    """Serve a store on a free port with the command that the jobs print; yield the address."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    words = shlex.split(server_command(uri).replace("--port 5000", f"--port {port}"))
    settings = dict(
        word.split("=", 1) for word in words if word.isupper() or word.partition("=")[0].isupper()
    )
    command = [str(bin_folder / "mlflow"), *words[len(settings) + 1 :]]
    server = subprocess.Popen(
        command, env={**os.environ, **settings}, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    address = f"http://127.0.0.1:{port}"
    try:
        wait_for(lambda: _healthy(address) or server.poll() is not None, f"{address}/health")
        if server.poll() is not None:
            raise RuntimeError(f"the server ended with status {server.returncode}: {shlex.join(command)}")
        yield address
    finally:
        server.terminate()
        server.wait(60)


def _healthy(address: str) -> bool:
    try:
        return urllib.request.urlopen(f"{address}/health", timeout=10).status == 200
    except OSError:
        return False


def wait_for(condition: Any, what: str) -> None:
    """Wait until a condition is true; raise TimeoutError after `PATIENCE_S`."""
    end = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError(f"not there after {PATIENCE_S:.0f} s: {what}")
        time.sleep(0.3)


class Browser:
    """A window of a headless Chromium."""

    def __init__(self, profile: Path, width: int = 1600, height: int = 1200) -> None:
        """Start the browser; `profile` is an empty folder."""
        (their_in, self.out), (self.into, their_out) = os.pipe(), os.pipe()

        def give_pipes() -> None:
            for place, end in ((3, their_in), (4, their_out)):
                os.dup2(os.dup(end), place) if end != place else os.set_inheritable(end, True)

        command = [str(CHROMIUM), *FLAGS, f"--user-data-dir={profile}", f"--window-size={width},{height}"]
        self.process = subprocess.Popen(
            command, preexec_fn=give_pipes, pass_fds=(3, 4, their_in, their_out),
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        for end in (their_in, their_out):
            os.close(end)
        self.size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.number, self.session, self.buffer = 0, None, b""
        self.errors: list[str] = []  # logged by the pages

    def close(self) -> None:
        """End the browser."""
        self.process.terminate()
        self.process.wait(30)
        os.close(self.out)
        os.close(self.into)

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """Call a method of the debugging protocol, and wait for its answer."""
        self.number += 1
        message = {"id": self.number, "method": method, "params": params}
        if self.session is not None and not method.startswith("Target."):
            message["sessionId"] = self.session
        os.write(self.out, json.dumps(message).encode() + b"\0")
        while True:
            while b"\0" not in self.buffer:
                read = os.read(self.into, 1 << 20)
                if not read:
                    raise RuntimeError(f"the browser ended before it answered {method}")
                self.buffer += read
            text, self.buffer = self.buffer.split(b"\0", 1)
            answer = json.loads(text)
            if answer.get("method") in ERRORS and '"error"' in text.decode():
                self.errors.append(text.decode())
            if answer.get("id") == self.number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                return answer["result"]

    def open(self, address: str, *texts: str) -> str:
        """Open a page in a new tab, wait until it shows all the texts, and return its whole text."""
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self.session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        self.call("Emulation.setDeviceMetricsOverride", **self.size)
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")
        self.call("Page.addScriptToEvaluateOnNewDocument", source=NO_ASSISTANT)
        self.call("Page.navigate", url=address)
        return self.shows(*texts)

    def shows(self, *texts: str) -> str:
        """Wait until the page shows all the texts, and return its whole text."""

        def missing() -> list[str]:
            return [text for text in texts if text not in self.text()]

        try:
            wait_for(lambda: not missing(), "the texts")
        except TimeoutError:
            raise AssertionError(f"the page does not show {missing()}; it shows:\n{self.text()}") from None
        return self.text()

    def text(self) -> str:
        """Return the text that the page shows."""
        return self.evaluate("document.body ? document.body.innerText : ''") or ""

    def wait(self, script: str, what: str) -> bool:
        """Wait until an expression on the page is true."""
        wait_for(lambda: self.evaluate(script), what)
        return True

    def evaluate(self, script: str) -> Any:
        """Return the value of an expression on the page."""
        return self.call("Runtime.evaluate", expression=script, returnByValue=True)["result"].get("value")

    def click(self, text: str) -> None:
        """Click the element that shows exactly this text."""
        every = "[...document.querySelectorAll('button, a, span, div')]"
        find = f"{every}.find(e => e.innerText === {json.dumps(text)})"
        wait_for(lambda: self.evaluate(f"!!{find}"), text)
        self.evaluate(f"{find}.click()")

    def press(self, key: str) -> None:
        """Press a key, such as "ArrowRight" or " "."""
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key)

    def picture(self) -> bytes:
        """Return a screenshot of the window, as a PNG."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
