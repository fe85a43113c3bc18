"""The errors that Limber raises on purpose, and the exit code of each.

Every message has three parts: what was found, why it is wrong, what to do.
"""

from collections.abc import Iterable
from typing import Any, Self


class LimberError(Exception):
    """Base of all errors that a user can see. Not raised itself."""

    exit_code = 3
    status = "failed"
    place: tuple[float, ...] | None = None
    """Position of the problem, in the coordinates and unit of the file that the stage reads."""

    def __init__(self, seen: str, why: str = "", fix: str = ""):
        """State what was ``seen``, ``why`` it is wrong and how to ``fix`` it."""
        self.seen, self.why, self.fix = seen, why, fix
        super().__init__(" ".join(part for part in (seen, why, fix) if part))

    def adding(self, text: str) -> Self:
        """Add a sentence to what was seen; returns the error itself."""
        self.seen = f"{self.seen} {text}"
        self.args = (" ".join(part for part in (self.seen, self.why, self.fix) if part),)
        return self

    def at(self, position: Iterable[float]) -> Self:
        """Set the position; returns the error itself."""
        self.place = tuple(float(value) for value in position)
        return self


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

    def __init__(self, seen: str, why: str = "", fix: str = "", *, result: dict[str, Any]):
        super().__init__(seen, why, fix)
        self.result = result


class ConvergenceError(WorkError):
    """A solver ended without a solution; ``result`` holds its last state and history."""

    def __init__(self, seen: str, why: str = "", fix: str = "", *, result: object = None):
        super().__init__(seen, why, fix)
        self.result = result


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

    def __init__(self, seen: str, why: str = "", fix: str = "", *,
                 result: dict[str, Any] | None = None):
        super().__init__(seen, why, fix)
        self.result = result or {}


class DamagedCacheWarning(UserWarning):
    """A cached file could not be used."""


class Cancelled(LimberError):
    """The user stopped the work (exit code 130); earlier results are unchanged."""

    exit_code = 130
    status = "cancelled"

    def __init__(self, seen: str = "Cancelled.", why: str = "", fix: str = ""):
        super().__init__(seen, why, fix)
