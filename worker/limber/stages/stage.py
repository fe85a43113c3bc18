"""A stage: one model of all that is given to it, with a ``run``.

It is the single source of a command, its options and schema, a job table and a Python verb::

    class Count(BranchStage, KeptStage):
        '''Count the nodes of the skeleton.'''

        about = About("count", 27, key="count", writes=("count.txt",))
        groups: ClassVar[Groups] = {"counting": ("least_radius",)}

        least_radius: float = Field(0.0, ge=0, description="Of the thicker ones alone [m].")

        def run(self, progress: Progress = SILENT) -> dict[str, Any]:
            branch = Branch.open(self.branch_folder)
            ...

Its docstring is the command's help; ``limber --help`` shows the first line. Three parts make it up,
told by the marks of the fields: what :func:`given`, :func:`required` and :func:`argument` return is
an input (a file, folder or name), :func:`option` makes an option of the run, which does not change
the result. All other fields are settings: the result depends on them, and the manifest records
them. They are often those of a model in the stage's domain, from which the stage is derived; it is
then passed on as these settings.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

from pydantic import Field

from limber.core.errors import InputError, Option
from limber.core.json_values import plain
from limber.core.progress import SILENT, Progress
from limber.core.settings import Settings, checked_settings, nearest

if TYPE_CHECKING:
    from limber.stages.result import Result
    from limber.store import Branch

PARTS = ("inputs", "settings", "options")


@dataclass(frozen=True)
class About:
    """What everything needs to know of a stage beside its fields.

    Attributes:
        name: Name of the command; in two words that of one in a group, such as ``robot check``.
        position: Its position in ``limber --help``, in the order in which stages run; other
            commands are in alphabetical order.
        result: What it returns; None: values without labels.
        key: Key of its entry in the manifest; ``{name}`` is replaced by the field. Empty: none.
        reads: Names of the branch folder's files that it reads; ``{name}`` as in ``key``.
        writes: Names of the files that it writes.
        found: Lines of findings, which :func:`limber.cli.terminal.found_lines` fills from fields
            and result; without any, the whole result is shown.
        then: The usual next command, its names and paths filled in likewise.
        where: Where the results are, likewise; None: what it wrote, or the branch folder.
        prints: Whether ``run`` prints its own output, as a script for a shell; such a command has
            no ``--json`` and no progress.
        step: Its panel in the add-on (:data:`addon.steps.STEPS`); empty: none.
        label: Label of its button there.
        moves_robot: Whether it moves a robot; batches then do not run it.
    """

    name: str
    position: int = 0
    result: "type[Result] | None" = None
    key: str = ""
    reads: tuple[str, ...] = ()
    writes: tuple[str, ...] = ()
    found: "Sequence[str | Callable[[Mapping[str, Any]], str | None]]" = ()
    then: str = ""
    where: "str | Callable[[Mapping[str, Any]], Any] | None" = None
    prints: bool = False
    step: str = ""
    label: str = ""
    moves_robot: Literal["", "when armed", "always"] = ""


def given(description: str, default: Any = None, *, part: str = "inputs", group: str = "input",
          common: bool = False, limits: Mapping[str, Any] | None = None, **shown: Any) -> Any:
    """Return the field of an input.

    Args:
        default: Without it None; ``...``: it is required.
        group: Its title in help and panel.
        common: Whether ``--help`` shows it; ``--help-all`` shows all.
        limits: Such as ``{"ge": 0}``.
        shown: ``short`` (a short option), ``metavar``, ``switch`` (no ``--no-NAME``), ``example``
            (proposed if it is missing; ``{stem}`` in it is the stem of the first given file), or
            ``panel=False`` (panels do not store it: it is typed each time, or given elsewhere).
    """
    return Field(default, description=description, exclude=True, json_schema_extra={
        "part": part, "group": group, "common": common, **shown}, **(limits or {}))


def required(description: str, example: str, **more: Any) -> Any:
    """Return the field of a required input that is given by its name, as :func:`given` does."""
    return given(description, ..., example=example, **more)


argument: Callable[..., Any] = partial(given, default=..., argument=True)
"""Return the field of an input that is given without its name, as :func:`given` does."""
option: Callable[..., Any] = partial(given, part="options", group="running")
"""Return the field of an option of the run, as :func:`given` does."""


class Stage(Settings):
    """Base of all stages; see the module's docstring."""

    about: ClassVar[About]

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        """Do the work; return the result."""
        raise NotImplementedError

    @classmethod
    def parts(cls) -> dict[str, list[str]]:
        """Return the names of the fields of each part, in the order of :data:`PARTS`."""
        found: dict[str, list[str]] = {part: [] for part in PARTS}
        for name, field in cls.model_fields.items():
            extra: Any = field.json_schema_extra or {}
            found[extra.get("part", "settings")].append(name)
        return found

    @classmethod
    def names(cls) -> list[str]:
        """Return the names of all fields: inputs, settings, options."""
        return [name for names in cls.parts().values() for name in names]

    @classmethod
    def checked(cls, values: Mapping[str, Any]) -> Self:
        """Return the stage with these values.

        Raises:
            InputError: a name is unknown, an input is missing, or a value is refused.
        """
        for name in values:
            if name not in cls.model_fields:
                raise InputError(f"{cls.about.name} has no {name!r}.", nearest(name, cls.names()))
        return checked_settings(cls, dict(values))

    def stated(self) -> dict[str, Any]:
        """Return the values that were given in JSON form, of which :meth:`checked` makes it again.
        """
        return {name: plain(getattr(self, name)) for name in self.names()
                if name in self.model_fields_set}

    @property
    def entry(self) -> str:
        """Name of its entry in the manifest; empty if it makes none."""
        return self.about.key.replace("{name}", getattr(self, "name", None) or "")

    @property
    def label(self) -> str:
        """Its command, with the name of its result if there may be several."""
        name = getattr(self, "name", None)
        return f"{self.about.name}:{name}" if name else self.about.name

    def outputs(self) -> list[Path]:
        """Return the files and folders that it writes and its inputs name."""
        return [value for name in self.parts()["inputs"] if self.group_of(name) == "output"
                and isinstance(value := getattr(self, name), Path)]


