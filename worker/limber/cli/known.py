"""The commands by name: those of stages, and others, which are declared in ``cli/commands``.

Both are classes of :mod:`limber.stages.stage`. A name in two words, such as ``robot check``, is
that of a command in a group, whose help is the docstring of its module or package. Nothing is
imported to find them: `limber --help` must not wait for the numerical packages.
"""

import ast
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from limber.stages.registry import Found, first_words, found_in, stage_class, stage_summaries

if TYPE_CHECKING:
    from limber.stages.stage import Stage

_FOLDER = Path(__file__).parent / "commands"


@cache
def others() -> dict[str, Found]:
    """Return the commands beside the stages by name, in alphabetical order."""
    return {found.name: found for found in sorted(found_in(_FOLDER, f"{__package__}.commands"))}


def command_class(name: str) -> "type[Stage]":
    """Return the class of a command; KeyError if there is none of this name."""
    return others()[name].stage() if name in others() else stage_class(name)


def command_names() -> list[str]:
    """Return the names of all commands, those in groups in two words."""
    return [*stage_summaries(), *others()]


def command_summaries() -> dict[str, str]:
    """Return a summary of each command or group of them in one line, by its first word."""
    return stage_summaries() | {
        word: first_words(group_help(word)) if " " in name else others()[name].summary
        for name in others() for word in [name.partition(" ")[0]]}


def group_help(word: str) -> str:
    """Return the help of a group: the docstring of its module or package."""
    module = _FOLDER / f"{word}.py"
    path = module if module.is_file() else _FOLDER / word / "__init__.py"
    return ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
