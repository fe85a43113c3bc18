"""One panel per step of the work, drawn from the stages' schema."""

import json
from typing import Any

import bpy

from .. import preferences, properties
from ..bend.replay import draw_pulls
from ..branch import branch_folder, branches
from ..branch.branch_folder import BranchRecord, StageRecord
from ..jobs import jobs, trouble_mark
from ..jobs.plain_words import choice_title, error_texts, warning_text
from ..jobs.presets import sensor_menu
from ..jobs.stages import Field, Stage, stages
from ..jobs.steps import (
    FIRST,
    PLACES,
    REGIONS,
    SCAN_PLACES,
    STEPS,
    WAYS,
    StageView,
    Step,
    StepState,
)
from ..jobs.steps import next_step as step_after
from ..plan.robot import draw_robot
from ..skeleton.panel_parts import draw_skeleton
from . import guide
from .comparing import draw_moduli, draw_paths
from .lines import draw_text, has_room_beside
from .results import draw_results
from .sidebar import SidebarPanel

_FIRST_ORDER = 3
_GRAPHS = {"estimate": "young", "plan": "energy"}
"""Graph that shows a stage's result."""


class StepPanel(SidebarPanel):
    """Mix-in: the panel of ``step``."""

    step: Step

    @classmethod
    def poll(cls, context):
        return cls.step.name != "robot" or not preferences.lacks_robot()

    def draw_header(self, context):
        """Show its number, among the steps that are shown."""
        shown = [step for step in STEPS if step.name != "robot" or not preferences.lacks_robot()]
        self.layout.label(text=str(shown.index(self.step) + 1))

    def draw_header_preset(self, context):
        """Show its state and the way to its help, at the right end of the header."""
        self.layout.label(text="", icon=step_state(context.scene, self.step).icon)
        guide.draw(self.layout, self.step.page)

    def draw(self, context):
        layout, step = self.layout, self.step
        layout.use_property_split = True
        layout.use_property_decorate = False
        view = step.view
        if len(branches.branches(context.scene)) > 1:
            draw_text(layout, context, f"Branch: {branches.current_name(context.scene)}",
                      "OUTLINER")
        if step.hint:
            draw_text(layout, context, step.hint, "INFO")
        _draw_fields(layout, context, view, names=step.fields)
        if step.name == "plan":
            layout.operator("limber.place_goal", icon="SPHERE")
        elif step.name == "material":
            _draw_origin(layout, context)
            layout.operator_menu_enum("limber.material", "material", text="Known Materials")
        if step.scene_operator:
            _draw_scene_button(layout, context, step)
            if step.name == "scan":
                layout.operator("limber.crop_scan", icon="CUBE")
                layout.menu(sensor_menu("reconstruct"), text="Known Sensors")
        else:
            _draw_stage(layout, context, view, is_primary=True)
        if step.name == "skeleton":
            draw_skeleton(layout, context)
        if step.name == "pulls":
            layout.menu(sensor_menu("import-pull"), text="Known Sensors")
            draw_pulls(layout, context)
        if step.name == "robot":
            draw_robot(layout, context)
        if step.name == "report":
            layout.operator("limber.open_report", icon="URL")
        _draw_groups(layout, context, view, but=step.fields)
        for other in step.others:
            if stages()[other.stage].moves_robot and preferences.lacks_robot():
                continue
            header, body = layout.panel(f"limber_{step.name}_{other.stage}", default_closed=True)
            header.label(text=stages()[other.stage].label,
                         icon=state_of(context.scene, other.stage)[0].icon)
            if body is not None:
                _draw_stage(body, context, other, is_primary=False)
                _draw_groups(body, context, other)
        if step.name == "plan" and preferences.lacks_robot():
            draw_text(layout, context, "Moving a robot, and recording, need a Python that has "
                      "Limber and ur-rtde: choose it in the extension's preferences", "INFO")
        after = step_after(step)
        if after is not None and after.name == "robot" and preferences.lacks_robot():
            after = step_after(after)
        if after is not None and step_state(context.scene, step) is StepState.DONE:
            layout.label(text=f"Next: {after.title}", icon="FORWARD")


