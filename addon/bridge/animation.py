"""Motion from files: a PC2 cache on a mesh, and objects along points.

Blender silently shows the rest shape when a cache is missing or belongs to another mesh, so the
file is checked here first.
"""

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
from mathutils import Quaternion, Vector

from .. import compat

_HEADER = struct.Struct("<12siiffi")
_NAME = "Limber motion"
_STEPPED, _STRAIGHT = 0, 1
"""Blender's numbers for interpolation between keys."""
_OURS = "delta_"
"""What the channels begin with that we key: location, rotation and scale are left to the user."""


class CacheError(ValueError):
    """A PC2 file that cannot move the mesh; states what was seen and what to do."""


@dataclass(frozen=True)
class CacheHeader:
    """The header of a PC2 file."""

    vertex_count: int
    frame_count: int


def read_header(path: Path) -> CacheHeader:
    """Return the header of a PC2 file; CacheError if it is missing, truncated or not a PC2 file."""
    try:
        with open(path, "rb") as stream:
            head = stream.read(_HEADER.size)
            size = stream.seek(0, 2)
    except OSError as error:
        raise CacheError(f"{path} cannot be read ({error.strerror}). Open the branch folder at "
                         "its current location.") from error
    if len(head) < _HEADER.size or not head.startswith(b"POINTCACHE2\0"):
        raise CacheError(f"{path} is not a PC2 file. Run the stage that makes it again.")
    _, _, vertex_count, _, _, frame_count = _HEADER.unpack(head)
    if size != _HEADER.size + 12 * vertex_count * frame_count:
        raise CacheError(f"{path} is truncated. Run the stage that makes it again.")
    return CacheHeader(vertex_count, frame_count)


def motion_of(target: bpy.types.Object) -> bpy.types.Modifier | None:
    """Return the modifier that plays a motion of a branch folder, whatever its name; None without.
    """
    return next((modifier for modifier in target.modifiers if modifier.type == "MESH_CACHE"
                 and Path(bpy.path.abspath(modifier.filepath)).parent.name == "frames"), None)


def timing_of(modifier: bpy.types.Modifier) -> tuple[float, float]:
    """Return at which frame of the scene a motion starts, and its frames per frame of the scene."""
    speed = modifier.frame_scale
    return (modifier.frame_start / speed if speed else 1.0), speed


def attach_cache(target: bpy.types.Object, path: Path, frame_start: float = 1.0, *,
                 speed: float = 1.0) -> CacheHeader:
    """Let the PC2 file at ``path`` move ``target``, its first frame at ``frame_start``.

    ``speed`` is the number of frames of the file per frame of the scene: at 2.5 a motion at 60 Hz
    plays in its own time in a scene of 24 frames a second.

    The path is kept relative to the .blend if that is saved, so that both can move together.

    Raises:
        CacheError: the file is truncated, or has another number of vertices.
    """
    header = check_cache(path, len(target.data.vertices))
    modifier = motion_of(target)
    if modifier is None:
        modifier = target.modifiers.new(_NAME, "MESH_CACHE")
        modifier.cache_format, modifier.interpolation = "PC2", "LINEAR"
        # Others of the user, such as a subdivision, follow it: it moves the mesh's own vertices.
        target.modifiers.move(len(target.modifiers) - 1, 0)
    modifier.filepath = shown_path(path)
    modifier.frame_scale = speed
    # Blender subtracts the start after it has scaled the frame.
    modifier.frame_start = speed * frame_start
    return header


def check_cache(path: Path, vertex_count: int) -> CacheHeader:
    """Return the header of a PC2 file; CacheError if it does not move that many vertices."""
    header = read_header(path)
    if header.vertex_count != vertex_count:
        raise CacheError(
            f"{path} moves {header.vertex_count} vertices, but the branch has {vertex_count}. It "
            "belongs to another mesh. Run the stage that makes it again.")
    return header


def cache_trouble(target: bpy.types.Object) -> str:
    """Return why the cache of ``target`` does not play, or an empty text if it does."""
    modifier = motion_of(target)
    if modifier is None:
        return "The branch has no motion yet. Plan a path first."
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
    """Return an absolute ``path`` relative to ``folder`` in Blender's form; others unchanged."""
    if path.startswith("//"):
        return path
    try:
        return bpy.path.relpath(path, start=str(folder))
    except ValueError:
        # Another drive on Windows: there is no relative path.
        return path


def move_along(target: bpy.types.Object, points: np.ndarray, frame_start: float = 1.0, *,
               speed: float = 1.0) -> None:
    """Key the position of ``target`` to ``points`` [m], [frames, 3]; ``speed`` as for the cache.

    It is left where it is at the current frame. Like all keys of ours, of its delta transform.
    """
    _key(target, "delta_location", np.asarray(points, float), frame_start, speed)


