"""Every command that the README shows is one that Limber understands.

They are run by `scripts/bench worker --only readme`.
"""

import re
import shlex
from pathlib import Path

import click
import pytest

from benchmarks.worker_readme import shown_commands
from limber.cli.main import main

README = Path(__file__).parents[1] / "README.md"


def _commands() -> list[str]:
    return shown_commands(README.read_text(encoding="utf-8"))


@pytest.mark.parametrize("line", _commands())
def test_a_command_of_the_readme_is_understood(line):
    """Its options are there and take what is given; nothing is run."""
    _, name, *words = shlex.split(line)
    command = main.get_command(click.Context(main), name)
    assert command is not None, name
    while isinstance(command, click.Group):
        name, *words = words
        command = command.get_command(click.Context(command), name)
        assert command is not None, name
    command.make_context(name, words)


def test_the_readme_shows_commands():
    """The lines are found at all."""
    assert len(_commands()) > 15


def test_every_command_has_an_example():
    """Whatever `limber --help` lists is shown once."""
    text = README.read_text(encoding="utf-8")
    lacking = [name for name in main.list_commands(click.Context(main))
               if not re.search(rf"limber {name}[ `\n]", text)]
    assert not lacking
