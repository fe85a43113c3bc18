"""Inputs and options that several stages share."""

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

from pydantic import Field

from limber.core.progress import Progress
from limber.core.settings import Groups, Settings

Run = Callable[[Any, Any, Any, Progress], dict[str, Any]]
"""Run of a stage: inputs, settings, options and progress."""


def argument(description: str) -> Any:
    """Return the field of an input that is given without its name."""
    return Field(description=description, json_schema_extra={"argument": True})


def required(description: str, example: str) -> Any:
    """Return the field of a required option; ``example`` is proposed if it is missing.

    ``{stem}`` in it is the stem of the first file or folder that is given.
    """
    return Field(description=description, json_schema_extra={"example": example})


def by_name(function: Callable[..., dict[str, Any]], **fields: str) -> Run:
    """Return a run that calls a function whose parameters are named like its fields.

    Args:
        function: Takes fields of inputs, settings and options, or ``inputs``, ``settings`` and
            ``options`` whole, and ``progress``.
        fields: Parameters with a name of their own, each with its field.
    """
    taken = {name: fields.get(name, name) for name in inspect.signature(function).parameters}

    def run(inputs: Settings, settings: Settings, options: Settings, progress: Progress,
            ) -> dict[str, Any]:
        values = {**dict(inputs), **dict(settings), **dict(options), "inputs": inputs,
                  "settings": settings, "options": options, "progress": progress}
        return function(**{name: values[field] for name, field in taken.items()})

    return run


NOT_KEPT = {"panel": False}
"""For a field that the add-on's panels do not store: it is typed each time, or given elsewhere."""


class BranchInputs(Settings):
    """A branch folder."""

    groups: ClassVar[Groups] = {"input": ("branch_folder",)}

    branch_folder: Path = argument("The branch folder.")


class RunOptions(Settings):
    """Options of a stage's run; none of them changes the result."""

    groups: ClassVar[Groups] = {"running": ("force",)}

    force: bool = Field(False, description="Run again even if nothing has changed.",
                        json_schema_extra={"switch": True})


class ParallelOptions(RunOptions):
    """For stages that use several processes."""

    groups: ClassVar[Groups] = {"running": ("workers",)}

    workers: int | None = Field(None, ge=1, description=(
        "Largest number of parallel processes. Default: one per core (LIMBER_CORES). The result "
        "does not depend on it."))


class NoOptions(Settings):
    """For stages without options of the run."""


class NoSettings(Settings):
    """For stages without settings."""