class BranchStage(Stage):
    """A stage of a branch folder."""

    branch_folder: Path = argument("The branch folder.")


class PlacedStage(BranchStage):
    """A stage that takes positions in two frames, and runs in the branch's."""

    coordinates: Literal["branch", "scan"] = given(
        "Coordinates of all given positions but boxes: the branch folder's, or those of the scan's "
        "file in metres.", "branch", panel=False)

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        return self.in_branch().run_in_branch(progress)

    def run_in_branch(self, progress: Progress) -> dict[str, Any]:
        """Do the work with all positions in the branch's frame; return the result."""
        raise NotImplementedError

    def in_branch(self) -> Self:
        """Return the stage with all positions in the branch's frame.

        Raises:
            InputError: a box is given in the scan's coordinates.
        """
        if self.coordinates == "branch":
            return self
        from limber.store import Branch

        alignment = Branch.read(self.branch_folder).manifest.alignment
        moved: dict[str, Any] = {"coordinates": "branch"}
        for name, field in type(self).model_fields.items():
            extra: Any = field.json_schema_extra or {}
            kind, value = extra.get("frame"), getattr(self, name)
            if kind == "branch axes" and value is not None:
                raise InputError(f"--{name.replace('_', '-')} is given in the scan's coordinates.",
                                 "Its box has the axes of the branch's frame, which are others.",
                                 "Give all positions with ", Option("coordinates", "branch"), ".")
            if kind == "branch" and value is not None:
                moved[name] = tuple(alignment.apply_metres(value).tolist())
        return self.model_copy(update=moved)


class Tool(Stage):
    """A command beside the stages, such as ``limber robot check``; ``--help`` shows all of it."""

    @classmethod
    def is_expert(cls, name: str) -> bool:
        return False


class KeptStage(Stage):
    """A stage whose result is kept, and made again only if something has changed."""

    def is_kept(self, branch: "Branch", key: str = "", **inputs: Any) -> bool:
        """Whether its result in a branch holds, as :meth:`limber.store.Branch.is_current` takes
        ``inputs``."""
        return branch.is_current(key or self.entry, self, **inputs)


class Repeatable(KeptStage):
    """Such a stage that takes long, or whose result differs from run to run."""

    force: bool = option("Run again even if nothing has changed.", False, switch=True)

    def is_kept(self, branch: "Branch", key: str = "", **inputs: Any) -> bool:
        return not self.force and super().is_kept(branch, key, **inputs)
