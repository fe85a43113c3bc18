"""One thread a solver: the libraries' own threads only get in each other's way.

On two cores OpenBLAS's threads double the time of a supernodal factorisation of a branch (its
blocks are small); the work is parallel over samples instead, in processes.
"""

import functools


@functools.cache
def one_thread() -> None:
    """Let every BLAS and OpenMP library of this process work with one thread, from now on.

    Call it after the library that is meant has been loaded; calls after the first do nothing.
    """
    from threadpoolctl import threadpool_limits

    threadpool_limits(limits=1)
