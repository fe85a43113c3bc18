"""The steps of the work: which stages stand in which panel, and how far each of them is. No bpy.

Everything about a stage itself comes from its schema, also the step that it stands in; here are
the steps.
"""

import enum
from dataclasses import dataclass

from .stages import stages

WAYS = frozenset({"move"})
"""Vectors in metres that say how far, not where: the 3D cursor does not give them."""
REGIONS = ("goal", "tip_goal", "target_box", "workspace_low")
"""Fields of a plan that the active object gives: a ball, or (with what belongs to it) a box."""
PLACES = {"fruit": (0.1,), "cut": ()}
"""Lists of places on the branch, and what stands behind a place: the mass [kg] of a fruit."""

FIRST = {"plan": "energy"}
"""What is run before a stage where the branch lacks it, or has it of an earlier shape."""


class StepState(enum.Enum):
    """How far a stage is, with what the user reads and the icon beside it."""

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
    """One panel: its first stage. ``fields`` of it stand above its button, the rest is folded in.

    ``scene_operator`` stands instead of the stage's button where the step itself runs none.
    """

    name: str
    title: str
    view: StageView
    fields: tuple[str, ...] = ()
    scene_operator: tuple[str, str] = ()
    hint: str = ""

    @property
    def others(self) -> tuple[StageView, ...]:
        """The further stages that stand in this step, as their schemas say."""
        return tuple(StageView(stage.name) for stage in stages().values()
                     if stage.step == self.name and stage.name != self.view.stage)


STEPS = (
    Step("scan", "Scan", StageView("reconstruct", ("input",)), fields=("cloud", "unit"),
         scene_operator=("limber.import_cloud", "Import Scan")),
    Step("skeleton", "Skeleton", StageView("reconstruct", ("shape", "running"))),
    Step("mesh", "Mesh", StageView("reconstruct", ("mesh",)),
         hint="Made together with the skeleton"),
    Step("material", "Material", StageView("reconstruct", ("material",)),
         scene_operator=("limber.color_by", "Show Young's Modulus")),
    Step("pulls", "Pulls", StageView("import-pull")),
    Step("estimate", "Estimate", StageView("estimate")),
    Step("plan", "Plan", StageView("plan"),
         fields=("goal", "max_detour", "max_force", "max_strain"),
         hint="Samples the energy first where needed"),
    Step("robot", "Robot", StageView("execute"), hint="A dry run comes first and moves nothing"),
    Step("report", "Report", StageView("report")),
)


def next_step(step: Step) -> Step | None:
    """Return the step after this one."""
    number = STEPS.index(step) + 1
    return STEPS[number] if number < len(STEPS) else None
