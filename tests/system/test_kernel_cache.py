import shutil
import subprocess
import sys

import pytest

from tests.support.patience import HANG_S
from tests.support.started import ROOT, said

pytestmark = pytest.mark.system
INNER = "import numba\nVALUE = {}\n\n@numba.njit(cache=True)\ndef inner(x):\n    return x + 1.0\n"
OUTER = (
    "import numba\nfrom envs.low import (\n    {0},\n)\nfrom envs.low.{0} import inner\nVALUE = {0}.VALUE\n\n"
    "@numba.njit(cache=True)\ndef {0}_outer():\n    return inner(VALUE)\n"
)
CALLS = """
from envs.high.one import one_outer
from envs.high.two import two_outer
print(one_outer(), two_outer())
"""


def test_an_edit_compiles_the_kernels_again_that_reach_the_edited_file_and_no_others(tmp_path):
    package = tmp_path / "envs"  # its kernels are prepared as ours are; those of models are, too
    for folder in ("low", "high"):
        (package / folder).mkdir(parents=True)
        (package / folder / "__init__.py").touch()
    shutil.copy(ROOT / "envs" / "__init__.py", package)
    shutil.copytree(ROOT / "core", tmp_path / "core")
    for name in ("one", "two"):
        (package / "low" / f"{name}.py").write_text(INNER.format(1.0))
        (package / "high" / f"{name}.py").write_text(OUTER.format(name))

    def run():
        return said(sys.executable, "-c", CALLS, cwd=tmp_path)

    def compiled():
        files = package.rglob("*.nbc")
        return {f"{file.parts[-3]}.{file.name.partition('.')[0]}": file.stat().st_mtime_ns for file in files}

    assert run() == "2.0 2.0\n"
    before = compiled()
    assert sorted(before) == ["high.one", "high.two", "low.one", "low.two"]
    for file in package.rglob("*.py"):
        file.touch()  # newer, and the same
    edited = INNER.replace("x + 1.0", "x + 5.0").format(
        10.0
    )  # a constant, and what another file's kernel calls
    (package / "low" / "two.py").write_text(edited)
    assert run() == "2.0 15.0\n"
    assert {name for name, time in compiled().items() if time != before[name]} == {"high.two", "low.two"}


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


def test_of_processes_that_start_at_once_one_compiles_and_the_others_say_that_they_wait(
    tmp_path, monkeypatch
):
    words = [sys.executable, "-c", COMPILE, str(tmp_path)]
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    both = [subprocess.Popen(words, cwd=ROOT, stdout=subprocess.PIPE, text=True) for _ in "ab"]
    texts = [process.communicate(timeout=HANG_S)[0] for process in both]
    assert (tmp_path / "compiled_by").read_text() == "half half "
    assert sum("Compiled the kernels in" in text for text in texts) == 1
    assert sum("waiting" in text for text in texts) == 1
    (tmp_path / "compiled_first").write_text("other sources")
    shutil.rmtree(tmp_path / "cache")
    said(*words)
    assert (tmp_path / "compiled_by").read_text() == "half half half half "
