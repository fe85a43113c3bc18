"""What a person reads on a terminal."""

import string
from pathlib import Path

import pytest

from limber.cli.terminal import (
    UNITS,
    closing_lines,
    command_to_type,
    found_lines,
    result_lines,
    table_lines,
)
from limber.stages.registry import stage_description, stage_summaries


def test_result_has_few_digits_and_nothing_empty():
    """Numbers to five digits, lists on a line, what is nested indented, empty entries left out."""
    result = {"young_pa": [95342689.1366041, 1e8], "converged": True, "picture": None, "ties": [],
              "count": 2280, "quality": {"ratio": 0.99583506, "bad": None},
              "bridges": [{"from": [0.1234567, 0.0], "length": 0.0374492}]}
    assert list(result_lines(result)) == [
        "young_pa: [9.5343e+07, 1e+08]", "converged: yes", "count: 2280", "quality:",
        "  ratio: 0.99584", "bridges:", "  from [0.12346, 0], length 0.037449"]
    assert list(result_lines({"costs": list(range(30))}))[-1] == "  and 18 more (--json shows all)"


def test_table_is_aligned():
    """Every row is as wide as the header."""
    lines = list(table_lines([["point", "E [MPa]"], ["1", "95.34"]]))
    assert lines == ["point  E [MPa]", "    1    95.34"]


def test_lines_of_what_was_found_have_units_and_need_their_values():
    """A line whose value is not there is left out; a vector is told by its length."""
    values = {"length_m": 0.0042, "young_pa": [2.5e9, None], "moved_m": [3.0, 0.0, 4.0],
              "share": 0.123, "why": None, "one": 1, "two": 2000, "best": {"force_n": 1.25}}
    lines = ["{length_m:m} long", "{young_pa[0]:Pa}", "{young_pa[1]:Pa}", "{moved_m:|m} away",
             "{share:share} of it", "{one:#branch/branches}, {two:#branch/branches}", "{why}",
             "{nothing}", "{best[force_n]:N}",
             lambda result: f"{len(result)} values", lambda result: None,
             lambda result: result["of an older program"]]
    assert list(found_lines(lines, values)) == [
        "4.2 mm long", "2.5 GPa", "5 m away", "12.3 % of it",
        "1 branch, 2,000 branches", "1.25 N", "8 values"]


def test_the_end_says_what_where_and_what_next():
    """A command that is proposed can be typed as it stands."""
    values = {"branch_folder": Path("my trees/a.branch"), "name": None}
    then = command_to_type("limber estimate {branch_folder}", values)
    assert then == "limber estimate 'my trees/a.branch'"
    assert command_to_type("limber plan {branch_folder} --name {name}", values) == ""
    assert command_to_type("{name:if}limber verify {branch_folder}", values) == ""
    assert command_to_type("{branch_folder:if}limber doctor", values) == "limber doctor"
    assert closing_lines(["Done."], "a.branch", then) == [
        "Done.", "in    a.branch", f"next  {then}"]
    assert closing_lines(["Done."]) == ["Done."]


@pytest.mark.parametrize("name", list(stage_summaries()))
def test_every_stage_says_what_it_found_and_proposes_commands_that_exist(name):
    """Its lines are written in known units; the command after it is one of ours."""
    stage = stage_description(name)
    assert stage.found
    for line in (line for line in stage.found if isinstance(line, str)):
        for _text, field, spec, _conversion in string.Formatter().parse(line):
            if field is not None and spec:
                assert spec.lstrip("|") in UNITS or spec[0] in ".#", (line, spec)
    if stage.then:
        program, command, *_rest = stage.then.rpartition(":if}")[2].split()
        assert program == "limber" and command in stage_summaries()
