"""The suite's own runner: no part hides another, and the table says what happened."""

import json

import pytest
from tests import run

REPORT = """<testsuites><testsuite name="pytest">
<testcase classname="a" name="passes"/>{}
<testcase classname="a" name="skips"><skipped message="Skipped: wants ccx"/></testcase>
</testsuite></testsuites>"""
FAILURE = '<testcase classname="a" name="fails"><failure message="no">no</failure></testcase>'


@pytest.fixture
def pytest_runs(monkeypatch, tmp_path):
    """Calls of pytest that write what a list says of their part: True fails, False passes."""
    outcomes, calls = {"real_time": [False], "not real_time": [False]}, []

    def called(arguments, report, output):
        calls.append(arguments)
        part = arguments[arguments.index("-m") + 1].removesuffix(" and not campaign")
        part = part if part in outcomes else "not real_time"
        failed = outcomes[part].pop(0)
        report.write_text(REPORT.format(FAILURE if failed else ""))
        if output is not None:
            output.write_text("said by pytest")
        return int(failed)

    monkeypatch.setattr(run, "_pytest", called)
    monkeypatch.setattr(run, "DURATIONS", tmp_path / "durations.json")
    monkeypatch.setattr(run, "command", lambda name, words: run.Part(name, 0.1, False))
    return outcomes, calls


def test_a_failed_part_hides_no_other(pytest_runs, capsys):
    outcomes, calls = pytest_runs
    outcomes["not real_time"] = [True]
    assert run.main([]) == 1
    assert len(calls) == 2
    printed = capsys.readouterr().out
    assert "said by pytest" in printed
    assert printed.rstrip().endswith("2 passed, 1 failed, 2 skipped")


def test_real_time_tests_are_tried_once_more(pytest_runs, capsys):
    """Only those that failed; what passes then counts as passed."""
    outcomes, calls = pytest_runs
    outcomes["real_time"] = [True, False]
    assert run.main([]) == 0
    assert "--last-failed" in calls[2]
    printed = capsys.readouterr().out
    assert "3 passed, 0 failed, 2 skipped" in printed and "2  wants ccx" in printed


def test_what_fails_twice_fails(pytest_runs, capsys):
    """And is counted once."""
    pytest_runs[0]["real_time"] = [True, True]
    assert run.main([]) == 1
    assert "2 passed, 1 failed, 2 skipped" in capsys.readouterr().out


def test_a_failed_style_check_fails_the_run(pytest_runs, monkeypatch, capsys):
    monkeypatch.setattr(run, "command", lambda name, words: run.Part(name, 0.1, name == "style"))
    assert run.main([]) == 1
    assert "2 passed, 1 failed" in capsys.readouterr().out


def test_arguments_go_to_pytest(pytest_runs):
    _, calls = pytest_runs
    assert run.main(["tests/geometry", "-k", "skeleton"]) == 0
    assert calls == [["-m", "not campaign", "tests/geometry", "-k", "skeleton"]]


def test_durations_are_kept_and_a_new_long_test_wants_a_mark(pytest_runs, monkeypatch, capsys):
    """A whole run writes them; what was there before, or is marked, may take its time."""
    case = '<testcase classname="a" name="{}" time="{}">{}</testcase>'
    mark = '<properties><property name="long" value="yes"/></properties>'
    monkeypatch.setattr("tests.test_run.REPORT", "<testsuites>{}" + case.format("b", 7.1, mark)
                        + case.format("c", 9.3, "") + case.format("d", 0.4, "") + "</testsuites>")
    assert run.main([]) == 0, "there are no durations to compare with yet"
    kept = run.DURATIONS.read_text()
    assert list(json.loads(kept).items()) == [("a::c", 9.5), ("a::b", 7.0)]
    pytest_runs[0].update({"real_time": [False], "not real_time": [False]})
    assert run.main([]) == 0
    run.DURATIONS.write_text("{}")
    pytest_runs[0].update({"real_time": [False], "not real_time": [False]})
    assert run.main([]) == 1
    assert "without the mark slow or campaign: a::c (9 s)" in capsys.readouterr().out
