"""Points of a scan that the user deleted in the view: they are left out of the branch."""

import hashlib
from pathlib import Path

import bmesh
import bpy
import numpy as np

from .. import preferences
from ..branch import branch_folder, branches
from ..bridge import meshes
from . import clouds

_NUMBER = "limber_point"
_COUNT_KEY = "limber_point_count"
_PLY = ("ply\nformat binary_little_endian 1.0\nelement vertex {count}\nproperty double x\n"
        "property double y\nproperty double z\nend_header\n")


def number_points(scan: bpy.types.Object) -> None:
    """Store in an imported scan which of the file's points each vertex is."""
    count = len(scan.data.vertices)
    meshes.set_values(scan.data, _NUMBER, np.arange(count), "INT")
    scan[_COUNT_KEY] = count


def write(scene: bpy.types.Scene, source: Path) -> Path | None:
    """Write the deleted points of a scan, in the file's coordinates; None if none was deleted.

    Raises:
        ValueError: the file cannot be read, or all points were deleted.
    """
    checksum = branch_folder.file_sha256(source)
    scan = next((thing for thing in scene.objects
                 if thing.get(branches.SCAN_KEY) == checksum and _COUNT_KEY in thing), None)
    if scan is None:
        return None
    is_gone = np.ones(scan[_COUNT_KEY], bool)
    is_gone[_left(scan)] = False
    if not is_gone.any():
        return None
    if is_gone.all():
        raise ValueError("All points of the scan were deleted. Undo that, or import it again.")
    # From the file: the view has single precision, and map coordinates are larger.
    points = np.ascontiguousarray(clouds.read_points(source)[0][is_gone], "<f8")
    content = _PLY.format(count=len(points)).encode() + points.tobytes()
    path = _folder() / f"{source.stem}-deleted-{hashlib.sha256(content).hexdigest()[:16]}.ply"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return path


def _left(scan: bpy.types.Object) -> np.ndarray:
    """Return the numbers of the points that a scan still has."""
    if scan.mode == "EDIT":
        # The mesh itself has no attributes meanwhile.
        shape = bmesh.from_edit_mesh(scan.data)
        layer = shape.verts.layers.int.get(_NUMBER)
        return np.array([vertex[layer] for vertex in shape.verts], np.int32)
    return meshes.values_of(scan.data, _NUMBER)


def is_ours(path: str) -> bool:
    """Whether a file was written by :func:`write`."""
    return bool(path) and Path(bpy.path.abspath(path)).parent == _folder()


def _folder() -> Path:
    return preferences.own_folder("deleted_points")