def state_of(scene: bpy.types.Scene, name: str) -> tuple[StepState, StageRecord | None]:
    """Return the state of a stage for the branch of ``scene``, and its entry in the folder."""
    stage = stages()[name]
    folder = branches.current_folder(scene)
    record = None if folder is None else branch_folder.read_record(folder)
    group = properties.group_of(scene, stage)
    values = properties.values_of(group, stage, {"name"})
    entry = record.of(stage, values) if record else None
    job = jobs.current()
    if job is not None and job.state is jobs.JobState.RUNNING and job.title == stage.label:
        return StepState.RUNNING, entry
    if any(job.title == stage.label for job in jobs.waiting()):
        return StepState.WAITING, entry
    outcome = properties.outcome_of(scene, stage, str(folder))
    if outcome.get("status") == "failed":
        return StepState.FAILED, entry
    if entry is None:
        # A stage without an entry (a prediction) is done if it ended well.
        return (StepState.DONE if outcome.get("status") == "done"
                and not stage.keeps_entry(values) else StepState.NOT_RUN), None
    return _age(stage, group, record, entry), entry


def step_state(scene: bpy.types.Scene, step: Step) -> StepState:
    """Return the state of a step, or of another stage with the same result if that was run.
    """
    state, _ = state_of(scene, step.view.stage)
    made = set(stages()[step.view.stage].writes)
    for other in step.others:
        if state is StepState.NOT_RUN and made & set(stages()[other.stage].writes):
            state, _ = state_of(scene, other.stage)
    is_done = state is StepState.DONE and step.view.stage == "plan"
    return StepState.OVER_STRENGTH if is_done and stress_share(scene) > 1.0 else state


def next_stage(scene: bpy.types.Scene) -> Stage | None:
    """Return the first stage not yet run for the branch and the settings as they are, whose inputs
    exist or are set; for a scan without a branch, the one that makes it. None if there is none,
    while a job works in the folder, and after one that failed: its panel says what to do.
    """
    folder = branches.current_folder(scene)
    record = None if folder is None else branch_folder.read_record(folder)
    if folder is not None and jobs.works_in(str(folder)):
        return None
    if record is None or not record.has(["mesh.vtu"]):
        first = stages()[STEPS[0].view.stage]
        is_due = properties.group_of(scene, first).cloud and (
            state_of(scene, first.name)[0] is StepState.NOT_RUN)
        return first if is_due else None
    for step in STEPS:
        stage = stages()[step.view.stage]
        if step.scene_operator or stage.moves_robot or stage.makes_branch:
            continue
        values = properties.values_of(properties.group_of(scene, stage), stage)
        needs = [name for name in stage.reads
                 if name not in stages()[FIRST.get(stage.name, stage.name)].writes]
        is_ready = record.has(needs) and all(
            values[field.name] for field in stage.own_fields if field.is_required)
        state = step_state(scene, step) if is_ready else StepState.DONE
        if state is StepState.FAILED:
            return None
        if state in (StepState.NOT_RUN, StepState.STALE, StepState.CHANGED):
            return stage
    return None


def draw_next(layout: bpy.types.UILayout, scene: bpy.types.Scene) -> bool:
    """Draw the button of the next stage; returns whether there is one."""
    following = next_stage(scene)
    if following is not None:
        layout.operator(f"limber.{properties.attribute_name(following.name)}", icon="FORWARD",
                        text=f"Next: {following.label}").branch_uuid = branches.current_uuid(scene)
    return following is not None


def stress_share(scene: bpy.types.Scene) -> float:
    """Return the largest stress over the strength of the visible plan; 0 if unknown."""
    surface = branches.find_surface(scene)
    info = {} if surface is None else branches.info_of(surface)
    scale = info.get("scalars", {}).get("stress_over_strength")
    is_shown = info.get("plan") == scene.limber.plan.name and bool(scale)
    return float(scale["high"]) if is_shown else 0.0


