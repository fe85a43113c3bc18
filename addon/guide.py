"""The guide's pages: those in the extension, or in a checkout the texts that they are made of."""

from pathlib import Path

import bpy

_PAGES = {"start": "tutorials/blender", "job": "howto/troubleshooting",
          "result": "tutorials/blender", "play": "tutorials/blender"}
"""Page of each panel that is no step; those of the steps are in :mod:`steps`."""


def page_path(page: str) -> Path | None:
    """Return the file of a page such as ``howto/scan``; None if this installation has none."""
    here = Path(__file__).parent
    places = (here / "guide" / f"{page}.html", here.parent / "worker" / "docs" / f"{page}.md")
    return next((path for path in places if path.is_file()), None)


def draw(layout: bpy.types.UILayout, page: str) -> None:
    """Draw the button that opens a page: in a header, by the name of its panel or of the page."""
    layout.operator("limber.help", text="", icon="HELP", emboss=False).page = _PAGES.get(page, page)
