"""Open a page of the guide."""

import bpy

from .. import guide


class LIMBER_OT_help(bpy.types.Operator):
    """Open the guide's page on this in the browser"""

    bl_idname = "limber.help"
    bl_label = "Help"

    page: bpy.props.StringProperty(name="Page", default="index")

    def execute(self, context):
        path = guide.page_path(self.page)
        if path is None:
            self.report({"ERROR"}, f"This installation does not include the guide's page "
                                   f"{self.page}. Build the extension with the project's Python.")
            return {"CANCELLED"}
        if not bpy.app.background:
            bpy.ops.wm.url_open(url=path.resolve().as_uri())
        return {"FINISHED"}


CLASSES = (LIMBER_OT_help,)
