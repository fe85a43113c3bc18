"""The steps of the work: which stages stand in which panel, and how far each of them is. No bpy.

Everything about a stage itself comes from its schema; here is only where the user meets it.
"""

import enum
from dataclasses import dataclass

FROM_SCENE = frozenset({"branch_folder", "output", "data", "render"})
"""Inputs that the add-on gives itself: no panel asks for them."""
SHOWN_FILES = {"export": frozenset({"output"}), "skeleton": frozenset({"output"})}
"""Of those, what a stage does ask for: a file that is for other programs."""
NOT_FROM_HERE = {"execute": frozenset({"arm", "confirm", "after_stop"}),
                 "record": frozenset({"confirm", "after_stop"}), "simulate": frozenset({"pull"})}
"""What no panel keeps: that a robot may move is typed each time, a pull has a button of its own."""
DRY_RUNS = frozenset({"execute"})
"""Stages of which the add-on's button runs a part that the branch folder keeps no result of."""
MOVES_ROBOT = frozenset({"record"})
"""Stages whose button asks for a name to be typed first."""
WAYS = frozenset({"move"})
"""Vectors in metres that say how far, not where: the 3D cursor does not give them."""
REGIONS = ("goal", "tip_goal", "target_box", "workspace_low")
"""Fields of a plan that the active object gives: a ball, or (with what belongs to it) a box."""
PLACES = {"fruit": (0.1,), "cut": ()}
"""Lists of places on the branch, and what stands behind a place: the mass [kg] of a fruit."""


class StepState(enum.Enum):
    """How far a stage is, with what the user reads and the icon beside it."""

    NOT_RUN = ("not run yet", "RADIOBUT_OFF")
    RUNNING = ("running", "SORTTIME")
    WAITING = ("waiting for its turn", "TIME")
    DONE = ("done", "CHECKMARK")
    STALE = ("out of date: what it read has changed", "FILE_REFRESH")
    CHANGED = ("out of date: its settings have changed", "FILE_REFRESH")
    FAILED = ("failed", "ERROR")

    @property
    def words(self) -> str:
        return self.value[0]

    @property
    def icon(self) -> str:
        return self.value[1]


@dataclass(frozen=True)
class StageView:
    """A stage in a step: the label of its button, and the groups of settings shown with it."""

    stage: str
    label: str
    groups: tuple[str, ...] | None = None
    """None: all."""


@dataclass(frozen=True)
class Step:
    """One panel: its stage, the groups of others that belong to it, and further stages.

    ``scene_operator`` stands instead of the stage's button where the step itself runs none.
    """

    name: str
    title: str
    view: StageView
    others: tuple[StageView, ...] = ()
    settings_of: tuple[StageView, ...] = ()
    scene_operator: tuple[str, str] = ()
    hint: str = ""


STEPS = (
    Step("scan", "Scan", StageView("reconstruct", "", ("input",)),
         scene_operator=("limber.import_cloud", "Import Scan")),
    Step("skeleton", "Skeleton", StageView("reconstruct", "Reconstruct", ("shape", "running")),
         others=(StageView("skeleton", "Review and Edit"),)),
    Step("mesh", "Mesh", StageView("reconstruct", "Reconstruct", ("mesh",)),
         others=(StageView("mesh", "Mesh a Closed Surface"),),
         hint="Made together with the skeleton"),
    Step("material", "Material", StageView("reconstruct", "", ("material",)),
         others=(StageView("simulate", "Simulate a Motion"),
                 StageView("load", "Wind, Snow, Fruit, Cuts")),
         scene_operator=("limber.color_by", "Show Young's Modulus")),
    Step("pulls", "Pulls", StageView("import-pull", "Import Pull"),
         others=(StageView("virtual-pull", "Simulate a Pull"),
                 StageView("record", "Record a Pull"),
                 StageView("export-pull", "Export a Pull"))),
    Step("estimate", "Estimate", StageView("estimate", "Estimate"),
         others=(StageView("swing", "Fit a Free Swing"),
                StageView("vibration", "Fit Natural Frequencies"),
                StageView("predict", "Predict Another Load"),
                StageView("suggest-pull", "Suggest the Next Pull"))),
    Step("goal", "Goal", StageView("energy", "Sample the Energy"),
         settings_of=(StageView("plan", "", ("start and goal",)),),
         others=(StageView("target", "Name a Target"),)),
    Step("plan", "Plan", StageView("plan", "Plan Path", (
        "output", "weights and limits", "timing", "solver", "running"))),
    Step("robot", "Robot", StageView("execute", "Check With Robot"),
         hint="A dry run first: nothing moves"),
    Step("report", "Report", StageView("report", "Write Report"),
         others=(StageView("export", "Export for Other Programs"),)),
)

RUN = tuple(dict.fromkeys(view.stage for step in STEPS for view in (step.view, *step.others)))
"""The stages that the add-on can run."""
NOT_RUN_HERE = {
    "generate": "it makes scans, no branch",
    "scene": "`limber.open_result` draws what it says"}
"""The others, and why."""


def hidden_fields(stage: str) -> frozenset[str]:
    """Return the fields of a stage that no panel asks for."""
    return (FROM_SCENE - SHOWN_FILES.get(stage, frozenset())) | NOT_FROM_HERE.get(
        stage, frozenset())


def button_of(stage: str) -> str:
    """Return what the button of a stage says: also the title of its job."""
    return next(view.label for step in STEPS for view in (step.view, *step.others)
                if view.stage == stage and view.label)


def next_step(step: Step) -> Step | None:
    """Return the step after this one."""
    number = STEPS.index(step) + 1
    return STEPS[number] if number < len(STEPS) else None
