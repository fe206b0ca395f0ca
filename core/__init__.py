"""Code shared by `envs` and `models`: pixel values, the neighbour filter, files, compiler settings.

`envs` and `models` may not import each other; both import this package, which imports neither. Importing the
package itself does not import numba.
"""

from pathlib import Path

from core.cache import choose_cache
from core.sources import forget_stale_kernels
from core.target import fix_target

__all__ = ["choose_cache", "fix_target", "forget_stale_kernels"]

fix_target()
choose_cache(Path(__file__).resolve().parents[1])
forget_stale_kernels(Path(__file__).parent)
