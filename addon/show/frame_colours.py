"""Colours that change with the frame: the values of the current frame on the branch."""

from pathlib import Path

import bpy

from ..branch.branches import FOLDER_KEY, FRAME_SCALAR_KEY, branch_of, info_of, token_of
from ..bridge import animation, materials, meshes
from . import frame_values
from .frame_values import FrameValues
from .scene_data import SceneData

_NOW = "now"
"""Attribute of the values of the visible frame, and of its colours with ``_color``."""
_kept: dict[Path, FrameValues | None] = {}


def keep(data: SceneData) -> str:
    """Keep the values of an opened motion; return why they could not be written to its folder."""
    frames = data.info.get("frames")
    if not frames:
        return ""
    path = frame_values.path_of(data.folder, frames["name"])
    _kept[path] = frame_values.values_of(data)
    try:
        frame_values.keep(data.folder, frames["name"], _kept[path])
    except OSError as error:
        return (f"{data.folder} is not writable ({error.strerror}). The colours of each frame "
                "will be lost when this file is closed.")
    return ""


def changing(surface: bpy.types.Object) -> set[str]:
    """Return the names of the values that exist for each frame of the branch's motion."""
    values = _values_of(surface)
    frames = info_of(surface).get("frames") or {}
    return set() if values is None else (
        values.names(frames.get("count", 0), len(surface.data.vertices))
        & set(info_of(surface).get("frame_scalars") or ()))


def show(surface: bpy.types.Object, name: str, frame: float, *, is_asked: bool = True) -> None:
    """Colour ``surface`` by a value that changes; KeyError if no value has that name.

    A material of the user is replaced if this ``is_asked`` for.
    """
    if name not in changing(surface):
        raise KeyError(name)
    scale = info_of(surface)["frame_scalars"][name]
    surface[FRAME_SCALAR_KEY] = name
    materials.wear(surface, materials.scalar_material(
        f"{surface.name} {scale['title'].partition(' (')[0]}, each frame", _NOW, low=scale["low"],
        high=scale["high"], log=scale["log"], stops=scale["stops"],
        owner=f"{token_of(surface)} {name}"), is_asked=is_asked)
    _write(surface, frame)


def shown_scale(surface: bpy.types.Object) -> dict | None:
    """Return the scale of the value that changes with the frames, None if none is shown."""
    name = surface.get(FRAME_SCALAR_KEY)
    return None if name is None else (info_of(surface).get("frame_scalars") or {}).get(name)


def _write(surface: bpy.types.Object, frame: float) -> None:
    """Write values and colours of the frame of the cache that is nearest to ``frame``."""
    name, values = surface[FRAME_SCALAR_KEY], _values_of(surface)
    if values is None or name not in changing(surface):
        # The folder no longer exists, or has another motion: the last colours stay.
        return
    last = len(values.scalars[name]) - 1
    number = min(max(round(animation.cache_frame(surface, frame)), 0), last)
    palette = info_of(surface)["frame_scalars"][name]["colours"]
    meshes.set_values(surface.data, _NOW, values.scalars[name][number])
    meshes.set_values(surface.data, f"{_NOW}_color", values.colours(name, palette, number),
                      "FLOAT_COLOR")


def _values_of(surface: bpy.types.Object) -> FrameValues | None:
    frames = info_of(surface).get("frames")
    collection = branch_of(surface)
    if not frames or collection is None:
        return None
    folder = Path(bpy.path.abspath(collection[FOLDER_KEY])).resolve()
    path = frame_values.path_of(folder, frames["name"])
    if path not in _kept:
        _kept[path] = frame_values.read(folder, frames["name"])
    return _kept[path]


def _frame_changed(current: bpy.types.Scene, *_) -> None:
    for thing in current.objects:
        if FRAME_SCALAR_KEY in thing and thing.type == "MESH":
            _write(thing, current.frame_current_final)


def _forget(*_) -> None:
    """Another file may have another folder at the same path, or the cache has changed."""
    _kept.clear()


HANDLERS = (("frame_change_pre", _frame_changed), ("load_post", _forget))
unregister = _kept.clear
