"""One thread and one kernel in every numerical library, from the first import of ``limber`` on.

The number of threads of a BLAS library determines its order of summation, and thus the last digits.
A result would depend on the machine, on the environment and on earlier work in the process. On two
cores OpenBLAS's threads also double the time of a supernodal factorisation of a branch (its blocks
are small). Limber's work is instead parallel over samples, in processes.

OpenBLAS also sums in another order on processors with AVX-512. Where a branch is about to snap, a
last digit decides which shape it takes, so that one machine found a path and another none. All
x86-64 processors of today have the kernel of Haswell.
"""

import os
import sys

_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS",
              "VECLIB_MAXIMUM_THREADS")


def same_digits() -> None:
    """Let every BLAS and OpenMP library of this process use one thread and one kernel from now on:
    those loaded later, here or in children, read it from the environment, those that numpy and
    others have loaded are set now, in some milliseconds."""
    os.environ.update(dict.fromkeys(_VARIABLES, "1"))
    if _has_another_kernel():
        # A library that is loaded already keeps its own.
        os.environ.setdefault("OPENBLAS_CORETYPE", "Haswell")
    if "numpy" in sys.modules:
        from threadpoolctl import threadpool_limits

        threadpool_limits(limits=1)


def _has_another_kernel() -> bool:
    """Whether OpenBLAS would take a kernel that not every processor has."""
    try:
        with open("/proc/cpuinfo", encoding="ascii", errors="replace") as processors:
            flags = processors.read(8192)  # of the first one
    except OSError:
        return False  # not Linux
    return " avx512f " in flags and " avx2 " in flags
