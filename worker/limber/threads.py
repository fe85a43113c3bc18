"""One thread a solver: the libraries' own threads only get in each other's way.

On two cores OpenBLAS's threads double the time of a supernodal factorisation of a branch (its
blocks are small); the work is parallel over samples instead, in processes.
"""


def one_thread() -> None:
    """Let every BLAS and OpenMP library of this process work with one thread, from now on.

    It reaches the libraries that are loaded when it is called, in under a millisecond.
    """
    from threadpoolctl import threadpool_limits

    threadpool_limits(limits=1)
