"""Two machines with a wire between them, on this one: a network namespace each, and a Ray node in each."""

import dataclasses
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from tests.support.clusters import TOKEN
from tests.support.faults import DEADLINE_S, ROOT, Job, start

PORT = 6379
WIRE = "wire"  # the device at either end
NODE = ("--object-store-memory", str(100 * 2**20), "--disable-usage-stats", "--block")
# A service that starts within a minute is rare on a busy machine.
PATIENT = {"RAY_raylet_start_wait_time_s": "300"}


def ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True, text=True)


@dataclasses.dataclass
class Machine:
    """A network namespace; what runs in it sees no other network than the wire."""

    name: str
    address: str
    folder: Path

    def inside(self, *words: str) -> list[str]:
        """A command, to be run on this machine."""
        return ["ip", "netns", "exec", self.name, *words]

    def ray(self, *words: str, before: str = "", **variables: str) -> subprocess.Popen:
        """Start a node of Ray, after some lines of shell."""
        node = ["ray.scripts.scripts", "start", *NODE, "--node-ip-address", self.address, *words]
        shell = ["sh", "-c", f'{before}\nexec "$@"', "sh", sys.executable, "-m", *node]
        with (self.folder / "ray.log").open("a") as log:
            return subprocess.Popen(
                self.inside(*shell), env={**os.environ, **TOKEN, **PATIENT, **variables}, cwd=ROOT,
                stdout=log, stderr=subprocess.STDOUT,
            )  # fmt: skip

    def head(self, cpus: int = 1, **variables: str) -> subprocess.Popen:
        """Start the head of a cluster."""
        words = ("--head", "--port", str(PORT), "--include-dashboard", "false", "--num-cpus", str(cpus))
        return self.ray(*words, "--temp-dir", str(self.folder), **variables)

    def join(self, head: "Machine", cpus: int = 1, before: str = "", **variables: str) -> subprocess.Popen:
        """Join a cluster."""
        words = ("--address", f"{head.address}:{PORT}", "--num-cpus", str(cpus))
        return self.ray(*words, "--temp-dir", str(self.folder), before=before, **variables)

    def launch(self, folder: Path, *words: str, **given: object) -> Job:
        """Start the launcher on this machine, on its cluster."""
        command = [sys.executable, "-m", "platform.launch", *words, f"runs_dir={folder / 'runs'}"]
        on = ("cluster=ray", f"cluster.address={self.address}:{PORT}")
        return start(folder, self.inside(*command, *on), **{**TOKEN, **given})

    def link(self, state: str) -> None:
        """Pull the plug of the wire, `down`, or put it in again, `up`; both machines notice."""
        ip("-n", self.name, "link", "set", WIRE, state)

    def wait_for_nodes(self, count: int) -> None:
        """Wait until the cluster whose head this is has so many nodes."""
        script = f"""
import sys
from ray._raylet import GcsClient
nodes = GcsClient(address="{self.address}:{PORT}").get_all_node_info(timeout=10).values()
sys.exit(sum(node.state == 0 for node in nodes) != {count})
"""
        environment = {**os.environ, **TOKEN}
        deadline = time.monotonic() + DEADLINE_S
        command = self.inside(sys.executable, "-c", script)
        while subprocess.run(command, env=environment, capture_output=True, check=False).returncode:
            assert time.monotonic() < deadline, (self.folder / "ray.log").read_text()

    def pids(self) -> list[int]:
        """All that runs on it."""
        return [int(pid) for pid in subprocess.check_output(["ip", "netns", "pids", self.name]).split()]

    def switch_off(self) -> None:
        """End all that runs on it at once."""
        deadline = time.monotonic() + DEADLINE_S
        while pids := self.pids():
            for pid in pids:
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            assert time.monotonic() < deadline, pids
            time.sleep(0.1)


def lose_packets(machines: tuple[Machine, Machine]) -> None:
    """From now on nothing arrives, and nobody is told, as behind a switch without power."""
    for here, there in (machines, machines[::-1]):
        nobody = ("lladdr", "02:00:00:00:00:ff", "dev", WIRE, "nud", "permanent")
        ip("-n", here.name, "neighbour", "replace", there.address, *nobody)


@contextmanager
def two_machines() -> Iterator[tuple[Machine, Machine]]:
    """Machines that reach each other and nothing else."""
    if os.getuid() != 0 or not shutil.which("ip"):
        pytest.skip("needs root and ip (apt-get install iproute2) for network namespaces")
    names = [f"evade-{os.getpid()}-{which}" for which in "ab"]
    try:
        ip("netns", "add", names[0])
    except subprocess.CalledProcessError as error:
        pytest.skip(f"network namespaces are not permitted: {error.stderr.strip()}")
    machines = []
    try:
        ip("netns", "add", names[1])
        ip("-n", names[0], "link", "add", WIRE, "type", "veth", "peer", "name", WIRE, "netns", names[1])
        for number, name in enumerate(names, start=1):
            # Sockets have little room for their path.
            folder = Path(tempfile.mkdtemp(prefix="evade-", dir="/tmp"))
            machines.append(Machine(name, f"10.77.0.{number}", folder))
            ip("-n", name, "link", "set", "lo", "up")
            ip("-n", name, "address", "add", f"10.77.0.{number}/24", "dev", WIRE)
            ip("-n", name, "link", "set", WIRE, "up")
        yield machines[0], machines[1]
    finally:
        for machine in machines:
            machine.switch_off()
            shutil.rmtree(machine.folder, ignore_errors=True)
        for name in names:
            subprocess.run(["ip", "netns", "del", name], check=False, capture_output=True)
