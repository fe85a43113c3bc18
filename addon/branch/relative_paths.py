"""Keeps branch folders and motions relative to the .blend, so that all can move together.

A result opened before the first save has an absolute path, since Blender cannot know better then.
It is made relative when the file is saved. Blender itself keeps relative paths of a modifier
correct, but does not know those of the settings and of a collection's branch. The same holds for
data appended from another file. Blender 4.2 does not report that, and *Find the Folder Again* is
needed.
"""

from pathlib import Path

import bpy

from ..bridge import animation
from .branches import FOLDER_KEY
from .parts import release_copies


def _before_saving(path: str, *_) -> None:
    if not path:
        # The startup file: it has no path of its own.
        return
    release_copies()
    for thing in bpy.data.objects:
        modifier = animation.motion_of(thing)
        if modifier is not None:
            modifier.filepath = animation.relative_path(modifier.filepath, Path(path).parent)
    for holder in (*bpy.data.collections, *bpy.data.objects, *bpy.data.scenes):
        if FOLDER_KEY in holder:
            holder[FOLDER_KEY] = _moved(holder[FOLDER_KEY], Path(path).parent)
    for scene in bpy.data.scenes:
        settings = scene.limber
        settings.reconstruct.cloud = _moved(settings.reconstruct.cloud, Path(path).parent)


def _moved(value: str, folder: Path | None, start: Path | None = None) -> str:
    """Return a path relative to a file in ``folder``, or absolute without a folder.

    Relative ones count from ``start``, by default from the open file's previous folder.
    """
    if not value:
        return value
    path = bpy.path.abspath(value, start=None if start is None else str(start))
    return path if folder is None else animation.relative_path(path, folder)


def _after_import(context: "bpy.types.BlendImportContext", *_) -> None:
    here = Path(bpy.data.filepath).parent if bpy.data.filepath else None
    for item in context.import_items:
        thing, library = item.id, item.source_library
        if thing is None or thing.library is not None or library is None:
            continue
        there = Path(bpy.path.abspath(library.filepath)).parent
        if isinstance(thing, bpy.types.Collection | bpy.types.Object | bpy.types.Scene) and (
                FOLDER_KEY in thing):
            thing[FOLDER_KEY] = _moved(thing[FOLDER_KEY], here, there)
        if isinstance(thing, bpy.types.Scene):
            settings = thing.limber
            settings.reconstruct.cloud = _moved(settings.reconstruct.cloud, here, there)


HANDLERS = (("save_pre", _before_saving), ("blend_import_post", _after_import))