def appear(target: bpy.types.Object, seen: np.ndarray, size: float, frame_start: float = 1.0, *,
           speed: float = 1.0) -> None:
    """Key the scale of ``target``: ``size`` where ``seen`` [frames] is true, else zero.

    By its scale, so that hiding it is left to the user.
    """
    sizes = np.where(np.asarray(seen, bool), size, 0.0)
    _key(target, "delta_scale", np.repeat(sizes[:, None], 3, axis=1), frame_start, speed,
         is_stepped=True)


def move_between(target: bpy.types.Object, starts: np.ndarray, ends: np.ndarray,
                 frame_start: float = 1.0, *, speed: float = 1.0) -> None:
    """Key a rod along z about its middle to reach from ``starts`` to ``ends`` [m].

    Both have the shape [frames, 3]; it is rotated by quaternions. Otherwise as :func:`move_along`.
    """
    starts, ends = np.asarray(starts, float), np.asarray(ends, float)
    turns: list[Quaternion] = []
    for way in ends - starts:
        turn = Vector(way).to_track_quat("Z", "Y")
        if turns:
            # Of the two quaternions of a rotation, the nearer one: no spin in between.
            turn.make_compatible(turns[-1])
        turns.append(turn)
    _key(target, "delta_location", (starts + ends) / 2, frame_start, speed)
    _key(target, "delta_rotation_quaternion", np.array(turns, float).reshape(-1, 4), frame_start,
         speed)


def stand_still(target: bpy.types.Object) -> None:
    """Remove the keys of ours; those of the user stay."""
    gone = False
    for curves in compat.curve_lists(target):
        for curve in _ours_in(curves):
            curves.remove(curve)
            gone = True
    if gone and not compat.fcurves_of(target):
        action = target.animation_data.action
        target.animation_data.action = None
        if not action.users:
            bpy.data.actions.remove(action)


def _ours_in(curves: Iterable[bpy.types.FCurve]) -> list[bpy.types.FCurve]:
    return [curve for curve in curves if curve.data_path.startswith(_OURS)]


def shift(target: bpy.types.Object, by: Vector) -> None:
    """Move ``target`` and its keys of ours by a vector [m]."""
    target.delta_location += by
    for curve in _ours_in(compat.fcurves_of(target)):
        if curve.data_path == "delta_location":
            _change_keys(curve, 1, lambda values, axis=curve.array_index: values + by[axis])


def _change_keys(curve: bpy.types.FCurve, column: int, change) -> None:
    """Change the times (0) or values (1) of a curve's keys, with their handles."""
    places = np.empty(2 * len(curve.keyframe_points), np.float32)
    for handle in ("co", "handle_left", "handle_right"):
        curve.keyframe_points.foreach_get(handle, places)
        places[column::2] = change(places[column::2])
        curve.keyframe_points.foreach_set(handle, places)
    curve.update()


def _key(target: bpy.types.Object, channel: str, values: np.ndarray, frame_start: float,
         speed: float, *, is_stepped: bool = False) -> None:
    """Key a channel to rows of ``values``, all at once, and leave it as at the current frame.

    Linear interpolation between keys, as in the cache, or steps.
    """
    if not len(values):
        return
    setattr(target, channel, values[0].tolist())
    # The first key makes the curves, however this Blender stores them.
    target.keyframe_insert(channel, frame=frame_start)
    now, left = bpy.context.scene.frame_current_final, values[0].tolist()
    frames = frame_start + np.arange(len(values)) / speed
    for curve in compat.fcurves_of(target):
        if curve.data_path != channel:
            continue
        points = curve.keyframe_points
        points.add(len(values) - len(points))
        points.foreach_set("co", np.column_stack(
            [frames, values[:, curve.array_index]]).astype(np.float32).ravel())
        points.foreach_set("interpolation", np.full(len(values), _STEPPED if is_stepped else
                                                    _STRAIGHT, np.int32))
        curve.update()
        left[curve.array_index] = curve.evaluate(now)
    setattr(target, channel, left)


def retime(things: Iterable[bpy.types.Object], moved: bpy.types.Object, frame_start: float,
           speed: float) -> None:
    """Change start and speed of the motion of ``moved``, and of everything keyed along with it.

    Args:
        things: Objects keyed by :func:`move_along` and :func:`move_between` with ``moved``.
        moved: The object that the cache moves.
        frame_start: The motion's first frame in the scene.
        speed: Frames of the file per frame of the scene.
    """
    modifier = motion_of(moved)
    # The modifier stores the scaled start.
    start, before = timing_of(modifier)
    modifier.frame_scale, modifier.frame_start = speed, speed * frame_start
    for thing in things:
        for curve in _ours_in(compat.fcurves_of(thing)):
            _change_keys(curve, 0, lambda frames: frame_start + (frames - start) * (before / speed))


def cache_frame(target: bpy.types.Object, frame: float) -> float:
    """Return which frame of its cache, from 0, ``target`` shows at a frame of the scene."""
    modifier = motion_of(target)
    if modifier is None:
        return 0.0
    return modifier.frame_scale * frame - modifier.frame_start
