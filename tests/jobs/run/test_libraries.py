import os
import subprocess
import sys

import pytest

from jobs.run import libraries
from jobs.run.libraries import ONE_THREAD, SAME_DIGITS, held, hold, of_workers


def test_a_library_is_told_only_of_instructions_that_the_processor_has():
    assert held(set()) == held({"avx2"}) == held({"asimd"}) == ONE_THREAD
    assert held({"avx2", "fma"}) == ONE_THREAD | SAME_DIGITS
    some = held({"avx2", "fma", "avx512vl", "avx512_fp16"})
    assert some == ONE_THREAD | SAME_DIGITS | {"NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_SPR"}


def test_what_a_user_has_set_stays_here_and_in_workers_but_for_their_threads(monkeypatch):
    monkeypatch.setattr(libraries, "processor", lambda: {"flags": "fma avx2"})
    for name in (*ONE_THREAD, *SAME_DIGITS, "NPY_DISABLE_CPU_FEATURES"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("MKL_CBWR", "AUTO")
    monkeypatch.setenv("OMP_NUM_THREADS", "4")
    hold()
    own = {"MKL_CBWR": "AUTO"}
    for name, value in {**ONE_THREAD, **SAME_DIGITS, "OMP_NUM_THREADS": "4", **own}.items():
        assert os.environ[name] == value
    assert of_workers() == {**SAME_DIGITS, **own, **ONE_THREAD}


CHOSEN = """
from jobs.run.libraries import hold, processor
hold()
import torch
from numpy._core._multiarray_umath import __cpu_features__ as features
avx2 = {"avx2", "fma"} <= set(processor()["flags"].split())
wide = [name for name in ("X86_V4", "AVX512_ICL", "AVX512_SPR") if features.get(name)]
print(not avx2 or (torch.backends.cpu.get_cpu_capability(), wide) == ("AVX2", []))
"""


@pytest.mark.system
def test_libraries_do_as_they_are_told():
    names = (*SAME_DIGITS, "NPY_DISABLE_CPU_FEATURES")
    free = {name: value for name, value in os.environ.items() if name not in names}
    said = subprocess.check_output([sys.executable, "-W", "error", "-c", CHOSEN], env=free, text=True)
    assert said.strip() == "True"
