"""Processes that each hold the branch, for all solves of one field.

A process takes about a second to start, and the branch's equations as long again: both only once.
"""

from collections.abc import Callable, Sequence
from typing import Any

from limber.core.processes import Pool, core_budget, run_tasks, worker_count
from limber.core.processes.pool_process import Task
from limber.core.progress import SILENT, Progress
from limber.planning.field.grasp_model import GraspModel

_held: list[GraspModel] = []  # in a process of the pool


class SolverPool:
    """Solves a branch in parallel; close it, or use it in a ``with``.

    Args:
        grasp_model: The branch.
        workers: Most processes; by default the core budget. One: none is started.
    """

    def __init__(self, grasp_model: GraspModel, workers: int | None = None):
        self.grasp_model = grasp_model
        self._count = worker_count(core_budget(), requested=workers)
        self._pool: Pool | None = None

    def run(self, function: Callable, tasks: Sequence[tuple], *, progress: Progress = SILENT,
            message: str = "") -> list:
        """Return ``[function(grasp_model, *task) for task in tasks]``, in this order.

        Results do not depend on the number of processes. ``function`` may take ``progress``.

        Raises:
            WorkError: a process crashed. Exception: the first error of a call.
        """
        if self._count == 1 or len(tasks) == 1:
            return run_tasks(function, [(self.grasp_model, *task) for task in tasks], workers=1,
                             progress=progress, message=message)
        self._pool = self._pool or Pool(self._count, begin=_hold,
                                        begin_arguments=(self.grasp_model,),
                                        name=message or "the computation")
        return self._pool.map(_with_branch, [(function, task) for task in tasks],
                              progress=progress, message=message)

    def close(self) -> None:
        """End the processes."""
        if self._pool is not None:
            self._pool.close()
            self._pool = None

    def __enter__(self) -> "SolverPool":
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()


def _hold(grasp_model: GraspModel) -> None:
    _held[:] = [grasp_model]


def _with_branch(function: Callable, arguments: tuple, progress: Progress) -> Any:
    return Task(function, (_held[0], *arguments)).run(progress)
