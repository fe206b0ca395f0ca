"""One thread for each process: what numerical libraries read from the environment when they load.

Two threads beside other busy processes ran ten times slower than one. Parts that take more set their number
(pretraining, a learner of a large network); those that wait must sleep: spinning beside one busy program made
a gradient three times slower. Nothing is imported here,
because the launcher sets these variables before it imports anything that reads them.
"""

ONE_THREAD = {
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "NUMBA_NUM_THREADS": "1",
    "LP_NUM_THREADS": "0",
    "OMP_WAIT_POLICY": "PASSIVE",
}
