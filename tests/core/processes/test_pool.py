"""The pool: order, budget, errors, and what nested programs may use."""

import os

import pytest
from tests.subjects.tasks import (
    badly_begun,
    budget,
    buggy,
    diverges,
    half,
    late_square,
    nested,
    remember,
    remembered,
    reports_for_long,
    unpicklable,
)

from limber.core.errors import Cancelled, ConvergenceError, InputError
from limber.core.processes import Pool, core_budget, run_tasks, worker_count
from limber.core.processes import pool as pool_module
from limber.core.processes.process_limits import free_memory_mb
from limber.core.progress import Progress


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_results_come_in_order(workers: int, monkeypatch):
    monkeypatch.setenv("LIMBER_CORES", "2")
    assert run_tasks(late_square, [(i,) for i in range(5)], workers=workers) == [0, 1, 4, 9, 16]


def test_nothing_to_do_is_nothing():
    assert run_tasks(late_square, []) == []


def test_a_share_of_the_cores_is_handed_down(monkeypatch):
    """Two processes of a budget of 4 have 2 each; a pool inside them starts no more."""
    monkeypatch.setenv("LIMBER_CORES", "4")
    with Pool(2) as pool:
        found = pool.map(budget, [(0,), (1,)])
        assert {cores for cores, _ in found} == {2}
        inner = pool.map(nested, [(0,)])[0]
    assert {cores for cores, _ in inner} == {1}
    monkeypatch.setenv("LIMBER_CORES", "1")
    assert run_tasks(budget, [(0,), (1,)]) == [(1, os.getpid())] * 2


def test_workers_fit_cores_memory_and_tasks(monkeypatch):
    monkeypatch.setenv("LIMBER_CORES", "8")
    assert worker_count(100) == 8
    assert worker_count(3) == 3
    assert worker_count(100, requested=2) == 2
    assert worker_count(100, requested=50) == 8
    assert worker_count(100, memory_mb_each=free_memory_mb() / 2.5) == 2
    assert worker_count(100, memory_mb_each=1e9) == 1
    assert worker_count(0) == 1


@pytest.mark.parametrize("text", ["0", "-1", "many", ""])
def test_a_wrong_budget_is_refused(monkeypatch, text: str):
    monkeypatch.setenv("LIMBER_CORES", text)
    with pytest.raises(InputError, match="LIMBER_CORES"):
        core_budget()


@pytest.mark.slow
def test_the_first_error_stops_the_others_and_keeps_what_it_carries(monkeypatch):
    monkeypatch.setattr(pool_module, "_GRACE_SECONDS", 0.3)
    with Pool(2) as pool, pytest.raises(ConvergenceError, match=r"diverged\. Too far") as error:
        pool.map(diverges, [(0,), (1,), (2,)])
    assert error.value.result == {"steps": 3}
    assert error.value.fix == "Go less far."


def test_a_bug_comes_with_the_trace_of_its_process():
    with Pool(1) as pool, pytest.raises(ZeroDivisionError) as error:
        pool.map(buggy, [(0,)])
    assert "return 1 // 0" in "".join(error.value.__notes__)


def test_a_result_that_cannot_be_sent_is_an_error():
    with Pool(1) as pool:
        with pytest.raises(Exception, match=r"pickle|local object"):
            pool.map(unpicklable, [(0,)])
        assert pool.map(late_square, [(5,)]) == [25]


def test_each_process_begins_as_told():
    with Pool(2, begin=remember, begin_arguments=(7,)) as pool:
        assert pool.map(remembered, [(0,), (1,), (2,)]) == ["0 7", "1 7", "2 7"]


def test_a_failed_beginning_is_the_error_of_every_task():
    with Pool(2, begin=badly_begun) as pool:
        for _ in range(2):
            with pytest.raises(InputError, match="no such branch"):
                pool.map(late_square, [(5,), (5,)])


@pytest.mark.slow
def test_progress_tells_share_count_and_remaining_time(monkeypatch):
    monkeypatch.setenv("LIMBER_CORES", "2")
    seen = []
    run_tasks(half, [()] * 4, progress=Progress(lambda *said: seen.append(said)), message="halves")
    fractions = [fraction for fraction, _, _ in seen]
    assert fractions == sorted(fractions) and fractions[-1] == 1.0
    assert {message for _, message, _ in seen} == {"halves"}
    assert [numbers["done"] for _, _, numbers in seen][-1] == 4
    remaining = [numbers["remaining_s"] for _, _, numbers in seen if "remaining_s" in numbers]
    assert remaining and remaining[-1] <= remaining[0] < 60


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_a_cancel_reaches_the_tasks(workers: int, monkeypatch):
    monkeypatch.setenv("LIMBER_CORES", "2")
    done = []

    def hear(fraction: float, _message: str, numbers: dict) -> None:
        done.append(numbers.get("done", 0))
        if fraction > 0.01:
            progress.cancel()
    progress = Progress(hear)
    with pytest.raises(Cancelled):
        run_tasks(half, [()] * 100, workers=workers, progress=progress)
    assert max(done) < 20


def test_a_task_cancelled_by_its_own_progress_ends_alone():
    """The pool itself was not cancelled: it goes on with other """
    progress = Progress(lambda _fraction, _message, _numbers: progress.cancel())
    with Pool(1) as pool:
        with pytest.raises(Cancelled):
            pool.submit(reports_for_long, progress=progress).result(60)
        assert pool.submit(late_square, 5).result(60) == 25
