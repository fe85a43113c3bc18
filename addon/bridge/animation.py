"""Motion from files: a PC2 cache on a mesh, and objects along points.

Blender shows the rest shape without a word when a cache is missing or belongs to another mesh,
so the file is looked at here first.
"""

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
from mathutils import Vector

from .. import compat

_HEADER = struct.Struct("<12siiffi")
MODIFIER = "Limber motion"


class CacheError(ValueError):
    """A PC2 file that cannot move the mesh; says what was seen and what to do."""


@dataclass(frozen=True)
class CacheHeader:
    """What the head of a PC2 file says."""

    vertex_count: int
    frame_count: int


def read_header(path: Path) -> CacheHeader:
    """Return the header of a PC2 file; CacheError if it is missing, cut short or none at all."""
    try:
        with open(path, "rb") as stream:
            head = stream.read(_HEADER.size)
            size = stream.seek(0, 2)
    except OSError as error:
        raise CacheError(f"{path} cannot be read ({error.strerror}). "
                         "Open the branch folder again where it is now.") from error
    if len(head) < _HEADER.size or not head.startswith(b"POINTCACHE2\0"):
        raise CacheError(f"{path} is not a PC2 file. Run the stage that makes it again.")
    _, _, vertex_count, _, _, frame_count = _HEADER.unpack(head)
    if size != _HEADER.size + 12 * vertex_count * frame_count:
        raise CacheError(f"{path} is cut short. Run the stage that makes it again.")
    return CacheHeader(vertex_count, frame_count)


def attach_cache(target: bpy.types.Object, path: Path, frame_start: int = 1, *,
                 speed: float = 1.0) -> CacheHeader:
    """Let the PC2 file at ``path`` move ``target``, its first frame at ``frame_start``.

    ``speed`` is how many frames of the file a frame of the scene goes on: at 2.5 a motion at 60 Hz
    plays in its own time in a scene of 24 frames a second.

    The path is kept relative to the .blend where that is saved, so that both can move together.

    Raises:
        CacheError: the file is not whole, or has another number of vertices.
    """
    header = read_header(path)
    if header.vertex_count != len(target.data.vertices):
        raise CacheError(
            f"{path} moves {header.vertex_count} vertices; {target.name} has "
            f"{len(target.data.vertices)}. It belongs to another mesh: open the result again.")
    modifier = target.modifiers.get(MODIFIER) or target.modifiers.new(MODIFIER, "MESH_CACHE")
    modifier.cache_format = "PC2"
    modifier.filepath = shown_path(path)
    modifier.frame_scale = speed
    # Blender takes the start off after it has scaled the frame.
    modifier.frame_start = speed * frame_start
    modifier.interpolation = "LINEAR"
    return header


def cache_trouble(target: bpy.types.Object) -> str:
    """Return why the cache of ``target`` does not play, or nothing if it does."""
    modifier = target.modifiers.get(MODIFIER)
    if modifier is None:
        return "It has no motion yet: plan a path first."
    path = Path(bpy.path.abspath(modifier.filepath))
    try:
        header = read_header(path)
    except CacheError as error:
        return str(error)
    if header.vertex_count != len(target.data.vertices):
        return f"{path} belongs to another mesh. Open the result again."
    return ""


def shown_path(path: Path) -> str:
    """Return ``path`` as Blender keeps it: relative to a saved .blend, absolute otherwise."""
    path = Path(path).resolve()
    return relative_path(str(path), Path(bpy.data.filepath).parent) if bpy.data.filepath else (
        str(path))


def relative_path(path: str, folder: Path) -> str:
    """Return an absolute ``path`` as Blender's relative one from ``folder``; others as they are."""
    if path.startswith("//"):
        return path
    try:
        return bpy.path.relpath(path, start=str(folder))
    except ValueError:
        # Another drive on Windows: there is no relative path.
        return path


def move_along(target: bpy.types.Object, points: np.ndarray, frame_start: int = 1, *,
               speed: float = 1.0) -> None:
    """Key the place of ``target`` to ``points`` [m], shape [frames, 3]; ``speed`` as for the cache.

    It is left at its first place, where it stands at ``frame_start``.
    """
    points = np.asarray(points, float)
    for number, point in enumerate(points):
        target.location = point
        target.keyframe_insert("location", frame=frame_start + number / speed)
    if len(points):
        target.location = points[0]


def move_between(target: bpy.types.Object, starts: np.ndarray, ends: np.ndarray,
                 frame_start: int = 1, *, speed: float = 1.0) -> None:
    """Key a rod that lies along z about its middle to reach from ``starts`` to ``ends`` [m].

    Both have the shape [frames, 3]; otherwise as :func:`move_along`.
    """
    target.rotation_mode = "QUATERNION"
    before = None
    poses = []
    for start, end in zip(np.asarray(starts, float), np.asarray(ends, float), strict=True):
        turn = Vector(end - start).to_track_quat("Z", "Y")
        if before is not None:
            # Of the two quaternions of a rotation the one on this side: no spin in between.
            turn.make_compatible(before)
        before = turn
        poses.append((Vector((start + end) / 2), turn))
    for number, (place, turn) in enumerate(poses):
        target.location, target.rotation_quaternion = place, turn
        for channel in ("location", "rotation_quaternion"):
            target.keyframe_insert(channel, frame=frame_start + number / speed)
    if poses:
        target.location, target.rotation_quaternion = poses[0]


def retime(things: Iterable[bpy.types.Object], moved: bpy.types.Object, frame_start: float,
           speed: float) -> None:
    """Let the motion of ``moved``, and what is keyed along with it, start and run otherwise.

    Args:
        things: What was keyed by :func:`move_along` and :func:`move_between` with ``moved``.
        moved: What the cache moves.
        frame_start: The motion's first frame in the scene.
        speed: Frames of the file a frame of the scene.
    """
    modifier = moved.modifiers[MODIFIER]
    # The modifier has the start scaled.
    before, start = modifier.frame_scale, modifier.frame_start / modifier.frame_scale
    modifier.frame_scale, modifier.frame_start = speed, speed * frame_start
    for thing in things:
        for curve in compat.fcurves_of(thing):
            places = np.empty(2 * len(curve.keyframe_points), np.float32)
            for handle in ("co", "handle_left", "handle_right"):
                curve.keyframe_points.foreach_get(handle, places)
                places[::2] = frame_start + (places[::2] - start) * (before / speed)
                curve.keyframe_points.foreach_set(handle, places)
            curve.update()


def cache_frame(target: bpy.types.Object, frame: float) -> float:
    """Return which frame of its cache, from 0, ``target`` shows at a frame of the scene."""
    modifier = target.modifiers.get(MODIFIER)
    if modifier is None:
        return 0.0
    return modifier.frame_scale * frame - modifier.frame_start
