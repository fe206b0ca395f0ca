import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.patience import HANG_S

pytestmark = pytest.mark.system
ROOT = Path(__file__).resolve().parents[2]
KERNEL = "import numba\n\n@numba.njit(cache=True)\ndef inner(x):\n    return x + {}\n"
CALLER = (
    "import numba\nfrom {}.low.inside import inner\n\n"
    "@numba.njit(cache=True)\ndef outer(x):\n    return inner(x)\n"
)


def clone(folder):
    """A package in a folder that prepares its kernels as `envs` does; that of models is the same."""
    package = folder / "envs"
    package.mkdir()
    shutil.copy(ROOT / "envs" / "__init__.py", package)
    shutil.copytree(ROOT / "core", folder / "core")
    return package


def test_an_edited_kernel_is_compiled_again_also_where_a_file_of_another_package_calls_it(tmp_path):
    room, package = "envs", clone(tmp_path)
    for folder in ("low", "high"):
        (package / folder).mkdir(parents=True)
        (package / folder / "__init__.py").touch()
    (package / "low" / "inside.py").write_text(KERNEL.format(1.0))
    (package / "high" / "outside.py").write_text(CALLER.format(room))

    def run():
        words = [sys.executable, "-c", f"from {room}.high.outside import outer; print(outer(1.0))"]
        return subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=HANG_S).stdout

    def compiled():
        return sorted(path.name for path in package.rglob("*.nbi"))

    assert run() == "2.0\n"
    before = compiled()
    assert run() == "2.0\n"
    assert before == compiled() != []
    (package / "low" / "inside.py").write_text(KERNEL.format(2.0))
    assert run() == "3.0\n"


def test_an_edit_compiles_the_kernels_again_that_reach_the_edited_file_and_no_others(tmp_path):
    room, package = "envs", clone(tmp_path)
    numbers = {"one": 1.0, "two": 2.0, "many": 3.0}
    for name, number in numbers.items():
        (package / f"{name}.py").write_text(f"VALUE = {number}\n")
        caller = f"import numba\nfrom {room} import (\n    {name},\n)\nVALUE = {name}.VALUE\n\n"
        caller += f"@numba.njit(cache=True)\ndef call_{name}():\n    return VALUE\n"
        (package / f"of_{name}.py").write_text(caller)
    calls = "\n".join(f"from {room}.of_{name} import call_{name}; print(call_{name}())" for name in numbers)

    def run():
        words = [sys.executable, "-c", calls]
        out = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=HANG_S).stdout
        return [float(line) for line in out.split()]

    def compiled():
        return {path.name.partition(".")[0]: path.stat().st_mtime_ns for path in package.rglob("*.nbc")}

    assert run() == [1.0, 2.0, 3.0]
    before = compiled()
    assert sorted(before) == ["of_many", "of_one", "of_two"]
    for file in package.glob("*.py"):
        file.touch()  # newer, and the same
    (package / "two.py").write_text("VALUE = 20.0\n")
    assert run() == [1.0, 20.0, 3.0]
    assert {name for name, time in compiled().items() if time != before[name]} == {"of_two"}


COMPILE = """
import sys, time
from pathlib import Path
from unittest.mock import patch
from jobs.run import compile
folder = Path(sys.argv[1])
def compile_parts(parts):
    with (folder / "compiled_by").open("a") as file:
        file.write("half ")
    time.sleep(1.5)
with patch.multiple(compile, CACHE=folder, side_by_side=compile_parts):
    compile.main()
"""


def test_of_processes_that_start_at_once_one_compiles_and_the_others_say_that_they_wait(tmp_path):
    words = [sys.executable, "-c", COMPILE, str(tmp_path)]
    own = {**os.environ, "XDG_CACHE_HOME": str(tmp_path / "cache")}
    both = [subprocess.Popen(words, cwd=ROOT, env=own, stdout=subprocess.PIPE, text=True) for _ in range(3)]
    said = [process.communicate(timeout=HANG_S)[0] for process in both]
    assert (tmp_path / "compiled_by").read_text() == "half half "
    assert sum("Compiled the kernels in" in text for text in said) == 1
    assert sum("waiting" in text for text in said) >= 1
    (tmp_path / "compiled_first").write_text("other sources")
    shutil.rmtree(tmp_path / "cache")
    subprocess.run(words, cwd=ROOT, env=own, check=True, timeout=HANG_S)
    assert (tmp_path / "compiled_by").read_text() == "half half half half "
