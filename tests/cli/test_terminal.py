"""What a person reads on a terminal."""

from limber.cli.terminal import result_lines, table_lines


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
