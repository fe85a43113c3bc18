"""Import a scan, to look at it."""

import hashlib
from pathlib import Path

import bpy

from .. import clouds
from ..bridge import meshes
from ..scene import SCAN_KEY, add_object
from .viewing import look_at

_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}


class LIMBER_OT_import_cloud(bpy.types.Operator):
    """Show a point cloud (PLY, XYZ, TXT, CSV) in the scene"""

    bl_idname = "limber.import_cloud"
    bl_label = "Import Scan"

    filepath: bpy.props.StringProperty(subtype="FILE_PATH", options={"SKIP_SAVE"})
    filter_glob: bpy.props.StringProperty(default="*.ply;*.xyz;*.txt;*.csv", options={"HIDDEN"})

    def invoke(self, context, event):
        self.filepath = self.filepath or context.scene.limber.cloud_path
        if not self.filepath:
            context.window_manager.fileselect_add(self)
            return {"RUNNING_MODAL"}
        return self.execute(context)

    def execute(self, context):
        settings = context.scene.limber
        path = Path(bpy.path.abspath(self.filepath or settings.cloud_path))
        try:
            points = clouds.read_points(path)
            mesh = meshes.new_mesh(path.stem, points)
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        cloud = add_object(context.scene.collection, f"{path.stem} scan", mesh)
        cloud[SCAN_KEY] = hashlib.sha256(path.read_bytes()).hexdigest()
        cloud.scale = [_METRES[settings.cloud_unit]] * 3
        settings.cloud_path = str(path)
        if not settings.branch_folder:
            settings.branch_folder = str(path.with_suffix(".branch"))
        look_at(context, cloud)
        self.report({"INFO"}, f"{len(points)} points")
        return {"FINISHED"}


def register() -> None:
    bpy.utils.register_class(LIMBER_OT_import_cloud)


def unregister() -> None:
    bpy.utils.unregister_class(LIMBER_OT_import_cloud)
