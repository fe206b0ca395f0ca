"""Decorators for kernels that allocate nothing."""

import numba

# Kernels that allocate nothing need no counting of references to arrays: that, by atomic
# instructions at each call, took five times as long as the work.
kernel = numba.njit(cache=True, error_model="numpy", _nrt=False, no_cfunc_wrapper=True)
inlined = numba.njit(cache=True, error_model="numpy", _nrt=False, no_cfunc_wrapper=True, forceinline=True)
