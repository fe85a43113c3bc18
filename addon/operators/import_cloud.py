"""Import a scan, to look at it: from the tab, from File > Import, or dropped into a view."""

from pathlib import Path

import bpy
import numpy as np

from .. import branch_folder, clouds
from ..bridge import meshes
from ..scene import OFFSET_KEY, SCAN_KEY, add_object
from .viewing import look_at

_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
_KINDS = (".ply", ".xyz", ".txt", ".csv")


class LIMBER_OT_import_cloud(bpy.types.Operator):
    """Show a point cloud (PLY, XYZ, TXT, CSV) in the scene"""

    bl_idname = "limber.import_cloud"
    bl_label = "Import Scan"

    filepath: bpy.props.StringProperty(subtype="FILE_PATH", options={"SKIP_SAVE"})
    filter_glob: bpy.props.StringProperty(default=";".join(f"*{kind}" for kind in _KINDS),
                                          options={"HIDDEN"})

    def invoke(self, context, event):
        if not self.filepath:
            context.window_manager.fileselect_add(self)
            return {"RUNNING_MODAL"}
        return self.execute(context)

    def execute(self, context):
        settings = context.scene.limber
        path = Path(bpy.path.abspath(self.filepath or settings.reconstruct.cloud))
        try:
            points = clouds.read_points(path)
            offset = _offset(points)
            mesh = meshes.new_mesh(path.stem, points - offset)
            folder = self._folder(context, path)
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        cloud = add_object(context.scene.collection, f"{path.stem} scan", mesh)
        cloud[SCAN_KEY] = branch_folder.file_sha256(path)
        if offset.any():
            cloud[OFFSET_KEY] = [float(value) for value in offset]
        cloud.scale = [_METRES[settings.reconstruct.unit]] * 3
        settings.reconstruct.cloud = str(path)
        settings.branch_folder = str(folder)
        look_at(context, cloud)
        self.report({"INFO"}, f"{len(points)} points")
        return {"FINISHED"}

    def _folder(self, context, path: Path) -> Path:
        """Return the branch folder of the scan: the one that is set if it is its own."""
        chosen = context.scene.limber.branch_folder
        if chosen and branch_folder.is_of(Path(bpy.path.abspath(chosen)),
                                          branch_folder.file_sha256(path)):
            return Path(chosen)
        return branch_folder.folder_for(path)


def _offset(points: np.ndarray) -> np.ndarray:
    """Return what to take off the points [n, 3]: map coordinates would lose their last digits.

    A viewport has single precision. Whole numbers, so that nothing is lost by taking them off.
    """
    middle = np.round((points.min(axis=0) + points.max(axis=0)) / 2)
    extent = np.ptp(points, axis=0).max()
    return middle if np.abs(middle).max() > 100 * max(extent, 1e-9) else np.zeros(3)


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


def register() -> None:
    bpy.utils.register_class(LIMBER_OT_import_cloud)
    bpy.utils.register_class(LIMBER_FH_cloud)
    bpy.types.TOPBAR_MT_file_import.append(_draw_menu)


def unregister() -> None:
    bpy.types.TOPBAR_MT_file_import.remove(_draw_menu)
    bpy.utils.unregister_class(LIMBER_FH_cloud)
    bpy.utils.unregister_class(LIMBER_OT_import_cloud)
