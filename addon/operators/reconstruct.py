"""Reconstruct a branch from its scan, by the worker."""

from pathlib import Path

import bpy

from .worker_operator import WorkerOperator


class LIMBER_OT_reconstruct(WorkerOperator, bpy.types.Operator):
    """Turn the scan into a skeleton, a surface and tetrahedra; runs beside the interface"""

    bl_idname = "limber.reconstruct"
    bl_label = "Reconstruct"
    title = "Reconstructing"

    def arguments(self, context):
        settings = context.scene.limber
        cloud = Path(bpy.path.abspath(settings.cloud_path)) if settings.cloud_path else None
        if cloud is None or not cloud.is_file():
            raise ValueError("Choose a scan first: a file with the points of one branch.")
        if not settings.branch_folder:
            settings.branch_folder = str(cloud.with_suffix(".branch"))
        return ["reconstruct", str(cloud), "-o", bpy.path.abspath(settings.branch_folder),
                "--unit", settings.cloud_unit]

    def finish(self, context, result):
        self.report({"INFO"}, f"{result['tet_count']} tetrahedra in {result['seconds']:.0f} s")
        if not bpy.app.background:
            bpy.ops.limber.open_result("INVOKE_DEFAULT")


def register() -> None:
    bpy.utils.register_class(LIMBER_OT_reconstruct)


def unregister() -> None:
    bpy.utils.unregister_class(LIMBER_OT_reconstruct)
