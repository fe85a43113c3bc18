"""Tasks for a pool. Its processes import this module, and nothing of the tests with it."""

import os
import time

from limber.core.errors import ConvergenceError, InputError
from limber.core.processes import core_budget, run_tasks
from limber.core.progress import Progress


def late_square(number: int) -> int:
    """The first ones take longest."""
    time.sleep(0.05 * (5 - number))
    return number**2


def budget(_number: int) -> tuple[int, int]:
    return core_budget(), os.getpid()


def nested(_number: int) -> list[tuple[int, int]]:
    return run_tasks(budget, [(0,), (1,)])


def diverges(number: int) -> int:
    if number == 1:
        raise ConvergenceError("It diverged.", "Too far.", "Go less far.", result={"steps": 3})
    time.sleep(30)
    return number


def buggy(_number: int) -> int:
    return 1 // 0


def remember(value: int) -> None:
    os.environ["REMEMBERED"] = str(value)


def remembered(number: int) -> str:
    return f"{number} {os.environ['REMEMBERED']}"


def badly_begun() -> None:
    raise InputError("There is no such branch.")


def unpicklable(_number: int) -> object:
    return lambda: None


def half(progress: Progress) -> int:
    progress(0.5, "half")
    time.sleep(0.5)
    return 1


def reports_for_long(progress: Progress) -> None:
    for part in range(1000):
        progress(part / 1000, "long")
        time.sleep(0.02)
