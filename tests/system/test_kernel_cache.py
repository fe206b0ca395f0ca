import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.system
ROOT = Path(__file__).resolve().parents[2]
KERNEL = "import numba\n\n@numba.njit(cache=True)\ndef inner(x):\n    return x + {}\n"
CALLER = (
    "import numba\nfrom {}.low.inside import inner\n\n"
    "@numba.njit(cache=True)\ndef outer(x):\n    return inner(x)\n"
)


@pytest.mark.parametrize("room", ["envs", "models"])
def test_an_edited_kernel_is_compiled_again_also_where_a_file_of_another_package_calls_it(tmp_path, room):
    package = tmp_path / room
    for folder in ("low", "high"):
        (package / folder).mkdir(parents=True)
        (package / folder / "__init__.py").touch()
    shutil.copy(ROOT / room / "__init__.py", package)
    (package / "low" / "inside.py").write_text(KERNEL.format(1.0))
    (package / "high" / "outside.py").write_text(CALLER.format(room))

    def run():
        words = [sys.executable, "-c", f"from {room}.high.outside import outer; print(outer(1.0))"]
        return subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=120).stdout

    def compiled():
        return sorted(path.name for path in package.rglob("*.nbi"))

    assert run() == "2.0\n"
    before = compiled()
    assert run() == "2.0\n"
    assert before == compiled() != []
    (package / "low" / "inside.py").write_text(KERNEL.format(2.0))
    assert run() == "3.0\n"