def _age(stage: Stage, group: bpy.types.PropertyGroup, record: BranchRecord,
         entry: StageRecord) -> StepState:
    if record.is_stale(stage, entry):
        return StepState.STALE
    return StepState.CHANGED if properties.differs(group, stage, entry.settings) else (
        StepState.DONE)


def _draw_stage(layout: bpy.types.UILayout, context: bpy.types.Context, view: StageView, *,
                is_primary: bool) -> None:
    """Draw the required fields, the button, the state, and the result."""
    stage = stages()[view.stage]
    required = [field.name for field in stage.own_fields if field.is_required]
    if view.stage != "reconstruct":
        # Its scan is the first step's.
        _draw_fields(layout, context, view, names=required)
    state, entry = state_of(context.scene, view.stage)
    row = layout.row()
    row.scale_y = 1.4 if is_primary else 1.0
    button = row.operator(f"limber.{properties.attribute_name(view.stage)}", text=stage.label,
                          icon="PLAY" if is_primary else "NONE")
    button.branch_uuid = branches.current_uuid(context.scene)
    if view.stage == "plan" and state is StepState.DONE and stress_share(context.scene) > 1.0:
        state = StepState.OVER_STRENGTH
    if state is not StepState.NOT_RUN:
        draw_text(layout, context, state.words[0].upper() + state.words[1:], state.icon)
    folder = branches.current_folder(context.scene)
    outcome = properties.outcome_of(context.scene, stage, str(folder))
    if outcome.get("error"):
        draw_error(layout, context, stage, outcome)
    result = outcome.get("result", {}) if entry is None else entry.result
    # Those of the folder stay: in a new file, and after an undo. A failed run has its own.
    told = [] if entry is None else entry.result.get("warnings", [])
    if entry is None or outcome.get("status") == "failed":
        told = [*told, *outcome.get("warnings", [])]
    for warning in dict.fromkeys(told):
        draw_text(layout, context, warning_text(outcome, warning, stage), "INFO")
    if view.stage == "plan":
        draw_paths(layout, context, result, branch_folder.read_record(folder) if folder else None,
                   stress_share(context.scene))
    elif view.stage == "estimate":
        draw_moduli(layout, context, result)
    if is_primary and view.stage in _GRAPHS and result:
        layout.operator("limber.graph", icon="GRAPH").graph = _GRAPHS[view.stage]
    draw_results(layout, context, view.stage, result)


def _draw_scene_button(layout: bpy.types.UILayout, context: bpy.types.Context, step: Step) -> None:
    row = layout.row()
    row.scale_y = 1.4
    idname, label = step.scene_operator
    operator = row.operator(idname, text=label, icon="PLAY")
    if step.name == "scan":
        operator.filepath = context.scene.limber.reconstruct.cloud
    elif step.name == "material":
        operator.scalar = "young"


