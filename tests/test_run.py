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
def runs(monkeypatch, tmp_path):
    """Programs that do what a list says of their part: True fails, False passes. Parts of pytest
    that are in none have no tests."""
    outcomes, calls = {"real time": [False], "tests": [False]}, []

    def ran(name, words, output):
        calls.append((name, words))
        if output is not None:
            output.write_text(f"said by {name}")
        failed = outcomes[name].pop(0) if name in outcomes else False
        if name in outcomes and "--junit-xml" in words:
            words[words.index("--junit-xml") + 1].write_text(
                REPORT.format(FAILURE if failed else ""))
        return int(failed)

    monkeypatch.setattr(run, "_run", ran)
    monkeypatch.setattr(run, "DURATIONS", tmp_path / "durations.json")
    return outcomes, calls


def test_a_failed_part_hides_no_other(runs, capsys):
    outcomes, calls = runs
    outcomes["tests"] = [True]
    assert run.main([]) == 1
    assert {name for name, _ in calls} == {
        "style", "types", "layers", "packages", "tests", "real time", "Blender"}
    printed = capsys.readouterr().out
    assert "said by real time" in printed and "said by types" in printed
    assert printed.rstrip().endswith("2 passed, 1 failed, 2 skipped")


def test_the_quick_run_has_no_slow_part(runs):
    """Checks go beside the quick tests of every package."""
    assert run.main(["--fast"]) == 0
    assert {name for name, _ in runs[1]} == {"style", "types", "layers", "packages", "tests"}


def test_real_time_tests_are_tried_once_more(runs, capsys):
    """Only those that failed; what passes then counts as passed."""
    outcomes, calls = runs
    outcomes["real time"] = [True, False]
    assert run.main([]) == 0
    assert calls[-1][0] == "real time" and "--last-failed" in calls[-1][1]
    printed = capsys.readouterr().out
    assert "3 passed, 0 failed, 2 skipped" in printed and "2  wants ccx" in printed


def test_what_fails_twice_fails(runs, capsys):
    """And is counted once."""
    runs[0]["real time"] = [True, True]
    assert run.main([]) == 1
    assert "2 passed, 1 failed, 2 skipped" in capsys.readouterr().out


@pytest.mark.parametrize("check", ["style", "types", "layers", "packages"])
def test_a_failed_check_fails_the_run(runs, check, capsys):
    runs[0][check] = [True]
    assert run.main([]) == 1
    assert "2 passed, 1 failed" in capsys.readouterr().out


def test_arguments_go_to_pytest(runs):
    _, calls = runs
    assert run.main(["tests/geometry", "-k", "skeleton"]) == 0
    (style, _), (tests, words) = calls
    assert (style, tests) == ("style", "tests")
    assert words[3:8] == ["-m", "not campaign", "tests/geometry", "-k", "skeleton"]


def test_durations_are_kept_and_a_new_long_test_wants_a_mark(runs, monkeypatch, capsys):
    """A whole run writes them; what was there before, or is marked, may take its time."""
    case = '<testcase classname="a" name="{}" time="{}">{}</testcase>'
    mark = '<properties><property name="long" value="yes"/></properties>'
    monkeypatch.setattr("tests.test_run.REPORT", "<testsuites>{}" + case.format("b", 7.1, mark)
                        + case.format("c", 9.3, "") + case.format("d", 0.4, "") + "</testsuites>")
    assert run.main([]) == 0, "there are no durations to compare with yet"
    kept = run.DURATIONS.read_text()
    assert list(json.loads(kept).items()) == [("a::c", 9.5), ("a::b", 7.0)]
    runs[0].update({"real time": [False], "tests": [False]})
    assert run.main([]) == 0
    run.DURATIONS.write_text("{}")
    runs[0].update({"real time": [False], "tests": [False]})
    assert run.main([]) == 1
    assert "without the mark slow or campaign: a::c (9 s)" in capsys.readouterr().out
