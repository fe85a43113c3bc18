"""Keeps the motion's files relative to the .blend, so that both can move together.

A result opened before the first save has an absolute path: Blender cannot know better then. It is
made relative when the file is saved; what is relative already, Blender itself keeps right.
"""

from pathlib import Path

import bpy
from bpy.app.handlers import persistent

from .bridge import animation


@persistent
def _before_saving(path: str, *_) -> None:
    if not path:
        # The startup file: it has no place of its own.
        return
    for thing in bpy.data.objects:
        modifier = thing.modifiers.get(animation.MODIFIER)
        if modifier is not None:
            modifier.filepath = animation.relative_path(modifier.filepath, Path(path).parent)


def register() -> None:
    bpy.app.handlers.save_pre.append(_before_saving)


def unregister() -> None:
    bpy.app.handlers.save_pre.remove(_before_saving)
