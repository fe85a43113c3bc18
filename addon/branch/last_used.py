"""Keeps the last used branch: it stays the current one when another object is selected."""

import bpy
from bpy.app.handlers import persistent

from . import branches


@persistent
def _changed(scene: bpy.types.Scene, *_) -> None:
    branches.remember(scene)


def register() -> None:
    bpy.app.handlers.depsgraph_update_post.append(_changed)


def unregister() -> None:
    bpy.app.handlers.depsgraph_update_post.remove(_changed)
