"""Every command that the README shows is one that Limber understands."""

import re
import shlex
from pathlib import Path

import click
import pytest

from limber.cli import main

README = Path(__file__).parents[1] / "README.md"


def _commands() -> list[str]:
    """Lines of the README's code blocks that begin with limber, continued lines joined."""
    blocks = re.findall(r"^```[a-z]*\n(.*?)^```", README.read_text(encoding="utf-8"),
                        re.MULTILINE | re.DOTALL)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    return [line.split(" #")[0].strip() for line in lines if line.startswith("limber ")]


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
