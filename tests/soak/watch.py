"""What a soak writes down every five seconds: processes, memory, open files, disk."""

import contextlib
import csv
import os
import shutil
import threading
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from tests.soak.dashboard import Dashboard
from tests.soak.processes import samples, shared_memory

EVERY_S = 5.0
YOUNG_S = 120.0  # a process that has just begun still imports and fills its caches
OLD_S = 600.0  # shorter lives tell nothing about a trend: each stage loads what it needs
FAR_S = 30.0  # between two samples that are compared
HEAD = ("minute", "role", "processes", "rss_mb", "largest_mb", "open_files")
DISK_HEAD = ("minute", "runs_mb", "store_mb", "temporary_mb", "free_shm_mb")


class Watch:
    """Samples in a thread of its own, from `start` to `stop`.

    Attributes:
        rows: (minute, role, processes, sum of resident memory [MB], the largest [MB], open files).
        disk: (minute, runs, MLflow's store, temporary files, free shared memory), in MB.
        lives: (role, process) -> (second, resident memory [MB]) at each sample.
        shared: Files of /dev/shm that were open at any time.
        unanswered: How often the dashboard did not serve its page.
    """

    def __init__(self, folders: Mapping[str, Path], dashboard: Dashboard) -> None:
        """Measure the size of `folders`: runs, store and temp."""
        self.folders, self.dashboard = folders, dashboard
        self.rows: list[tuple] = []
        self.disk: list[tuple] = []
        self.lives: dict[tuple[str, int], list[tuple[float, float]]] = defaultdict(list)
        self.shared: set[str] = set()
        self.unanswered = 0
        self.began_s = time.monotonic()
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._sample_on, daemon=True)

    def start(self) -> None:
        """Begin."""
        self.began_s = time.monotonic()
        self._thread.start()

    def stop(self) -> None:
        """End; what was sampled stays."""
        self._end.set()
        self._thread.join(60)

    def minute(self) -> float:
        """Minutes since the start."""
        return (time.monotonic() - self.began_s) / 60

    def _sample_on(self) -> None:
        while not self._end.wait(EVERY_S):
            self.sample()

    def sample(self) -> None:
        """Sample once."""
        minute, process = self.minute(), self.dashboard.process
        found = samples(process.pid if process else None)
        for role in sorted({sample.role for sample in found}):
            own = [sample for sample in found if sample.role == role]
            memory = [sample.rss_mb for sample in own]
            self.rows.append(
                (minute, role, len(own), sum(memory), max(memory), sum(one.files for one in own))
            )
        for sample in found:
            self.lives[sample.role, sample.pid].append((60 * minute, sample.rss_mb))
        self.shared |= shared_memory()
        sizes = [size_mb(self.folders[name]) for name in ("runs", "store", "temp")]
        self.disk.append((minute, *sizes, shutil.disk_usage("/dev/shm").free / 1e6))
        self.unanswered += not self.dashboard.answers()

    def write(self, folder: Path) -> None:
        """Write both tables as CSV."""
        for name, head, rows in (("processes.csv", HEAD, self.rows), ("disk.csv", DISK_HEAD, self.disk)):
            with (folder / name).open("w", newline="") as file:
                writer = csv.writer(file)
                writer.writerow(head)
                writer.writerows([x if isinstance(x, str) else round(x, 3) for x in row] for row in rows)


def size_mb(folder: Path) -> float:
    """What the files of a folder take [MB]; files that vanish meanwhile count nothing."""
    total = 0
    for place, _, names in os.walk(folder):
        for name in names:
            with contextlib.suppress(OSError):
                total += Path(place, name).lstat().st_size
    return total / 1e6


def slope_mb_per_hour(lives: Sequence[Sequence[tuple[float, float]]]) -> float | None:
    """The common trend of processes' memory [MB/h]; None without long lives.

    It is the median slope between two samples of one process: a stage that begins and loads what it
    needs moves it little, what grows all the time moves it.
    """
    slopes: list[float] = []
    for life in lives:
        t_s, memory = np.array(life).T
        old = t_s - t_s[0] > YOUNG_S
        if t_s[-1] - t_s[0] > OLD_S:
            first, later = np.triu_indices(int(old.sum()), 1)
            apart_h = (t_s[old][later] - t_s[old][first]) / 3600
            far = apart_h > FAR_S / 3600
            slopes += ((memory[old][later] - memory[old][first])[far] / apart_h[far]).tolist()
    return float(np.median(slopes)) if slopes else None
