import os

for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import platform  # noqa: E402
from pathlib import Path  # noqa: E402

from hypothesis import settings  # noqa: E402

# The first example of a property may compile kernels.
settings.register_profile("patient", deadline=None)
settings.load_profile("patient")

# Started as `pytest`, the standard library's module is loaded before the repository's.
if not hasattr(platform, "__path__"):
    platform.__path__ = [str(Path(__file__).resolve().parents[1] / "platform")]
