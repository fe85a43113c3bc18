"""Commands run in this process: their exit code and their result."""

import contextlib
import io
import json

import click
import pytest

from limber.cli import main
from limber.cli.commands.robot import command as robot


def answer(*words: object) -> tuple[int, dict]:
    """Of `limber WORDS`."""
    told = io.StringIO()
    with contextlib.redirect_stdout(told):
        code = main.call([*map(str, words), "--json"])
    return code, json.loads(told.getvalue().splitlines()[-1])


def robot_answer(capfd, *words: object, group: click.Group = robot) -> tuple[int, dict]:
    """Of `limber robot WORDS`, or of another group of commands."""
    with pytest.raises(SystemExit) as stop:
        group.main([*map(str, words), "--json"], standalone_mode=False)
    return stop.value.code, json.loads(capfd.readouterr().out.splitlines()[-1])
