"""One thread in every numerical library, from the first import of ``limber`` on.

The number of threads of a BLAS library determines its order of summation, and thus the last digits.
A result would depend on the machine, on the environment and on earlier work in the process. On two
cores OpenBLAS's threads also double the time of a supernodal factorisation of a branch (its blocks
are small). Limber's work is instead parallel over samples, in processes.
"""

import os
import sys

_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS",
              "VECLIB_MAXIMUM_THREADS")


def one_thread() -> None:
    """Limit every BLAS and OpenMP library of this process to one thread, from now on.

    Libraries that are loaded later, here or in child processes, read it from the environment. Those
    already loaded by numpy and others are set now, in some milliseconds.
    """
    os.environ.update(dict.fromkeys(_VARIABLES, "1"))
    if "numpy" in sys.modules:
        from threadpoolctl import threadpool_limits

        threadpool_limits(limits=1)
