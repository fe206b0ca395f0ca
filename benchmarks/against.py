"""Compare speed and event error of a control step in this checkout and another commit, in interleaved rounds.

Run: python -m benchmarks.against [COMMIT [SCENE ...]]; COMMIT is the one before HEAD by default
Expect: a table in about six minutes on one core. Two processes, one per checkout, take turns
at the same flights in 32 parallel corridors. Three pairs of processes follow each other, because where a
process has its memory changes its time by up to 4 %. A ratio is the median over the rounds of all pairs of
the other checkout's time divided by this one's. The event error is relative to the converged simulation of
the same checkout, at tolerance 0.05. By day and night the pixels have bandwidth and mismatch, but no noise.
In the last row a shipped policy also encodes the windows and decides. Rows that the other commit does not
support are left out. Below the table is the memory of a process that does the last row without the
converged simulation.
"""

import inspect
import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from jobs.analysis.tables import show_table

PAIRS, ROUNDS, CORRIDORS, STEPS = 3, 6, 32, 12
SCENES = ("poles", "poles_dense", "shape_change", "gates", "texture_change", "dynamic")
ROOT = Path(__file__).resolve().parents[1]
DECIDED = "poles models/pretrained/bytestream-s0"
NAMES = {  # of rows that are more than a scene
    "poles 300 0.15": "poles, pixels of light=day",
    "poles 30 0.25": "poles, pixels of light=night",
    DECIDED: "poles, encoded and decided",
}


def prepare(scene: str, slow: list[float], folder: list[str]) -> tuple | None:
    """Return corridors, policy (or None) and event error of a row; None if this commit cannot run it."""
    from envs.config import CameraConfig, EnvConfig
    from envs.corridor import CorridorVectorEnv
    from envs.event_error import measure_event_error
    from models.policy import load_policy

    camera = CameraConfig()
    try:
        if slow:
            camera = CameraConfig(cutoff_hz=slow[0], threshold_mismatch=slow[1])
    except (TypeError, ValueError):  # raised by a commit without such a camera
        return None
    env = CorridorVectorEnv(CORRIDORS, EnvConfig(scene=scene, camera=camera, window_capacity=1024))
    env.reset(seed=0)
    policy = load_policy(folder[0]) if folder else None
    if policy is not None:
        policy.reset(CORRIDORS)
    return env, policy, measure_event_error(EnvConfig(scene=scene, camera=camera)).error


def worker() -> None:
    """Answer each line of the input with seconds per step and the event error, as JSON.

    A line has the name of a scene, optionally bandwidth [Hz] and mismatch of the pixels, and optionally the
    folder of a policy that decides at each step.
    In another checkout only its source and the source of `prepare` run, so it uses nothing else from
    this file.
    """
    import json
    import sys
    import time

    import numpy as np
    import torch

    torch.set_num_threads(1)
    known: dict[str, tuple | None] = {}
    for line in sys.stdin:
        scene, *words = line.split()
        slow = [float(word) for word in words if word[0].isdigit()]
        if line not in known:
            known[line] = prepare(scene, slow, words[len(slow) :])
        found = known[line]
        if found is None:
            print(json.dumps(None), flush=True)
            continue
        env, policy, error = found
        rng, seconds = np.random.default_rng(0), []
        for _ in range(STEPS):
            actions = rng.integers(3, size=CORRIDORS)
            began = time.perf_counter()
            observations = env.step(actions)[0]
            if policy is not None:
                policy.logits(observations)
            seconds.append((time.perf_counter() - began) / CORRIDORS)
        print(json.dumps([float(np.median(seconds)), error]), flush=True)


def fly_alone() -> None:
    """Fly, encode and decide 200 steps, and print the peak memory of this process [MB].

    In another checkout only its source runs, as for `worker`.
    """
    import resource

    import numpy as np
    import torch

    from envs.config import EnvConfig
    from envs.corridor import CorridorVectorEnv
    from models.policy import load_policy

    torch.set_num_threads(1)
    env = CorridorVectorEnv(CORRIDORS, EnvConfig(scene="poles", window_capacity=1024))
    observations = env.reset(seed=0)[0]
    policy = load_policy("models/pretrained/bytestream-s0")
    policy.reset(CORRIDORS)
    rng = np.random.default_rng(0)
    for _ in range(200):
        policy.logits(observations)
        observations = env.step(rng.integers(3, size=CORRIDORS))[0]
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)


