"""The benches' budget: trials that fit, parts that share the time, rows that are not shown."""

import importlib
import json

import numpy as np
import pytest

from benchmarks import table
from benchmarks.table import Asked, Part, Row, Setting, allowance, rows_of, share_met
from benchmarks.trials import Budget, go_on, parsed_seconds, side_by_side
from benchmarks.worker_fuzz import LINE_READERS, READERS, TEMPLATE, outcome
from limber.core.errors import InputError
from limber.core.progress import SILENT


class Clock:
    """A clock that a test moves."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


def _setting(budget: Budget, folder, seed: int = 3) -> Setting:
    return Setting(seed, False, budget, SILENT, folder)


@pytest.mark.parametrize(("text", "seconds"), [
    ("90s", 90), ("15m", 900), ("1h", 3600), ("1.5h", 5400), (" 20 ", 20), (".5m", 30)])
def test_durations_have_a_unit(text, seconds):
    assert parsed_seconds(text) == seconds


@pytest.mark.parametrize("text", ["", "m", "15 minutes", "-5m", "0s", "1e3s", "1:30"])
def test_what_is_no_duration_is_refused(text):
    with pytest.raises(ValueError, match="90s, 15m or 1h"):
        parsed_seconds(text)


def test_trials_stop_where_the_next_one_would_not_fit(clock):
    """The longest so far took 4 s: with 3 s left no more begins."""
    budget, taken = Budget(12, clock), []
    for seed, seconds in zip(budget.seeds(7, at_most=9), (2, 4, 3, 1, 1), strict=False):
        taken.append(seed)
        clock.now += seconds
    assert taken == [7, 8, 9] and budget.remaining == 3


def test_trials_end_with_their_number_and_one_is_always_taken(clock):
    assert list(Budget(50, clock).seeds(0, at_most=3)) == [0, 1, 2]
    late = Budget(-1, clock)
    assert list(late.seeds(5, at_most=3)) == [5]
    assert list(late.seeds(5, at_most=3, at_least=2)) == [5, 6]
    assert list(late.seeds(5, at_most=3, at_least=0)) == []


def test_a_part_of_a_budget_ends_no_later(clock):
    budget = Budget(10, clock)
    assert budget.part(4).remaining == 4 and budget.part(40).remaining == 10


def test_items_share_what_is_left(clock):
    """What the first does not use goes to the others; after the end there is nothing."""
    budget, seen = Budget(12, clock), []
    for item, own in budget.shares(list("abcd")):
        seen.append((item, own.remaining))
        clock.now += {"a": 0, "b": 10}.get(item, 5)
    assert seen == [("a", 3), ("b", 4), ("c", 1), ("d", -3)]


def test_tasks_of_one_worker_stop_as_trials_do(clock):
    def work(task: int) -> int:
        clock.now += 4
        return task * task
    done = list(side_by_side(work, range(9), Budget(10, clock), workers=1))
    assert done == [0, 1]


def _square(task: int) -> int:
    return task * task


@pytest.mark.slow
def test_tasks_of_several_workers_give_their_results():
    """A clock that stands: all fit. One at its end: so many as there have to be."""
    assert sorted(side_by_side(_square, range(4), Budget(60), workers=2)) == [0, 1, 4, 9]
    assert list(side_by_side(_square, range(4), Budget(-1), workers=2)) == [0]


def test_a_run_goes_on_with_kept_trials(clock, tmp_path, monkeypatch):
    """Kept trials cost nothing and count; those of another part or source, and a line that was cut
    off, do not. What is not finite is infinite, however it was read."""
    made, kept = [], tmp_path / "trials.jsonl"

    def trials(seconds: float, part: str = "p", at_least: int = 1) -> list[tuple[int, str]]:
        def work(task: tuple[int, str]) -> dict:
            made.append(task)
            clock.now += 3
            return {"error": float("nan"), "list": np.arange(2)}
        tasks = [(seed, "a") for seed in range(4, 9)]
        found = go_on(part, tasks, work, ("core",), kept, Budget(seconds, clock), at_least=at_least)
        assert all(each["error"] == np.inf and each["list"] == [0, 1] for each in found)
        return [each.task for each in found]
    assert trials(7) == [(4, "a"), (5, "a")] == made
    kept.write_text(kept.read_text() + "{\"part\"")
    kept.write_text(kept.read_text() + "\n")
    assert trials(7) == [(seed, "a") for seed in range(4, 8)] == made
    assert trials(0) == made and trials(0, "q") == [(4, "a")]
    monkeypatch.setattr("benchmarks.trials.source_digest", lambda packages: "later")
    assert trials(0) == [(4, "a")] and trials(0, "r", 0) == []
    assert len(made) == 6


def test_a_failure_that_is_expected_is_a_trial(clock, tmp_path):
    """Others end the campaign; the text of an error of ours needs no name."""
    def work(seed: int) -> dict:
        raise (InputError("seen", "why", "do") if seed == 1 else ValueError("odd"))
    one, other = go_on("p", [1, 2], work, (), tmp_path / "t", Budget(9, clock), catch=Exception)
    assert one.failure.startswith("seen") and other.failure == "ValueError: odd"
    with pytest.raises(ValueError, match="odd"):
        go_on("p", [3], work, (), tmp_path / "t", Budget(9, clock), catch=InputError)


def _part(seconds: float, *names: str, grows: bool = False, run=None, alone: bool = False) -> Part:
    gives = tuple(Asked(name, "1 %") for name in names)

    def measured(setting: Setting) -> list[Row]:
        setting.budget.clock.now += seconds
        return [Row(*asked, "0.5 %", True, 4) for asked in gives]
    return Part(run or measured, seconds, gives, grows=grows, alone=alone)


def test_the_least_of_each_part_comes_before_more_trials():
    """100 s: 10 and 20 s are set aside, 500 s do not fit; two that grow share what is left."""
    grows, fixed, large = _part(10, "a", grows=True), _part(20, "b"), _part(500, "c")
    assert allowance(grows, [large, fixed], 100) == 80
    assert allowance(grows, [grows, fixed], 100) == 10 + 60 / 2
    assert allowance(fixed, [grows], 100) == 20
    assert allowance(large, [], 499) is None
    assert allowance(fixed, [grows], 20) == 20


def test_rows_without_time_are_not_shown(clock, tmp_path):
    """In the table's order, with what was asked; a shorter part behind still comes."""
    parts = {"first": _part(30, "a"), "long": _part(90, "b", "c"), "short": _part(15, "d"),
             "again": _part(1, "e", alone=True)}
    table_rows, failed = rows_of(parts, _setting(Budget(50, clock), tmp_path))
    assert failed == 0
    assert [(row.measure, row.measured, row.met, row.count) for row in table_rows] == [
        ("a", "0.5 %", True, 4), ("b", "not shown", None, 0), ("c", "not shown", None, 0),
        ("d", "0.5 %", True, 4)]
    assert all(row.asked == "1 %" for row in table_rows)
    only, _ = rows_of(parts, _setting(Budget(50, clock), tmp_path), ["again"])
    assert [row.measure for row in only] == ["e"]


