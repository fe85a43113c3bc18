"""The guide's pages: those in the extension, or in a checkout the texts that they are made of."""

from pathlib import Path

import bpy

_PAGES = {"start": "tutorials/blender", "job": "howto/troubleshooting",
          "result": "tutorials/blender", "play": "tutorials/blender"}
"""Page of each panel that is no step; those of the steps are in :mod:`steps`."""


def page_path(page: str) -> Path | None:
    """Return the file of a page such as ``howto/scan``; None if this installation has none."""
    here = Path(__file__).parents[1]
    places = (here / "guide" / f"{page}.html", here.parent / "worker" / "docs" / f"{page}.md")
    return next((path for path in places if path.is_file()), None)


def draw(layout: bpy.types.UILayout, page: str) -> None:
    """Draw the button that opens a page: in a header, by the name of its panel or of the page."""
    layout.operator("limber.help", text="", icon="HELP", emboss=False).page = _PAGES.get(page, page)


class LIMBER_OT_help(bpy.types.Operator):
    """Open the guide's page on this in the browser"""

    bl_idname = "limber.help"
    bl_label = "Help"

    page: bpy.props.StringProperty(name="Page", default="index")

    def execute(self, context):
        path = page_path(self.page)
        if path is None:
            self.report({"ERROR"}, f"This installation does not include the guide's page "
                                   f"{self.page}. Build the extension with the project's Python.")
            return {"CANCELLED"}
        if not bpy.app.background:
            bpy.ops.wm.url_open(url=path.resolve().as_uri())
        return {"FINISHED"}


CLASSES = (LIMBER_OT_help,)
