"""One thread in every numerical library, from the first import of ``limber`` on.

How many threads a BLAS library uses decides in which order it adds, and so the last digits: a
result would depend on the machine, on the environment and on what ran before in the process. On two
cores OpenBLAS's threads also double the time of a supernodal factorisation of a branch (its blocks
are small). Limber's work is parallel over samples instead, in processes.
"""

import os
import sys

_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS",
              "VECLIB_MAXIMUM_THREADS")


def one_thread() -> None:
    """Let every BLAS and OpenMP library of this process work with one thread, from now on.

    Libraries that are loaded later, here and in processes started from here, read it from the
    environment; those that numpy and others have loaded are told now, in some milliseconds.
    """
    os.environ.update(dict.fromkeys(_VARIABLES, "1"))
    if "numpy" in sys.modules:
        from threadpoolctl import threadpool_limits

        threadpool_limits(limits=1)