def _draw_origin(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """State whether Young's modulus was measured: an assumed one has the same colours."""
    is_estimated = state_of(context.scene, "estimate")[1] is not None
    layout.label(text="Young: estimated from pulls" if is_estimated else
                 "Young: assumed, not measured",
                 icon="CHECKMARK" if is_estimated else "QUESTION")


def _draw_groups(layout: bpy.types.UILayout, context: bpy.types.Context, view: StageView,
                 but: tuple[str, ...] = ()) -> None:
    stage = stages()[view.stage]
    for title, fields in stage.groups().items():
        shown = [field for field in fields if not field.is_required
                 and (context.scene.limber.show_expert or not field.is_expert)
                 and field.name not in but]
        if not shown or (view.groups is not None and title not in view.groups):
            continue
        header, body = layout.panel(f"limber_{view.stage}_{title}", default_closed=True)
        header.label(text=title.capitalize())
        if body is not None:
            for field in shown:
                _draw_field(body, context, stage, field)


def _draw_fields(layout: bpy.types.UILayout, context: bpy.types.Context, view: StageView,
                 names) -> None:
    stage = stages()[view.stage]
    for name in names:
        _draw_field(layout, context, stage, stage.fields[name])


def _draw_field(layout: bpy.types.UILayout, context: bpy.types.Context, stage: Stage,
                field: Field) -> None:
    group = properties.group_of(context.scene, stage)
    has_place = (field.name in SCAN_PLACES if stage.name == "reconstruct" else
                 "branch_folder" in stage.fields and (field.name in PLACES or (
                     field.kind == "vector" and field.length == 3 and field.unit == "m"
                     and field.name not in WAYS)))
    has_region = stage.name == "plan" and field.name in REGIONS
    heading = field.label
    value = getattr(group, field.name) if field.kind in ("list", "rows") else ""
    if field.kind != "boolean" and not has_room_beside(context, heading, value):
        # Blender would cut one of them: the title stands above the field.
        layout = layout.column(align=True)
        draw_text(layout, context, heading)
        heading = ""
    if not (field.is_optional and properties.has_switch(field)) and not has_place:
        layout.prop(group, field.name, **({} if heading else {"text": ""}))
        return
    row = layout.row(heading=heading)
    inner = row
    if field.is_optional:
        row.prop(group, properties.OPEN + field.name, text="")
        inner = row.row()
        inner.active = getattr(group, properties.OPEN + field.name)
    inner.prop(group, field.name, text="")
    if field.word:
        row.prop(group, properties.word_property(field), text=field.word.capitalize(), toggle=True)
    if has_place:
        operator = row.operator("limber.from_cursor", text="", icon="CURSOR")
        operator.stage, operator.field = stage.name, field.name
    if has_region:
        row.operator("limber.from_object", text="", icon="OBJECT_DATA").region = field.name


def draw_error(layout: bpy.types.UILayout, context: bpy.types.Context, stage: Stage,
               outcome: dict[str, Any]) -> None:
    """Draw what was seen, what would help, and why and what to do on demand."""
    texts = error_texts(outcome, stage)
    draw_text(layout, context, texts[0], "ERROR")
    if trouble_mark.of(context.scene, stage) is not None:
        layout.label(text="The place is marked in the view", icon="EMPTY_AXIS")
    for name in dict.fromkeys(each["command"] for each in outcome.get("remedies") or []):
        other = stages().get(name)
        # One that makes a branch replaces it; one that moves a robot has its own panel.
        if other is not None and other.step and not (other.makes_branch or other.moves_robot):
            button = layout.operator(f"limber.{properties.attribute_name(other.name)}",
                                     text=other.label, icon="PLAY")
            button.branch_uuid = branches.current_uuid(context.scene)
    for remedy in outcome.get("remedies") or []:
        field = None if remedy["command"] else stage.fields.get(remedy["option"])
        if field is not None and remedy["value"] is not None:
            button = layout.operator("limber.take_choice", icon="FILE_REFRESH",
                                     text=choice_title(field, remedy["value"]))
            button.stage, button.option = stage.name, field.name
            button.value = json.dumps(remedy["value"])
            button.branch_uuid = branches.current_uuid(context.scene)
        elif field in stage.own_fields and field.kind != "boolean":
            _draw_field(layout, context, stage, field)
    if len(texts) > 1:
        header, body = layout.panel(f"limber_error_{stage.name}", default_closed=True)
        header.label(text="Why, and what to do")
        if body is not None:
            draw_text(body, context, " ".join(texts))


CLASSES = tuple(
    type(f"LIMBER_PT_{step.name}", (StepPanel, bpy.types.Panel), {
        "bl_idname": f"LIMBER_PT_{step.name}", "bl_label": step.title,
        "bl_order": _FIRST_ORDER + number, "step": step, "__module__": __name__,
        "bl_options": set() if step.name in ("scan", "skeleton") else {"DEFAULT_CLOSED"}})
    for number, step in enumerate(STEPS))
