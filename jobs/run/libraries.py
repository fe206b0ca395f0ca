"""Set the environment variables that numerical libraries read when they load: threads and instructions.

This module imports only the standard library, because the launcher sets these variables before it imports
anything that reads them. A value that the user has set is not changed.
"""

import os
from pathlib import Path

# On a busy machine two threads ran ten times slower than one. Code that uses more threads sets their number
# (pretraining, the learner of a large network). Waiting threads must sleep: spinning threads made a gradient
# three times slower while another program was busy.
ONE_THREAD = {
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "NUMBA_NUM_THREADS": "1",
    "LP_NUM_THREADS": "0",
    "OMP_WAIT_POLICY": "PASSIVE",
}

# Each library selects its code by the processor, and the code decides the rounding. With these settings it
# selects the same code on every x86-64 processor with AVX2. On AMD, MKL honours only COMPATIBLE; products
# that must be fast do not use MKL (models/encoder/products.py).
SAME_DIGITS = {
    "ATEN_CPU_CAPABILITY": "avx2",  # torch's own loops
    "ONEDNN_MAX_CPU_ISA": "AVX2",  # its convolutions
    "MKL_CBWR": "COMPATIBLE",  # its products, LAPACK, exp and log
    "OPENBLAS_CORETYPE": "Haswell",  # numpy's and scipy's products and LAPACK
}
NUMPY = {"X86_V4": "avx512vl", "AVX512_ICL": "avx512_bitalg", "AVX512_SPR": "avx512_fp16"}  # and Linux flags


def processor() -> dict[str, str]:
    """Return the first entry of /proc/cpuinfo (`vendor_id`, `model name`, `flags`, ...); empty without it."""
    try:
        first, _, _ = Path("/proc/cpuinfo").read_text().partition("\n\n")
    except OSError:
        return {}
    return {
        name.strip(): value.strip() for name, _, value in (line.partition(":") for line in first.splitlines())
    }


def held(flags: set[str]) -> dict[str, str]:
    """Return the variables for a processor with these Linux `flags`; only threads without AVX2 and FMA."""
    if not {"avx2", "fma"} <= flags:
        return ONE_THREAD
    above = [feature for feature, flag in NUMPY.items() if flag in flags]  # numpy warns about missing ones
    return {**ONE_THREAD, **SAME_DIGITS, **({"NPY_DISABLE_CPU_FEATURES": " ".join(above)} if above else {})}


def hold() -> None:
    """Set the variables that the user has not set, for this process and its children."""
    for name, value in held(set(processor().get("flags", "").split())).items():
        os.environ.setdefault(name, value)


def of_workers() -> dict[str, str]:
    """Return the variables of a Ray worker: the instructions of this process, and one thread."""
    names = [*SAME_DIGITS, "NPY_DISABLE_CPU_FEATURES"]
    return {name: os.environ[name] for name in names if name in os.environ} | ONE_THREAD
