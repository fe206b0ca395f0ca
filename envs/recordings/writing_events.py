"""Write events to a file of any format, at once or part by part."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from envs.events import EVENT
from envs.recordings.event_file import Append, check_events
from envs.recordings.formats import LABELLED, TABLE, WRITERS, WRITTEN_SUFFIXES

Write = Callable[..., None]


def write_events(
    path: str | Path,
    events: np.ndarray,
    width: int,
    height: int,
    format: str | None = None,
    *,
    is_noise: np.ndarray | None = None,
) -> None:
    """Write events to a file, atomically; `read_events` returns the same events.

    Formats: "npz" and "hdf5" (DSEC's layout), which EventCV can open too; "txt" and "csv" (a header names
    columns and unit); and the formats of the cameras' own tools: iniVation's "aedat4", Prophesee's "dat",
    "evt2" and "evt3".

    Args:
        path: The file; its folder is created, an existing file is replaced.
        events: EVENT array (N,), sorted by t.
        width: Columns of the sensor [px].
        height: Rows of the sensor [px].
        format: One of the above; None: by the suffix (`.raw` is "evt3").
        is_noise: bool (N,), which events are noise, as `video_to_events` labels them; for "npz" and "hdf5".

    Raises:
        ValueError: The format is unknown, the events or labels are not valid, or the format cannot store
            them: its clock ends before the last event (dat 2**32 us, evt2 2**34 us) or before
            the first event (evt3 2**24 us), or its addresses have fewer pixels.
    """
    check_events(events, width, height)
    with event_writer(path, width, height, format, is_labelled=is_noise is not None) as write:
        write(events, is_noise)


@contextlib.contextmanager
def event_writer(
    path: str | Path, width: int, height: int, format: str | None = None, *, is_labelled: bool = False
) -> Iterator[Write]:
    """Yield a function that adds events to a file part by part, with memory for one part.

    The file appears when the block ends without an error. The function takes an EVENT array that starts no
    earlier than the previous one ended, and labels if the file has them.

    Args:
        path: As in `write_events`.
        width: As in `write_events`.
        height: As in `write_events`.
        format: As in `write_events`.
        is_labelled: Whether each part comes with labels of noise.

    Raises:
        ValueError: As in `write_events`.
    """
    path = Path(path)
    kind = format or WRITTEN_SUFFIXES.get(path.suffix.lower(), "")
    if kind not in TABLE or (create := TABLE[kind].write) is None:
        raise ValueError(f"{path}: format must be one of {', '.join(WRITERS)}, got {format or path.suffix!r}")
    labels = (is_labelled,) if kind in LABELLED else ()
    if is_labelled and kind not in LABELLED:
        raise ValueError(f"{path}: {kind} stores no labels of noise; choose {' or '.join(LABELLED)}")
    check_events(np.empty(0, EVENT), width, height)
    with create(path, width, height, *labels) as append:
        yield _checked(path, width, height, append, is_labelled)


def _checked(path: Path, width: int, height: int, append: Append, is_labelled: bool) -> Write:
    """Return a function that checks events before it adds them."""
    last_us = 0

    def write(events: np.ndarray, is_noise: np.ndarray | None = None) -> None:
        nonlocal last_us
        check_events(events, width, height)
        if len(events) and events["t"][0] < last_us:
            raise ValueError(
                f"{path}: a part begins at {events['t'][0]} us, before {last_us} us; sort the parts"
            )
        if (is_noise is not None) != is_labelled:
            raise ValueError(f"{path}: is_noise must be given for every part or for none")
        if is_noise is not None and (
            getattr(is_noise, "dtype", None) != np.dtype(bool) or is_noise.shape != events.shape
        ):
            raise ValueError(f"{path}: is_noise must be bool {events.shape}, got {is_noise!r:.80}")
        last_us = int(events["t"][-1]) if len(events) else last_us
        append(events, is_noise)

    return write
