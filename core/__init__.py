"""Compiled kernels: the processor they are compiled for, and that none is older than its sources.

`envs` and `models` may not import each other; both import this package, which imports neither, and not numba.
"""

from core.sources import forget_stale_kernels
from core.target import fix_target

__all__ = ["fix_target", "forget_stale_kernels"]
