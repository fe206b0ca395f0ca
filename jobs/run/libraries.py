"""What numerical libraries read from the environment when they load: threads and instructions.

Nothing is imported here but the standard library, because the launcher sets these variables before it imports
anything that reads them. A value that the user has set stays.
"""

import os
from pathlib import Path

# On a busy machine two threads ran ten times slower than one. Parts that take more set their number
# (pretraining, a learner of a large network); those that wait must sleep: spinning beside one busy program
# made a gradient three times slower.
ONE_THREAD = {
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "NUMBA_NUM_THREADS": "1",
    "LP_NUM_THREADS": "0",
    "OMP_WAIT_POLICY": "PASSIVE",
}

# Each library picks its code by the processor, and rounds as that code does. These settings let it pick the
# same on every x86-64 processor with AVX2. MKL obeys none but COMPATIBLE on AMD; what must be fast is not
# MKL's (models/encoder/products.py).
SAME_DIGITS = {
    "ATEN_CPU_CAPABILITY": "avx2",  # torch's own loops
    "ONEDNN_MAX_CPU_ISA": "AVX2",  # its convolutions
    "MKL_CBWR": "COMPATIBLE",  # its products, LAPACK, exp and log
    "OPENBLAS_CORETYPE": "Haswell",  # numpy's and scipy's products and LAPACK
}
NUMPY = {"X86_V4": "avx512vl", "AVX512_ICL": "avx512_bitalg", "AVX512_SPR": "avx512_fp16"}  # and their flags


def processor() -> dict[str, str]:
    """Return Linux's entry of the first processor: `vendor_id`, `model name`, `flags` and more, if any."""
    try:
        first, _, _ = Path("/proc/cpuinfo").read_text().partition("\n\n")
    except OSError:
        return {}
    return {
        name.strip(): value.strip() for name, _, value in (line.partition(":") for line in first.splitlines())
    }


def held(flags: set[str]) -> dict[str, str]:
    """Return the settings for a processor with these `flags` of Linux; none without AVX2."""
    if not {"avx2", "fma"} <= flags:
        return ONE_THREAD
    above = [feature for feature, flag in NUMPY.items() if flag in flags]  # numpy warns of those that are not
    return {**ONE_THREAD, **SAME_DIGITS, **({"NPY_DISABLE_CPU_FEATURES": " ".join(above)} if above else {})}


def hold() -> None:
    """Set what the user has not set, for this process and those that it starts."""
    for name, value in held(set(processor().get("flags", "").split())).items():
        os.environ.setdefault(name, value)


def of_workers() -> dict[str, str]:
    """Return the environment of a Ray worker: the instructions of this process, but one thread."""
    names = [*SAME_DIGITS, "NPY_DISABLE_CPU_FEATURES"]
    return {name: os.environ[name] for name in names if name in os.environ} | ONE_THREAD