def test_a_part_that_fails_takes_none_along(clock, tmp_path, capsys):
    """Its rows are not met; a row that a part does not return is not shown."""
    parts = {"bad": _part(1, "a", run=lambda setting: 1 / 0), "good": _part(1, "b"),
             "half": _part(1, "c", "d", run=lambda setting: [Row("c", "1 %", "2 %", False)])}
    found, failed = rows_of(parts, _setting(Budget(50, clock), tmp_path))
    assert [(row.measure, row.met, row.count) for row in found] == [
        ("a", False, 0), ("b", True, 4), ("c", False, 1), ("d", None, 0)]
    assert failed == 1 and "ZeroDivisionError" in capsys.readouterr().out


def test_few_intervals_are_not_judged():
    assert share_met(0.95, 40, 0.88, 0.99) is True
    assert share_met(0.80, 40, 0.88, 0.99) is False
    assert share_met(0.80, 19, 0.88, 0.99) is None
    assert share_met(1.0, 99, 0.88, 0.99) is None
    assert share_met(1.0, 101, 0.88, 0.99) is False


def test_the_last_line_is_the_table_as_json(monkeypatch, tmp_path, capsys):
    """With the count of each row; the seed that was drawn is printed."""
    seen = []

    def run(setting: Setting) -> list[Row]:
        seen.append((setting.seed, setting.quick, 85 < setting.budget.remaining <= 90))
        return [Row("a", "1 %", "0.5 %", True, 7)]
    monkeypatch.setattr(importlib.import_module("benchmarks.scans"), "PARTS", {
        "one": _part(5, "a", grows=True, run=run), "two": _part(1e4, "b")})
    assert table.main(["scans", "--budget", "90s", "--quick", "--json", "--seed", "12",
                       "--out", str(tmp_path / "out")]) == 0
    assert seen == [(12, True, True)] and (tmp_path / "out").is_dir()
    told = capsys.readouterr().out.splitlines()
    assert told[0] == "base seed 12 (--seed repeats it)"
    record = json.loads(told[-1])
    assert record.pop("date").count("-") == 2 and "commit" in record
    assert {key: record[key] for key in ("bench", "seed", "budget_s")} == {
        "bench": "scans", "seed": 12, "budget_s": 90}
    assert record["rows"] == [
        {"measure": "a", "asked": "1 %", "measured": "0.5 %", "met": True, "count": 7},
        {"measure": "b", "asked": "1 %", "measured": "not shown", "met": None, "count": 0}]


@pytest.mark.parametrize("arguments", [["scans", "--budget", "soon"],
                                       ["scans", "--only", "nothing"]])
def test_wrong_arguments_are_said(arguments, capsys):
    with pytest.raises(SystemExit):
        table.main(arguments)
    told = capsys.readouterr().err
    assert "90s, 15m or 1h" in told or "it has: sparse" in told


@pytest.mark.parametrize("name", table.NAMES)
def test_every_bench_is_a_table_of_parts(name):
    """Each row once, and each part to be judged within 15 minutes."""
    parts = importlib.import_module(f"benchmarks.{name}").PARTS
    rows = [asked for part in parts.values() if not part.alone for asked in part.gives]
    assert len(set(rows)) == len(rows) > 5
    assert all(part.gives and 0 < part.seconds < 900 for part in parts.values())


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(READERS.keys() - LINE_READERS.keys()))
def test_a_reader_of_the_fuzz_reads_its_own_files(name, tmp_path):
    """Before anything is mutated: else the fuzz would only try what refuses."""
    made = READERS[name].make(TEMPLATE, tmp_path)
    assert made and {outcome(READERS[name], path) for path in made} == {("read", "")}
