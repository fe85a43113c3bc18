"""The steps of the work: the stages of each panel, and their state. No bpy.

Each stage's data comes from its schema, including its step; this module has the steps.
"""

import enum
from dataclasses import dataclass

from .stages import stages

WAYS = frozenset({"move"})
"""Vectors in metres that are displacements, not positions: the 3D cursor does not give them."""
REGIONS = ("goal", "tip_goal", "target_box", "workspace")
"""Fields of a plan that the active object gives: a ball or a box."""
SCAN_PLACES = frozenset({"root", "camera_at"})
"""Positions in the coordinates of a scan's file."""
PLACES = {"fruit": (0.1,), "cut": ()}
"""Lists of positions on the branch, and the values after a position: the mass [kg] of a fruit."""

FIRST = {"plan": "energy"}
"""Stage to run before a stage if its result is missing, or is of an earlier shape."""


class StepState(enum.Enum):
    """State of a stage, with its displayed text and icon."""

    NOT_RUN = ("not run yet", "RADIOBUT_OFF")
    RUNNING = ("running", "SORTTIME")
    WAITING = ("waiting for its turn", "TIME")
    DONE = ("done", "CHECKMARK")
    STALE = ("out of date: its input has changed", "FILE_REFRESH")
    CHANGED = ("out of date: its settings have changed", "FILE_REFRESH")
    FAILED = ("failed", "ERROR")
    OVER_STRENGTH = ("the stress exceeds the strength of the wood", "ERROR")

    @property
    def words(self) -> str:
        return self.value[0]

    @property
    def icon(self) -> str:
        return self.value[1]


@dataclass(frozen=True)
class StageView:
    """A stage in a step, and the groups of settings shown with it."""

    stage: str
    groups: tuple[str, ...] | None = None
    """None: all."""


@dataclass(frozen=True)
class Step:
    """One panel: its first stage. ``fields`` of it are above its button, the rest is folded in.

    ``page`` is that of the guide about it.
    ``scene_operator`` replaces the stage's button if the step itself runs none.
    """

    name: str
    title: str
    view: StageView
    fields: tuple[str, ...] = ()
    scene_operator: tuple[str, str] = ()
    hint: str = ""
    page: str = ""

    @property
    def others(self) -> tuple[StageView, ...]:
        """The further stages of this step, according to their schemas."""
        return tuple(StageView(stage.name) for stage in stages().values()
                     if stage.step == self.name and stage.name != self.view.stage)


STEPS = (
    Step("scan", "Scan", StageView("reconstruct", ("input",)), fields=("cloud", "unit"),
         scene_operator=("limber.import_cloud", "Import Scan"), page="howto/scan"),
    Step("skeleton", "Skeleton", StageView("reconstruct", ("shape", "running")),
         page="howto/skeleton"),
    Step("mesh", "Mesh", StageView("reconstruct", ("mesh",)),
         hint="Made together with the skeleton", page="tutorials/scan_to_bend"),
    Step("material", "Material", StageView("reconstruct", ("material",)),
         scene_operator=("limber.color_by", "Show Young's Modulus"),
         page="explanation/loaded_branch"),
    Step("pulls", "Pulls", StageView("import-pull"), page="howto/pulls"),
    Step("estimate", "Estimate", StageView("estimate"), page="howto/intervals"),
    Step("plan", "Plan", StageView("plan"),
         fields=("goal", "max_detour", "max_force", "max_strain"),
         hint="Samples the energy first where needed", page="howto/limits"),
    Step("robot", "Robot", StageView("execute"), hint="A dry run comes first and moves nothing",
         page="howto/cell"),
    Step("report", "Report", StageView("report"), page="reference/branch_folder"),
)


def next_step(step: Step) -> Step | None:
    """Return the step after this one."""
    number = STEPS.index(step) + 1
    return STEPS[number] if number < len(STEPS) else None
