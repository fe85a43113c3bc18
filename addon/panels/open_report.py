"""Open the report in the browser."""

import bpy

from ..branch import branches


class LIMBER_OT_open_report(bpy.types.Operator):
    """Open the branch's report in the browser"""

    bl_idname = "limber.open_report"
    bl_label = "Open Report"

    def execute(self, context):
        folder = branches.current_folder(context.scene)
        if folder is None or not (folder / "report.html").is_file():
            self.report({"ERROR"}, "There is no report yet. Write it first.")
            return {"CANCELLED"}
        page = (folder / "report.html").resolve()
        if not bpy.app.background:
            bpy.ops.wm.url_open(url=page.as_uri())
        return {"FINISHED"}


CLASSES = (LIMBER_OT_open_report,)
