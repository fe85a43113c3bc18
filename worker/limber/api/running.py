"""Running a stage for a Python user: progress, warnings, and messages with Python names."""

import contextlib
import sys
import threading
import types
import warnings
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from limber.cli.known import command_class
from limber.core.errors import Command, InputError, LimberError, Option, Text
from limber.core.json_values import plain
from limber.core.progress import BarSink, LineSink, Progress, Sink
from limber.stages.stage import Stage

_STAGES = {"add_pull": "import-pull", "energy_field": "energy"}
_lock = threading.Lock()
_hidden: list[types.ModuleType] = []
"""The user's script, once for each stage that runs."""


def stage_of(verb: str) -> str:
    """Return the name of the command that a verb of the Python interface runs."""
    return _STAGES.get(verb, verb.replace("_", "-"))


def run_stage(name: str, arguments: Mapping[str, Any], *, quiet: bool) -> tuple[str,
                                                                                dict[str, Any]]:
    """Run a stage in this process.

    Args:
        name: Name of the stage.
        arguments: Its inputs, settings and options by name; arrays are accepted for lists.
        quiet: Show no progress.

    Returns:
        The name of its entry in the branch's manifest, empty if it makes none; and the output of
        its command with ``--json``, from ``warnings`` on.

    Raises:
        InputError: a name is not known, or a value is refused. LimberError: as for the stage.
    """
    caught: list[Text] = []
    try:
        with in_python_words(), script_run_once(), _sink(name, quiet) as sink:
            stage = _checked(name, arguments)
            result = stage.run(Progress(sink, caught.append))
    finally:
        for text in caught:
            warnings.warn(text.shown(_in_python), stacklevel=_users_level())
    return stage.entry, {"warnings": caught} | plain(result)


def _checked(name: str, arguments: Mapping[str, Any]) -> Stage:
    try:
        return command_class(name).checked(
            {key: plain(value) if isinstance(value, np.ndarray | np.generic | list | tuple)
             else value for key, value in arguments.items()})
    except InputError as error:
        error.fix = Text(f"limber.settings({name!r}) lists what it takes.")
        raise


def _users_level() -> int:
    """Number of calls between the function that asks and the line that called a verb."""
    frame, level = sys._getframe(1), 1
    while frame.f_back is not None and frame.f_globals["__name__"].startswith("limber."):
        frame, level = frame.f_back, level + 1
    return level


@contextlib.contextmanager
def script_run_once() -> Iterator[None]:
    """Keep the processes that a stage starts from importing the user's script: that would run it
    again, and they do not need it."""
    with _lock:
        _hidden.append(_hidden[0] if _hidden else sys.modules["__main__"])
        sys.modules["__main__"] = types.ModuleType("__main__")
    try:
        yield
    finally:
        with _lock:
            script = _hidden.pop()
            if not _hidden:
                sys.modules["__main__"] = script


@contextlib.contextmanager
def _sink(title: str, quiet: bool) -> Iterator[Sink | None]:
    """The progress display: a bar in a terminal, a line in a notebook, none elsewhere."""
    if quiet:
        yield None
    elif "ipykernel" in sys.modules:
        with LineSink(title) as line:
            yield line
    elif sys.stderr.isatty():
        with BarSink(title) as bar:
            yield bar
    else:
        yield None


@contextlib.contextmanager
def in_python_words() -> Iterator[None]:
    """Make error messages name keyword arguments instead of options."""
    try:
        yield
    except LimberError as error:
        error.seen, error.why, error.fix = (
            Text(text.shown(_in_python)) for text in (error.seen, error.why, error.fix))
        raise


def _in_python(part: Option | Command) -> str:
    if isinstance(part, Command):
        return str(part)
    return part.name if part.value is None else f"{part.name}={part.value!r}"
