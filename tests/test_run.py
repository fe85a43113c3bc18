"""The suite's own runner: no part hides another, and the table says what happened."""

import pytest
from tests import run

REPORT = """<testsuites><testsuite name="pytest">
<testcase classname="a" name="passes"/>{}
<testcase classname="a" name="skips"><skipped message="Skipped: wants ccx"/></testcase>
</testsuite></testsuites>"""
FAILURE = '<testcase classname="a" name="fails"><failure message="no">no</failure></testcase>'


@pytest.fixture
def pytest_runs(monkeypatch):
    """Calls of pytest that write what a list says: True fails, False passes."""
    outcomes, calls = [], []

    def called(arguments, report):
        calls.append(arguments)
        failed = outcomes.pop(0)
        report.write_text(REPORT.format(FAILURE if failed else ""))
        return int(failed)

    monkeypatch.setattr(run, "_pytest", called)
    monkeypatch.setattr(run, "command", lambda name, words: run.Part(name, 0.1, False))
    return outcomes, calls


def test_a_failed_part_hides_no_other(pytest_runs, capsys):
    outcomes, calls = pytest_runs
    outcomes += [True, False]
    assert run.main([]) == 1
    assert len(calls) == 2 and "real_time" in calls[1]
    assert capsys.readouterr().out.rstrip().endswith("2 passed, 1 failed, 2 skipped")


def test_real_time_tests_are_tried_once_more(pytest_runs, capsys):
    """Only those that failed; what passes then counts as passed."""
    outcomes, calls = pytest_runs
    outcomes += [False, True, False]
    assert run.main([]) == 0
    assert "--last-failed" in calls[2]
    printed = capsys.readouterr().out
    assert "3 passed, 0 failed, 2 skipped" in printed and "2  wants ccx" in printed


def test_a_failed_style_check_fails_the_run(pytest_runs, monkeypatch, capsys):
    outcomes, _ = pytest_runs
    outcomes += [False, False]
    monkeypatch.setattr(run, "command", lambda name, words: run.Part(name, 0.1, name == "style"))
    assert run.main([]) == 1
    assert "2 passed, 1 failed" in capsys.readouterr().out


def test_arguments_go_to_pytest(pytest_runs):
    outcomes, calls = pytest_runs
    outcomes.append(False)
    assert run.main(["tests/geometry", "-k", "skeleton"]) == 0
    assert calls == [["tests/geometry", "-k", "skeleton"]]
