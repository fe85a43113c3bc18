"""Inputs and options that several stages share."""

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import Field

from limber.core.errors import InputError, Option
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
        if isinstance(inputs, PlacedInputs):
            settings = inputs.in_branch(settings)
        values = {**dict(inputs), **dict(settings), **dict(options), "inputs": inputs,
                  "settings": settings, "options": options, "progress": progress}
        return function(**{name: values[field] for name, field in taken.items()})

    return run


NOT_KEPT: dict[str, Any] = {"panel": False}
"""For a field that the add-on's panels do not store: it is typed each time, or given elsewhere."""


class BranchInputs(Settings):
    """A branch folder."""

    groups: ClassVar[Groups] = {"input": ("branch_folder",)}

    branch_folder: Path = argument("The branch folder.")


class PlacedInputs(BranchInputs):
    """A branch folder, and the frame of the positions in the settings."""

    groups: ClassVar[Groups] = {"input": ("coordinates",)}

    coordinates: Literal["branch", "scan"] = Field(
        "branch", description="Coordinates of all given positions but boxes: the branch folder's, "
        "or those of the scan's file in metres.", json_schema_extra=NOT_KEPT)

    def in_branch(self, settings: Settings) -> Settings:
        """Return the settings with all positions in the branch's frame.

        Raises:
            InputError: a box is given in the scan's coordinates.
        """
        if self.coordinates == "branch":
            return settings
        from limber.store import Branch

        alignment = Branch.read(self.branch_folder).manifest.alignment
        moved = {}
        for name, field in type(settings).model_fields.items():
            extra: Any = field.json_schema_extra or {}
            kind, value = extra.get("frame"), getattr(settings, name)
            if kind == "branch axes" and value is not None:
                raise InputError(f"--{name.replace('_', '-')} is given in the scan's coordinates.",
                                 "Its box has the axes of the branch's frame, which are others.",
                                 "Give all positions with ", Option("coordinates", "branch"), ".")
            if kind == "branch" and value is not None:
                moved[name] = tuple(alignment.apply_metres(value).tolist())
        return settings.model_copy(update=moved)


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
