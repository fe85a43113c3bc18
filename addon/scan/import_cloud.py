"""Import a scan for viewing: from the tab, from File > Import, or dropped into a view."""

from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path

import bpy

from ..branch import branch_folder, branches
from ..branch.branches import FOLDER_KEY, OFFSET_KEY, SCAN_KEY, add_object
from ..bridge import meshes
from ..jobs.stages import longest_m
from . import deleted_points, scans
from .cloud_overlay import COLOUR
from .viewing import clear_view, look_at, push_undo

_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "um": 1e-6}
_INTERVAL_SECONDS = 0.05
_KINDS = (".ply", ".xyz", ".txt", ".csv", ".tsv", ".asc", ".pts", ".xyzrgb")


class LIMBER_OT_import_cloud(bpy.types.Operator):
    """Show a point cloud (PLY, XYZ, TXT, CSV, TSV, ASC, PTS, XYZRGB) in the scene"""

    bl_idname = "limber.import_cloud"
    bl_label = "Import Scan"

    filepath: bpy.props.StringProperty(subtype="FILE_PATH", options={"SKIP_SAVE"})
    filter_glob: bpy.props.StringProperty(default=";".join(f"*{kind}" for kind in _KINDS),
                                          options={"HIDDEN"})

    _reading: Future[scans.Scan] | None = None
    _timer = None
    _is_from_user = False

    def invoke(self, context, event):
        self._is_from_user = not bpy.app.background and context.window is not None
        if not self.filepath:
            context.window_manager.fileselect_add(self)
            return {"RUNNING_MODAL"}
        return self.execute(context)

    def execute(self, context):
        if not self.filepath:
            self.report({"ERROR"}, "No file was chosen. Choose a scan (PLY, XYZ, CSV ...).")
            return {"CANCELLED"}
        path = self._path()
        if not self._is_from_user:
            return self._show(context, lambda: scans.read_scan(path))
        # The interface stays usable while the points are read.
        self._reading = scans.reading(path)
        manager = context.window_manager
        self._timer = manager.event_timer_add(_INTERVAL_SECONDS, window=context.window)
        manager.modal_handler_add(self)
        context.workspace.status_text_set(f"Reading {path.name} ...")
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        if event.type != "TIMER" or not self._reading.done():
            return {"PASS_THROUGH"}
        self.cancel(context)
        return self._show(context, self._reading.result)

    def cancel(self, context):
        """Blender closes or loads another file: the points being read are not shown."""
        if self._timer is not None:
            context.window_manager.event_timer_remove(self._timer)
            self._timer = None
            context.workspace.status_text_set(None)

    def _path(self) -> Path:
        return Path(bpy.path.abspath(self.filepath))

    def _show(self, context, read: Callable[[], scans.Scan]):
        settings, path = context.scene.limber, self._path()
        try:
            scan = read()
            mesh = meshes.new_mesh(path.stem, scan.points)
            if scan.colours is not None:
                meshes.set_values(mesh, COLOUR, scan.colours, "BYTE_COLOR")
        except (ValueError, OSError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        cloud = add_object(context.scene.collection, f"{path.stem} scan", mesh)
        cloud[SCAN_KEY] = scan.sha256
        deleted_points.number_points(cloud)
        if scan.offset.any():
            cloud[OFFSET_KEY] = [float(value) for value in scan.offset]
        guessed = scan.extent > longest_m() and scan.unit is None and (
            not settings.reconstruct.is_property_set("unit"))
        if scan.unit in _METRES:
            settings.reconstruct.unit = scan.unit
        elif guessed:
            settings.reconstruct.unit = "mm"
        cloud.scale = [_METRES[settings.reconstruct.unit]] * 3
        settings.reconstruct.cloud = str(path)
        chosen = branches.current_folder(context.scene)
        cloud[FOLDER_KEY] = branches.current_path(context.scene) if (
            chosen is not None and branch_folder.is_of(chosen, scan.sha256)) else str(scan.folder)
        branches.use_folder(context.scene, cloud[FOLDER_KEY])
        settings.show_scan = True
        hidden = clear_view(context.scene)
        look_at(context, cloud)
        push_undo(context)
        unit = settings.reconstruct.unit
        size = f"{scan.extent:.4g} {unit} across"
        if guessed:
            self.report({"WARNING"}, f"{size}, if its unit is millimetres, as was assumed. Is it? "
                                     "If not, set Unit and import the scan again.")
        told = [f"{len(scan.points)} points, {size}", *([hidden] if hidden else [])]
        self.report({"INFO"}, "; ".join(told))
        return {"FINISHED"}


class LIMBER_FH_cloud(bpy.types.FileHandler):
    """Scans may be dropped into a 3D view."""

    bl_idname = "LIMBER_FH_cloud"
    bl_label = "Limber scan"
    bl_import_operator = "limber.import_cloud"
    bl_file_extensions = ";".join(_KINDS)

    @classmethod
    def poll_drop(cls, context):
        return context.area is not None and context.area.type == "VIEW_3D"


def _draw_menu(menu: bpy.types.Menu, _context) -> None:
    menu.layout.operator("limber.import_cloud", text="Plant Scan for Limber (.ply, .xyz)")


CLASSES = (LIMBER_OT_import_cloud, LIMBER_FH_cloud)


def register() -> None:
    bpy.types.TOPBAR_MT_file_import.append(_draw_menu)


def unregister() -> None:
    bpy.types.TOPBAR_MT_file_import.remove(_draw_menu)
