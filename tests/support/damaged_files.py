"""Reads damaged copies of event files in a process with little memory.

Run: PYTHONPATH=. python tests/support/damaged_files.py ROUNDS SEED FILE...
(0 rounds: reads the files as they are)
Prints how many copies of each were read and refused. Anything but a ValueError that names the file
once ends the process, and leaves the copy in place of the file.
"""

import json
import re
import resource
import signal
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow

from envs.recordings import FORMATS, read_events

MEMORY_BYTES = 3 << 30  # of address space, most of it taken by the libraries
SECONDS = 50  # of processor time for one read; then the process is ended by a signal
EXTREMES = (0, 1, -1, 127, 255, 1 << 15, (1 << 16) - 1, 1 << 31, (1 << 31) - 1, 1 << 40, 1 << 62, -(1 << 63))
WORDS = (
    b"0",
    b"-1",
    b"1e300",
    b"nan",
    b"99999999999999999999",
    b"",
    b"(",
    b"'",
    b"x",
    b"\xff",
    b"<u2",
    b"|O",
)


def main() -> None:
    rounds, seed, paths = int(sys.argv[1]), int(sys.argv[2]), [Path(name) for name in sys.argv[3:]]
    pyarrow.cpu_count()  # loaded before memory is limited
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    goods = {path: path.read_bytes() if rounds else b"" for path in paths}
    counts = {}
    for path, good in goods.items():
        rng, results = np.random.default_rng([seed, len(counts)]), []
        for _ in range(rounds):
            path.write_bytes(damaged(good, list(goods.values()), rng) or b"\0")
            results.append(is_read(path, options(rng)))
        if not rounds:
            results.append(is_read(path, {}))
        counts[path.name] = {"read": sum(results), "refused": len(results) - sum(results)}
    print(json.dumps(counts))  # noqa: T201


def is_read(path: Path, arguments: dict[str, Any]) -> bool:
    """Whether a file is read, and then keeps the rules, or else is refused as it should be."""
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        file = read_events(path, **arguments)
    except ValueError as error:
        if str(error).count(str(path)) != 1:
            raise RuntimeError(f"{path} with {arguments} is not named once") from error
        return False
    except BaseException as error:
        error.add_note(f"{path} with {arguments}")
        raise
    events = file.events
    assert np.all(np.diff(events["t"]) >= 0)
    assert np.isin(events["p"], (-1, 1)).all()
    assert file.is_noise is None or (file.is_noise.dtype, file.is_noise.shape) == (bool, events.shape)
    for name, size in (("x", file.width), ("y", file.height)):
        assert size is None or not events.size or events[name].max() < size
    return True


def options(rng: np.random.Generator) -> dict[str, Any]:
    """Mostly none, else what a caller may say."""
    chosen: dict[str, Any] = {}
    if rng.random() < 0.1:
        chosen["format"] = str(rng.choice(FORMATS))
    if rng.random() < 0.1:
        chosen |= {"width": int(rng.integers(1, 400)), "height": int(rng.integers(1, 300))}
    if rng.random() < 0.1:
        names = ["t", "x", "y", "p", "t_ms", "z"]
        chosen["columns"] = tuple(str(name) for name in rng.permutation(names)[: rng.integers(3, 6)])
    if rng.random() < 0.1:
        chosen["time_unit"] = str(rng.choice(["s", "ms", "us", "ns"]))
    return chosen


def damaged(good: bytes, others: list[bytes], rng: np.random.Generator) -> bytes:
    """A copy with one to three kinds of damage; half of the places are among the first 600 bytes."""
    bad = good
    for kind in rng.choice(DAMAGE, rng.choice([1, 1, 2, 3])):
        if not bad:
            break
        near = min(len(bad), 600) if rng.random() < 0.5 else len(bad)
        bad = kind(bad, int(rng.integers(near)), int(rng.integers(1, 20)), others, rng)
    return bad


def flipped(bad: bytes, place: int, size: int, _: list[bytes], rng: np.random.Generator) -> bytes:
    values = np.frombuffer(bad, np.uint8).copy()
    places = rng.integers(place, len(bad), size if rng.random() < 0.5 else 1)
    values[places] ^= np.uint8(1) << rng.integers(0, 8, len(places), dtype=np.uint8)
    return values.tobytes()


def scrambled(bad: bytes, place: int, size: int, _: list[bytes], rng: np.random.Generator) -> bytes:
    end = len(bad) if rng.random() < 0.2 else min(place + size, len(bad))
    return bad[:place] + rng.bytes(end - place) + bad[end:]


def cut(bad: bytes, place: int, size: int, _: list[bytes], rng: np.random.Generator) -> bytes:
    return bad[:place] if rng.random() < 0.5 else bad[:place] + bad[place + size :]


def repeated(bad: bytes, place: int, size: int, _: list[bytes], rng: np.random.Generator) -> bytes:
    return bad[:place] + bad[place : place + size] * int(rng.integers(2, 5)) + bad[place + size :]


def numbered(bad: bytes, place: int, _size: int, _: list[bytes], rng: np.random.Generator) -> bytes:
    size = int(rng.choice([1, 2, 4, 8]))
    value = int(EXTREMES[rng.integers(len(EXTREMES))]) & (1 << 8 * size) - 1
    return bad[:place] + value.to_bytes(size, "little") + bad[place + size :]


def worded(bad: bytes, place: int, _size: int, _: list[bytes], rng: np.random.Generator) -> bytes:
    found = re.compile(rb"[0-9A-Za-z<|]+").search(bad, place)
    word = WORDS[rng.integers(len(WORDS))]
    return bad if found is None else bad[: found.start()] + word + bad[found.end() :]


def spliced(bad: bytes, place: int, size: int, others: list[bytes], rng: np.random.Generator) -> bytes:
    other = others[rng.integers(len(others))]
    first = int(rng.integers(len(other)))
    return bad[:place] + other[first : first + size] + (bad[place:] if rng.random() < 0.5 else other[first:])


DAMAGE = (flipped, flipped, scrambled, cut, repeated, numbered, worded, spliced)


if __name__ == "__main__":
    main()
