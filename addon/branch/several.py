"""Several branches in a scene: the current one, their positions, and their folders."""

from pathlib import Path
from typing import ClassVar

import bpy
from mathutils import Vector

from ..bridge import animation
from . import branch_folder, branches
from .needs_result import NeedsBranch

_GAP = 0.25
"""Gap between branches side by side, in widths of the widest."""
_MOST_LOOKED_AT = 2000


class LIMBER_OT_choose_branch(NeedsBranch, bpy.types.Operator):
    """Show this branch in the panels"""

    bl_idname = "limber.choose_branch"
    bl_label = "Choose Branch"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    branch: bpy.props.StringProperty(name="Branch", description="Name of its collection")

    def execute(self, context):
        found = next((each for each in branches.branches(context.scene)
                      if each.name == self.branch), None)
        if found is None or branches.surface_of(found) is None:
            self.report({"ERROR"}, f"There is no branch {self.branch!r}.")
            return {"CANCELLED"}
        branches.choose(context.scene, found)
        return {"FINISHED"}


class LIMBER_OT_side_by_side(NeedsBranch, bpy.types.Operator):
    """Put the branches of the scene side by side, or back where they were scanned"""

    bl_idname = "limber.side_by_side"
    bl_label = "Side by Side"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    back: bpy.props.BoolProperty(name="In Place", options={"SKIP_SAVE"},
                                 description="Put each branch where it was scanned")

    def execute(self, context):
        shown = [branch for branch in branches.branches(context.scene)
                 if branches.surface_of(branch) is not None]
        spans = [_span(branches.surface_of(branch)) for branch in shown]
        gap = _GAP * max(high - low for low, high in spans)
        # The first stays; each of the others begins where the one before it ends.
        end = spans[0][1]
        for number, (branch, (low, high)) in enumerate(zip(shown, spans, strict=True)):
            place = 0.0
            if number and not self.back:
                place = end + gap - low
                end = place + high
            by = Vector((place, 0.0, 0.0)) - branches.surface_of(branch).delta_location
            for thing in branches.parts_of(branch).values():
                animation.shift(thing, by)
        return {"FINISHED"}


def _span(surface: bpy.types.Object) -> tuple[float, float]:
    """Return the range of a branch along x as scanned [m]."""
    along = [corner[0] for corner in surface.bound_box]
    return min(along), max(along)


class LIMBER_OT_relink(NeedsBranch, bpy.types.Operator):
    """Find the moved or renamed folder of the branch: beside this file, otherwise in a folder that
    you choose"""

    bl_idname = "limber.relink"
    bl_label = "Find the Folder Again"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    directory: bpy.props.StringProperty(subtype="DIR_PATH", options={"SKIP_SAVE"})

    def invoke(self, context, event):
        if not self.directory and not bpy.app.background and (
                _beside_file(self._branch(context)) is None):
            context.window_manager.fileselect_add(self)
            return {"RUNNING_MODAL"}
        return self.execute(context)

    def execute(self, context):
        branch = self._branch(context)
        folder = Path(bpy.path.abspath(self.directory)) if self.directory else _beside_file(branch)
        if folder is None:
            self.report({"ERROR"}, f"There is no folder of {branch.name} beside this file. Choose "
                                   "its folder.")
            return {"CANCELLED"}
        record = branch_folder.read_record(folder)
        if record is None or not _is_of(branch, record):
            what = "not a branch folder" if record is None else (
                f"the folder of another branch, {record.name}")
            self.report({"ERROR"}, f"{folder} is {what}. Choose the folder of {branch.name}.")
            return {"CANCELLED"}
        _set_folder(branch, folder)
        branches.use_folder(context.scene, branch[branches.FOLDER_KEY])
        surface = branches.surface_of(branch)
        trouble = animation.cache_trouble(surface)
        if animation.motion_of(surface) is not None and trouble:
            self.report({"WARNING"}, trouble)
        self.report({"INFO"}, f"{branch.name}: {folder}")
        return {"FINISHED"}

    def _branch(self, context) -> bpy.types.Collection:
        return branches.branch_of(branches.find_surface(context.scene))


def is_lost(branch: bpy.types.Collection) -> bool:
    """Whether the folder of a branch is no longer at its path."""
    folder = Path(bpy.path.abspath(branch[branches.FOLDER_KEY]))
    return branch_folder.read_record(folder) is None


def _set_folder(branch: bpy.types.Collection, folder: Path) -> None:
    """Set another folder for a branch and its motion."""
    branch[branches.FOLDER_KEY] = animation.shown_path(folder)
    for thing in branches.parts_of(branch).values():
        modifier = animation.motion_of(thing)
        if modifier is not None:
            frames = Path(bpy.path.abspath(modifier.filepath)).name
            modifier.filepath = animation.shown_path(folder / "frames" / frames)


def _is_of(branch: bpy.types.Collection, record: branch_folder.BranchRecord) -> bool:
    if branches.UUID_KEY in branch:
        return branch[branches.UUID_KEY] == record.uuid
    # From a file made before branches had a number of their own.
    return branch[branches.NAME_KEY] == record.name


def _beside_file(branch: bpy.types.Collection) -> Path | None:
    """Return the branch's folder if it is in the folder of the .blend, or in a subfolder."""
    if not bpy.data.filepath:
        return None
    home = Path(bpy.data.filepath).parent
    looked = 0
    for pattern in (f"*/{branch_folder.MANIFEST}", f"*/*/{branch_folder.MANIFEST}"):
        for path in home.glob(pattern):
            looked += 1
            record = branch_folder.read_record(path.parent)
            if record is not None and _is_of(branch, record):
                return path.parent
            if looked > _MOST_LOOKED_AT:
                return None
    return None


CLASSES = (LIMBER_OT_choose_branch, LIMBER_OT_side_by_side, LIMBER_OT_relink)
