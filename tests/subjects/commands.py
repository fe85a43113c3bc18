"""Commands run in this process: their exit code and their result."""

import contextlib
import io
import json

from limber.cli import main


def answer(*words: object) -> tuple[int, dict]:
    """Of `limber WORDS`."""
    told = io.StringIO()
    with contextlib.redirect_stdout(told):
        code = main.call([*map(str, words), "--json"])
    return code, json.loads(told.getvalue().splitlines()[-1])


def robot_answer(capfd, *words: object, group: str = "robot") -> tuple[int, dict]:
    """Of `limber robot WORDS`, or of another group of commands."""
    code = main.call([group, *map(str, words), "--json"])
    return code, json.loads(capfd.readouterr().out.splitlines()[-1])
