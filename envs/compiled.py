"""Decorators for kernels that allocate nothing."""

import numba

# Kernels that allocate nothing need no reference counting of arrays. Its atomic instructions at each call
# took five times as long as the work.
kernel = numba.njit(cache=True, error_model="numpy", _nrt=False, no_cfunc_wrapper=True)
inlined = numba.njit(cache=True, error_model="numpy", _nrt=False, no_cfunc_wrapper=True, forceinline=True)
