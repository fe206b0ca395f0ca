"""Write events as npz, text and CSV, in parts."""

import contextlib
import shutil
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from core.files import replaced
from envs.recordings.names import COLUMNS
from envs.recordings.npz import NOISE
from envs.recordings.writing import Append, chunks

TYPES: dict[str, np.dtype] = {
    "t": np.dtype("<i8"),
    "x": np.dtype("<u2"),
    "y": np.dtype("<u2"),
    "p": np.dtype("u1"),
}


@contextlib.contextmanager
def npz_writer(path: Path, width: int, height: int, is_labelled: bool) -> Iterator[Append]:
    """Yield a function that adds events to an npz file, compressed: t (int64 us), x, y (uint16), p (0, 1).

    A column must be whole before the next begins, so columns wait in files beside it. The sensor's size,
    and the unit of the times in two ways, are there as EventCV and this project have them.
    """
    types: dict[str, np.dtype] = TYPES | ({NOISE: np.dtype(bool)} if is_labelled else {})
    count = 0
    with replaced(path) as part, contextlib.ExitStack() as stack:
        files = {name: stack.enter_context(tempfile.TemporaryFile(dir=path.parent)) for name in types}

        def append(events: np.ndarray, is_noise: np.ndarray | None) -> None:
            nonlocal count
            count += len(events)
            columns: dict[str, Any] = {name: events[name] for name in COLUMNS} | {
                "p": events["p"] > 0,
                NOISE: is_noise,
            }
            for name, dtype in types.items():
                files[name].write(np.ascontiguousarray(columns[name], dtype).tobytes())

        yield append
        facts = {"width": np.array([width], "<u8"), "height": np.array([height], "<u8")}
        facts |= {"timestamp_scale_ms": np.array([1e-3]), "time_unit": np.array("us")}
        with zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, dtype in types.items():
                header = {"descr": dtype.str, "fortran_order": False, "shape": (count,)}
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    np.lib.format.write_array_header_1_0(member, header)
                    files[name].seek(0)
                    shutil.copyfileobj(files[name], member, 1 << 20)
            for name, value in facts.items():
                with archive.open(f"{name}.npy", "w") as member:
                    np.lib.format.write_array(member, value)


@contextlib.contextmanager
def text_writer(path: Path, width: int, height: int, separator: str = " ") -> Iterator[Append]:
    """Yield a function that adds lines, under lines that say columns, unit, polarity code and sensor.

    Separated by commas the first line names the columns and no other is there: what opens CSV
    knows no comments. The sensor's size is not in such a file.
    """
    about = f"# time_unit: us\n# polarity: -1 is OFF (darker), 1 is ON (brighter)\n# width: {width}\n"
    about += f"# height: {height}\n# columns: t x y p\n"
    with replaced(path) as part, part.open("w", encoding="ascii", newline="\n") as file:
        file.write("t_us,x,y,p\n" if separator == "," else about)

        def append(events: np.ndarray, _: np.ndarray | None) -> None:
            for some in chunks(events):
                file.writelines(separator.join(map(str, row)) + "\n" for row in some.tolist())

        yield append
