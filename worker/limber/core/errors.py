"""The errors that Limber raises on purpose, and the exit code of each.

Every message has three parts: what was found, why it is wrong, what to do. They name options and
commands as data (:class:`Option`, :class:`Command`), which each interface shows in its own way.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Self


@dataclass(frozen=True)
class Option:
    """An option that a message names, by its field; as text it is what one types, ``--plants all``.

    ``value`` is the one to give, a tuple for several numbers; without it only the user knows.
    """

    name: str
    value: Any = None

    def __str__(self) -> str:
        flag = f"{'no-' if self.value is False else ''}{self.name.replace('_', '-')}"
        values = () if self.value is None or isinstance(self.value, bool) else self.value
        return " ".join([f"--{flag}", *map(_typed, values if isinstance(values, tuple) else
                                           (values,))])

    def as_json(self) -> dict[str, Any]:
        return {"option": self.name, "value": self.value, "command": None, "text": str(self)}


def _typed(value: Any) -> str:
    return f"{value:.10g}" if isinstance(value, float) else str(value)


class Command:
    """A command that a message names, with options and other words as they are typed."""

    def __init__(self, name: str, *arguments: str | Option):
        self.name, self.arguments = name, arguments

    def __str__(self) -> str:
        return f"`{' '.join(['limber', self.name, *map(str, self.arguments)])}`"

    def as_json(self) -> dict[str, Any]:
        option = next((each for each in self.arguments if isinstance(each, Option)), None)
        return {"option": option and option.name, "value": option and option.value,
                "command": self.name, "text": str(self)}


class Place(str):
    """A position that a message names, in the frame of whoever writes it: :func:`places_moved`."""

    place: tuple[float, ...]

    def __new__(cls, position: Iterable[float]) -> Self:
        place = tuple(float(value) for value in position)
        text = super().__new__(cls, f"({', '.join(f'{value:.3f}' for value in place)})")
        text.place = place
        return text

    def __reduce__(self) -> tuple[type, tuple[tuple[float, ...]]]:
        return Place, (self.place,)


Part = str | Option | Command
"""A part of a message."""


class Text(str):
    """A message with options and commands in it; as a ``str`` it is what a terminal shows."""

    parts: tuple[Part, ...]
    place: tuple[float, ...] | None = None
    """Position that it is about, in the coordinates and unit of the file that the stage reads."""

    def __new__(cls, *parts: Part) -> Self:
        text = super().__new__(cls, "".join(map(str, parts)))
        text.parts = tuple(each for part in parts for each in getattr(part, "parts", (part,)))
        text.place = next(filter(None, (getattr(part, "place", None) for part in parts)), None)
        return text

    @classmethod
    def joined(cls, between: str, parts: Iterable[Part]) -> Self:
        return cls(*[each for part in parts for each in (between, part)][1:])

    @classmethod
    def from_json(cls, parts: Iterable[Any]) -> Self:
        """Read what :meth:`as_json` returned."""
        return cls(*(part if isinstance(part, str) else _from_json(**part) for part in parts))

    def as_json(self) -> list[Any]:
        return [part if isinstance(part, str) else part.as_json() for part in self.parts]

    @property
    def named(self) -> tuple[Option | Command, ...]:
        """The options and commands in it, each once."""
        found: dict[str, Option | Command] = {}
        for part in self.parts:
            if not isinstance(part, str):
                found.setdefault(str(part), part)
        return tuple(found.values())

    def shown(self, show: Callable[[Option | Command], str]) -> str:
        """Return it with ``show(part)`` for each option and command."""
        return "".join(part if isinstance(part, str) else show(part) for part in self.parts)

    def moved(self, move: Callable[[Any], Iterable[float]]) -> "Text":
        """Return it with each :class:`Place` where ``move`` takes it."""
        return Text(*(Place(move(part.place)) if isinstance(part, Place) else part
                      for part in self.parts))

    def at(self, position: Iterable[float]) -> Self:
        """Set the position; returns the text itself."""
        self.place = tuple(float(value) for value in position)
        return self


def _from_json(option: str | None, value: Any, command: str | None, text: str) -> Option | Command:
    if command is None:
        return Option(str(option), tuple(value) if isinstance(value, list) else value)
    return Command(command, *text.strip("`").split()[1 + len(command.split()):])


def _sentence(text: str) -> Text:
    """A text with its full stop: a solver's or a parser's own words often end without."""
    return Text(text, "." if text and text[-1] not in ".?!:" else "")


class LimberError(Exception):
    """Base of all errors that a user can see. Not raised itself."""

    exit_code = 3
    status = "failed"

    def __init__(self, seen: str, why: str = "", *fix: Part, result: Any = None):
        """State what was ``seen``, ``why`` it is wrong and how to ``fix`` it, in parts; ``result``
        is what was done before."""
        super().__init__(seen, why, *fix)
        self.result = result
        self.seen, self.why, self.fix = _sentence(seen), _sentence(why), Text(*fix)
        self.place = self.seen.place

    def __str__(self) -> str:
        return " ".join(filter(None, (self.seen, self.why, self.fix)))

    @property
    def remedies(self) -> tuple[Option | Command, ...]:
        """What ``fix`` names; of other options that the message names, none has a value."""
        others = (Option(part.name) for part in (*self.seen.named, *self.why.named)
                  if isinstance(part, Option))
        return Text(*self.fix.named, *others).named

    def as_json(self) -> dict[str, Any]:
        parts = [text.as_json() for text in (self.seen, self.why, self.fix)]
        return {"status": self.status, "error": str(self), "fix": self.fix, "parts": parts,
                "code": type(self).__name__, "place": self.place,
                "remedies": [part.as_json() for part in self.remedies]}

    def adding(self, text: str) -> Self:
        """Add a sentence to what was seen; returns the error itself."""
        self.seen = Text(self.seen, " ", text)
        return self

    def at(self, position: Iterable[float]) -> Self:
        """Set the position, also for an error with the same ``seen``; returns the error itself."""
        self.place = self.seen.at(position).place
        return self


@contextmanager
def places_moved(move: Callable[[Any], Iterable[float]]) -> Iterator[None]:
    """Take the places of an error out of the frame of what is done meanwhile."""
    try:
        yield
    except LimberError as error:
        error.seen = error.seen.moved(move)
        error.place = error.seen.place
        raise


class InputError(LimberError):
    """The input or the usage is wrong; nothing was computed (exit code 2)."""

    exit_code = 2


class BranchFolderError(InputError):
    """A branch folder is missing, damaged, of a newer format, or lacks a stage's files."""


class BranchBusyError(BranchFolderError):
    """Another program is writing to the branch folder."""


class WorkError(LimberError):
    """The input was understood but the work failed (exit code 3)."""


class PartlyFailedError(WorkError):
    """Some of several inputs failed; ``result`` has what was done, for the command's JSON."""


class ConvergenceError(WorkError):
    """A solver ended without a solution; ``result`` holds its last state and history."""


class MeshingError(WorkError):
    """No valid surface or tetrahedral mesh was produced."""


class NoPathError(WorkError):
    """The planner found no path that meets the constraints."""


class MissingDependencyError(WorkError):
    """An optional package is not installed; ``limber doctor`` lists the consequences."""


class SafetyStop(LimberError):
    """A robot was stopped, or not started, for safety (exit code 4).

    ``result`` holds the results up to then; it is part of the command's JSON.
    """

    exit_code = 4


class Cancelled(LimberError):
    """The user stopped the work (exit code 130); earlier results are unchanged."""

    exit_code = 130
    status = "cancelled"

    def __init__(self, seen: str = "Cancelled.", why: str = "", *fix: Part):
        super().__init__(seen, why, *fix)
