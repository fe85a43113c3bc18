"""The first minutes: open the included example, and a workspace for Limber."""

import shutil
from pathlib import Path
from typing import ClassVar

import bpy

from .. import preferences

EXAMPLE = "bending_branch"
WORKSPACE = "Limber"


def example_folder() -> Path | None:
    """Return the example's folder: in the extension, or beside the add-on in a checkout."""
    here = Path(__file__).parents[1]
    places = (here / "example", here.parent / "blend_files")
    return next((place for place in places if (place / EXAMPLE / "branch.json").is_file()), None)


class LIMBER_OT_open_example(bpy.types.Operator):
    """Copy the included example to a folder of yours and open it: a branch with its pull, estimate,
    energy field and paths"""

    bl_idname = "limber.open_example"
    bl_label = "Open the Example"

    directory: bpy.props.StringProperty(
        name="Folder", subtype="DIR_PATH", options={"SKIP_SAVE"},
        description="Folder of the copy. Empty: the extension's own folder")

    @classmethod
    def poll(cls, context):
        if example_folder() is None:
            cls.poll_message_set("This installation does not include the example")
            return False
        return True

    def execute(self, context):
        source = example_folder()
        try:
            target = Path(bpy.path.abspath(self.directory)) if self.directory else (
                preferences.own_folder("example"))
            branch = target / EXAMPLE
            if not (branch / "branch.json").is_file():
                target.mkdir(parents=True, exist_ok=True)
                shutil.copytree(source / EXAMPLE, branch)
                shutil.copy(source / f"{EXAMPLE}.blend", target)
        except OSError as error:
            self.report({"ERROR"}, f"The example cannot be copied ({error}). Choose another "
                                   "folder.")
            return {"CANCELLED"}
        if preferences.has_worker():
            return bpy.ops.limber.open_result(
                "EXEC_DEFAULT" if bpy.app.background else "INVOKE_DEFAULT", directory=str(branch))
        if bpy.data.is_dirty:
            self.report({"ERROR"}, "Without a worker, the example replaces the open file. Save or "
                                   "close your file first.")
            return {"CANCELLED"}
        bpy.ops.wm.open_mainfile(filepath=str(target / f"{EXAMPLE}.blend"))
        return {"FINISHED"}


class LIMBER_OT_workspace(bpy.types.Operator):
    """Open the workspace Limber, a copy of the current one: its views show the branch's colours and
    the tab Limber"""

    bl_idname = "limber.workspace"
    bl_label = "Limber Workspace"
    bl_options: ClassVar = {"REGISTER"}

    def execute(self, context):
        known = bpy.data.workspaces.get(WORKSPACE)
        window = context.window
        if window is None:
            self.report({"ERROR"}, "There is no window.")
            return {"CANCELLED"}
        if known is not None:
            window.workspace = known
            return {"FINISHED"}
        if bpy.app.background:
            self.report({"ERROR"}, "A workspace can only be added in a window.")
            return {"CANCELLED"}
        bpy.ops.workspace.duplicate()
        # Blender opens the copy when it next draws.
        bpy.app.timers.register(_set_up, first_interval=0.2)
        return {"FINISHED"}


def _set_up() -> None:
    """Name the copy and show the tab in it."""
    window = bpy.context.window_manager.windows[0]
    window.workspace.name = WORKSPACE
    show_tab(window.screen)
    bpy.app.timers.register(_choose_tab, first_interval=0.2)


def _choose_tab() -> None:
    """A sidebar has its tabs only after it has been drawn."""
    for area in bpy.context.window_manager.windows[0].screen.areas:
        if area.type == "VIEW_3D":
            sidebar = next(region for region in area.regions if region.type == "UI")
            try:
                sidebar.active_panel_category = "Limber"
            except TypeError:
                # Not drawn (too narrow): the user opens it.
                continue


def show_tab(screen: bpy.types.Screen) -> None:
    """Set the 3D views of a screen to show vertex colours and their sidebar."""
    for area in screen.areas:
        if area.type == "VIEW_3D":
            area.spaces.active.shading.color_type = "VERTEX"
            area.spaces.active.show_region_ui = True


CLASSES = (LIMBER_OT_open_example, LIMBER_OT_workspace)
