import shutil
import subprocess
import sys
from pathlib import Path

ENVS = Path(__file__).resolve().parent.parent / "envs"
CALL = "from envs.{0} import outer; print(outer(1.0))"


def test_an_edited_kernel_is_compiled_anew_also_where_another_file_calls_it(tmp_path):
    package = tmp_path / "envs"
    package.mkdir()
    shutil.copy(ENVS / "__init__.py", package)
    kernel = "import numba\n\n@numba.njit(cache=True)\ndef inner(x):\n    return x + {}\n"
    (package / "inside.py").write_text(kernel.format(1.0))
    (package / "outside.py").write_text(
        "import numba\nfrom envs.inside import inner\n\n"
        "@numba.njit(cache=True)\ndef outer(x):\n    return inner(x)\n"
    )

    def run():
        words = [sys.executable, "-c", CALL.format("outside")]
        return subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=120).stdout

    assert run() == "2.0\n"
    kept = sorted(path.name for path in (package / "__pycache__").glob("*.nbi"))
    assert run() == "2.0\n"
    assert kept == sorted(path.name for path in (package / "__pycache__").glob("*.nbi")) != []
    (package / "inside.py").write_text(kernel.format(2.0))
    assert run() == "3.0\n"
