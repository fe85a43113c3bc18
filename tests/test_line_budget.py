"""The budgets of lines of code and of settings, which only fall: a new feature pays with what it
replaces.
"""

import ast
import tomllib
from pathlib import Path

import pytest

from limber.stages.registry import stage_schema, stage_summaries

ROOT = Path(__file__).parents[1]
BUDGET = tomllib.loads((ROOT / "tests" / "line_budget.toml").read_text(encoding="utf-8"))
SLACK = 150
"""Lines that a budget may lie above the code."""


def code_lines(text: str) -> int:
    """Count the lines of a module without docstrings, comments and blank lines."""
    lines = {number for number, line in enumerate(text.splitlines(), 1)
             if line.strip() and not line.lstrip().startswith("#")}
    for node in ast.walk(ast.parse(text)):
        # A text alone is a docstring: of a module, class, function or constant.
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(
                node.value.value, str):
            lines.difference_update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return len(lines)


def parts() -> dict[str, list[Path]]:
    """The Python files of each part that has a budget."""
    core = ROOT / "worker" / "limber"
    folders = {f"limber/{folder.name}": folder for folder in sorted(core.iterdir())
               if folder.is_dir() and any(folder.rglob("*.py"))}
    folders |= {"benchmarks": ROOT / "worker" / "benchmarks", "tests": ROOT / "tests",
                "addon": ROOT / "addon"}
    return {name: sorted(folder.rglob("*.py")) for name, folder in folders.items()}


@pytest.mark.parametrize("name", sorted(parts()))
def test_lines_of_code_only_fall(name: str):
    lines = sum(code_lines(path.read_text(encoding="utf-8")) for path in parts()[name])
    budget = BUDGET["lines"].get(name, 0)
    assert lines <= budget, (f"{name} has {lines} lines of code, its budget is {budget}. Replace "
                             "what the new lines do again, or take them from another place.")
    assert budget <= lines + SLACK, (
        f"{name} has {lines} lines of code. Lower its budget of {budget} (line_budget.toml).")


def test_the_budget_names_no_part_that_is_gone():
    assert set(BUDGET["lines"]) == set(parts())


def test_settings_only_fall():
    """What all stages take, inputs and options of a run included; and of it what is for experts."""
    fields = [about for schema in map(stage_schema, stage_summaries())
              for part in ("inputs", "settings", "options")
              for about in schema[part].get("properties", {}).values()]
    counts = {"fields": len(fields), "expert": sum(about["expert"] for about in fields)}
    assert counts == BUDGET["settings"], (
        "More than the budget: replace a setting by a rule. Fewer: lower it in line_budget.toml.")


def test_what_counts_as_code():
    text = '"""Module."""\n\nimport os  # why\n\nA = 1\n"""Of A."""\n\n\ndef f():\n' \
           '    """Text.\n\n    More.\n    """\n    # why\n    return (1,\n\n            2)\n'
    assert code_lines(text) == 5