def memory(folder: Path) -> float:
    """Return the peak memory [MB] of a process that flies with a checkout's compiled kernels."""
    code = "\n".join((f"CORRIDORS = {CORRIDORS}", inspect.getsource(fly_alone), "fly_alone()"))
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    command = [sys.executable, "-c", code]
    for _ in range(2):  # the first run compiles, which takes memory
        said = subprocess.check_output(command, cwd=folder, env=environment, text=True)  # noqa: S603  own code
    return float(said)


class Checkout:
    """A process that flies with the code of one checkout."""

    def __init__(self, folder: Path) -> None:
        """Start the process."""
        numbers = f"CORRIDORS, STEPS = {CORRIDORS}, {STEPS}"
        code = "\n".join((numbers, inspect.getsource(prepare), inspect.getsource(worker), "worker()"))
        environment = {**os.environ, "PYTHONPATH": str(folder)}
        self._process = subprocess.Popen(  # noqa: S603  own code
            [sys.executable, "-c", code],
            cwd=folder,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def fly(self, scene: str) -> tuple[float, float] | None:
        """Return the median time of a step [s] and the event error; None if the checkout cannot run it."""
        assert self._process.stdin is not None  # noqa: S101  for the type checker
        assert self._process.stdout is not None  # noqa: S101
        self._process.stdin.write(f"{scene}\n")
        self._process.stdin.flush()
        found = json.loads(self._process.stdout.readline())
        return None if found is None else (found[0], found[1])

    def end(self) -> None:
        """Stop the process."""
        self._process.kill()
        self._process.wait()


@contextmanager
def checked_out(commit: str) -> Iterator[Path]:
    """Yield a folder with the code of a commit of this repository."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "code"
        git = ["git", "-C", str(ROOT), "worktree"]
        subprocess.run([*git, "add", "--quiet", "--detach", str(place), commit], check=True)  # noqa: S603
        try:
            yield place
        finally:
            subprocess.run([*git, "remove", "--force", str(place)], check=True)  # noqa: S603


def timed(scene: str, here: Checkout, there: Checkout) -> list[tuple]:
    """Return (here, there) of each round of a scene; the first round, which compiles, does not count."""
    rounds = [(here.fly(scene), there.fly(scene)) for _ in range(ROUNDS + 1)]
    return [pair for pair in rounds[1:] if None not in pair]


def compared(scene: str, pairs: list[tuple]) -> tuple[str, ...]:
    """Return the row of a scene."""
    ratios = [other[0] / own[0] for own, other in pairs]
    micro = [f"{1e6 * statistics.median(pair[k][0] for pair in pairs):.0f}" for k in range(2)]
    errors = [f"{side[1]:.3f}" for side in pairs[0]]
    spread = f"{min(ratios):.2f} to {max(ratios):.2f}"
    return (NAMES.get(scene, scene), *micro, f"{statistics.median(ratios):.2f}", spread, *errors)


def main() -> None:
    """Measure and print the table."""
    commit = sys.argv[1] if len(sys.argv) > 1 else "HEAD^"
    pairs: dict[str, list[tuple]] = {scene: [] for scene in sys.argv[2:] or (*SCENES, *NAMES)}
    with checked_out(commit) as place:
        for _ in range(PAIRS):
            here, there = Checkout(ROOT), Checkout(place)
            for scene, found in pairs.items():
                found.extend(timed(scene, here, there))
            here.end()
            there.end()
        megabytes = [memory(folder) for folder in (ROOT, place)]
    rows = [compared(scene, found) for scene, found in pairs.items() if found]
    head = ("scene", "us here", "us there", "there / here", "all rounds", "error here", "error there")
    show_table(f"A control step, against {commit}", head, rows)
    print(f"Memory of a process: {megabytes[0]:.0f} MB here, {megabytes[1]:.0f} there")


if __name__ == "__main__":
    main()
