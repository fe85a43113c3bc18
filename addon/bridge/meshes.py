"""Meshes and their named attributes, to and from arrays."""

import hashlib

import bmesh
import bpy
import numpy as np
from mathutils.kdtree import KDTree

GIVEN_KEY = "limber_given"
"""Key of a mesh of ours: a digest of its faces, and of each attribute that was given to it."""
_FACES = "faces"
_VALUES = {"FLOAT": ("value", np.float32, 1), "INT": ("value", np.int32, 1),
           "FLOAT_VECTOR": ("vector", np.float32, 3), "FLOAT_COLOR": ("color", np.float32, 4),
           "BYTE_COLOR": ("color_srgb", np.float32, 4)}
"""Property, type and length of an attribute's values, by its type."""


def new_mesh(name: str, vertices: np.ndarray, faces: np.ndarray | None = None) -> bpy.types.Mesh:
    """Make a mesh of triangles, or of points alone.

    Args:
        name: Name of the data block.
        vertices: Positions [m], shape [v, 3].
        faces: Vertex indices, shape [f, 3].

    Raises:
        ValueError: wrong shapes, values that are not finite, or indices out of range.
    """
    vertices = _checked(vertices, 3, "vertices")
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(len(vertices))
    set_positions(mesh, vertices)
    if faces is not None and len(faces):
        _add_faces(mesh, np.asarray(faces), len(vertices))
    mesh.update(calc_edges=True)
    return mesh


def new_lines(name: str, vertices: np.ndarray, edges: np.ndarray) -> bpy.types.Mesh:
    """Make a mesh of lines between ``vertices`` [m], shape [v, 3]; ``edges`` [e, 2] are indices.

    Raises:
        ValueError: wrong shapes, values that are not finite, or indices out of range.
    """
    edges = np.asarray(edges).reshape(-1, 2)
    if len(edges) and (edges.min() < 0 or edges.max() >= len(vertices)):
        raise ValueError(f"edges have indices outside the {len(vertices)} vertices")
    mesh = new_mesh(name, vertices)
    mesh.edges.add(len(edges))
    mesh.edges.foreach_set("vertices", np.ascontiguousarray(edges, np.int32).ravel())
    mesh.update()
    return mesh


def _add_faces(mesh: bpy.types.Mesh, faces: np.ndarray, vertex_count: int) -> None:
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.min() < 0 or faces.max() >= vertex_count:
        raise ValueError(f"faces of shape {faces.shape} have a wrong shape or indices outside the "
                         f"{vertex_count} vertices")
    mesh.loops.add(faces.size)
    mesh.loops.foreach_set("vertex_index", np.ascontiguousarray(faces, np.int32).ravel())
    mesh.polygons.add(len(faces))
    mesh.polygons.foreach_set("loop_start", np.arange(0, faces.size, 3, dtype=np.int32))
    mesh.polygons.foreach_set("use_smooth", np.ones(len(faces), bool))


def set_positions(mesh: bpy.types.Mesh, vertices: np.ndarray) -> None:
    """Write all vertex positions [m], shape [v, 3]; the attribute is 50 times as fast as co."""
    set_values(mesh, "position", vertices, "FLOAT_VECTOR")


def positions(mesh: bpy.types.Mesh) -> np.ndarray:
    """Return all vertex positions [m], float32, shape [v, 3]."""
    return values_of(mesh, "position") if len(mesh.vertices) else np.empty((0, 3), np.float32)


def faces(mesh: bpy.types.Mesh) -> np.ndarray:
    """Return the triangles of a mesh made of triangles, shape [f, 3]."""
    values = np.empty(len(mesh.loops), np.int32)
    mesh.loops.foreach_get("vertex_index", values)
    return values.reshape(-1, 3)


def set_values(mesh: bpy.types.Mesh, name: str, values: np.ndarray, kind: str = "FLOAT") -> None:
    """Write attribute ``name``: a number in its real unit per vertex, shape [v], or a row, [v, k].

    Solid mode then shows it if it is a FLOAT_COLOR, which is linear; a BYTE_COLOR is sRGB.
    """
    part, number, length = _VALUES[kind]
    values = _checked(values, None if length == 1 else length, name)
    _attribute(mesh, name, kind, len(values)).data.foreach_set(
        part, np.ascontiguousarray(values, number).ravel())
    if kind == "FLOAT_COLOR":
        mesh.color_attributes.active_color = mesh.color_attributes[name]
    mesh.update_tag()


def values_of(mesh: bpy.types.Mesh, name: str) -> np.ndarray:
    """Return attribute ``name``, shape [v] or [v, k]; KeyError if there is none."""
    attribute = mesh.attributes[name]
    part, number, length = _VALUES[attribute.data_type]
    values = np.empty(length * len(attribute.data), number)
    attribute.data.foreach_get(part, values)
    return values if length == 1 else values.reshape(-1, length)


def shrink(mesh: bpy.types.Mesh, depth: float) -> None:
    """Move all vertices inward by ``depth`` [m], against their normals."""
    normals = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertex_normals.foreach_get("vector", normals)
    set_positions(mesh, positions(mesh) - depth * normals.reshape(-1, 3))


def set_one_color(mesh: bpy.types.Mesh, color: tuple[float, float, float],
                  attribute: str = "color") -> None:
    """Give all vertices one linear colour: Solid mode then shows it beside coloured surfaces."""
    set_values(mesh, attribute, np.tile((*color, 1.0), (len(mesh.vertices), 1)), "FLOAT_COLOR")


def is_given(mesh: bpy.types.ID) -> bool:
    """Whether data of an object is a mesh of ours."""
    return isinstance(mesh, bpy.types.Mesh) and GIVEN_KEY in mesh


def note_given(mesh: bpy.types.Mesh) -> None:
    """Note that a mesh just made is one of ours."""
    mesh[GIVEN_KEY] = _digests(mesh)


def give(mesh: bpy.types.Mesh, new: bpy.types.Mesh, *, is_edited_kept: bool = False) -> None:
    """Give a mesh of ours what a mesh just made has, where that is not what it was given last.

    What the user has added or painted stays where the faces are the same.

    Args:
        mesh: The mesh to change.
        new: A mesh just made; it stays.
        is_edited_kept: Whether vertices that the user has removed or added are kept too.
    """
    before, now = mesh[GIVEN_KEY].to_dict(), _digests(new)
    active = mesh.color_attributes.active_color_name
    if is_edited_kept and before == now:
        return
    if before[_FACES] != now[_FACES] or not has_same_faces(mesh, new):
        replace(mesh, new)
    else:
        for name in before.keys() - now.keys():
            if name in mesh.attributes:
                mesh.attributes.remove(mesh.attributes[name])
        for name in now.keys() - {_FACES}:
            if before.get(name) != now[name] or name not in mesh.attributes:
                set_values(mesh, name, values_of(new, name), new.attributes[name].data_type)
        mesh.update()
    mesh[GIVEN_KEY] = now
    colours = [name for name in (active, new.color_attributes.active_color_name)
               if name in mesh.color_attributes]
    if colours:
        mesh.color_attributes.active_color_name = colours[0]


def replace(mesh: bpy.types.Mesh, new: bpy.types.Mesh) -> None:
    """Replace vertices, faces and attributes of a mesh by those of another."""
    builder = bmesh.new()
    try:
        builder.from_mesh(new)
        builder.to_mesh(mesh)
    finally:
        builder.free()
    for key in new.keys():
        # Blender writes an array into a longer one that is there, whose end stays.
        mesh.pop(key, None)
        mesh[key] = new[key]
    mesh.update()


class Weights:
    """The vertex groups of an object, to be given to its next mesh."""

    def __init__(self, thing: bpy.types.Object):
        self._weights = [[(one.group, one.weight) for one in vertex.groups]
                         for vertex in thing.data.vertices]
        self._tree = KDTree(len(self._weights))
        for number, place in enumerate(positions(thing.data)):
            self._tree.insert(place, number)
        self._tree.balance()

    def put_back(self, thing: bpy.types.Object) -> None:
        """Give each vertex the weights of the one that was nearest to it."""
        for number, place in enumerate(positions(thing.data)):
            _, nearest, _ = self._tree.find(place)
            for group, weight in self._weights[nearest]:
                thing.vertex_groups[group].add([number], weight, "REPLACE")


def has_same_faces(mesh: bpy.types.Mesh, other: bpy.types.Mesh) -> bool:
    """Whether two meshes have the same vertices, edges and faces, apart from their positions."""
    return _faces_digest(mesh) == _faces_digest(other)


def _faces_digest(mesh: bpy.types.Mesh) -> str:
    """Return a digest of how the vertices of a mesh are joined."""
    found = hashlib.sha256(str(len(mesh.vertices)).encode())
    for parts, name, length in ((mesh.edges, "vertices", 2), (mesh.loops, "vertex_index", 1),
                                (mesh.polygons, "loop_total", 1)):
        values = np.empty(length * len(parts), np.int32)
        parts.foreach_get(name, values)
        found.update(values.tobytes())
    return found.hexdigest()


def _digests(mesh: bpy.types.Mesh) -> dict[str, str]:
    found = {attribute.name: hashlib.sha256(values_of(mesh, attribute.name).tobytes()).hexdigest()
             for attribute in mesh.attributes
             if attribute.domain == "POINT" and attribute.data_type in _VALUES}
    return found | {_FACES: _faces_digest(mesh)}


def new_sphere(name: str, radius: float) -> bpy.types.Mesh:
    """Make a smooth sphere of ``radius`` [m] about the origin."""
    return _primitive(name, lambda mesh: bmesh.ops.create_uvsphere(
        mesh, u_segments=32, v_segments=16, radius=radius))


def new_half_ball(name: str, radius: float) -> bpy.types.Mesh:
    """Make the upper half of a sphere of ``radius`` [m] about the origin, open below."""
    def make(builder: bmesh.types.BMesh) -> None:
        bmesh.ops.create_uvsphere(builder, u_segments=24, v_segments=12, radius=radius)
        below = [vertex for vertex in builder.verts if vertex.co.z < -1e-6 * radius]
        bmesh.ops.delete(builder, geom=below, context="VERTS")
    return _primitive(name, make)


def new_cylinder(name: str, radius: float, height: float) -> bpy.types.Mesh:
    """Make a cylinder of ``radius`` and ``height`` [m] about the origin, along z."""
    return _primitive(name, lambda mesh: bmesh.ops.create_cone(
        mesh, cap_ends=True, segments=64, radius1=radius, radius2=radius, depth=height))


def new_capsule(name: str, radius: float, length: float) -> bpy.types.Mesh:
    """Make a rod with round ends along z, ``length`` [m] between the centres of its two ends.

    The ends are hemispheres of ``radius`` [m], so that rods that meet at any angle join smoothly.
    """
    def make(builder: bmesh.types.BMesh) -> None:
        bmesh.ops.create_uvsphere(builder, u_segments=48, v_segments=24, radius=radius)
        for vertex in builder.verts:
            # The ring about the middle moves to the upper end: the faces below it form the rod.
            vertex.co.z += length / 2 if vertex.co.z > -1e-6 * radius else -length / 2
    return _primitive(name, make)


def new_rectangle(name: str, width: float, height: float) -> bpy.types.Mesh:
    """Make a rectangle in the xy plane, its lower left corner at the origin [m].

    FLOAT attribute ``height`` runs from 0 at the bottom to 1 at the top.
    """
    corners = np.array([[0, 0, 0], [width, 0, 0], [width, height, 0], [0, height, 0]], float)
    mesh = new_mesh(name, corners, np.array([[0, 1, 2], [0, 2, 3]]))
    set_values(mesh, "height", np.array([0.0, 0.0, 1.0, 1.0]))
    return mesh


def _primitive(name, make) -> bpy.types.Mesh:
    builder = bmesh.new()
    try:
        make(builder)
        mesh = bpy.data.meshes.new(name)
        builder.to_mesh(mesh)
    finally:
        builder.free()
    for polygon in mesh.polygons:
        polygon.use_smooth = len(polygon.vertices) == 4 or len(mesh.polygons) > 100
    return mesh


def _attribute(mesh: bpy.types.Mesh, name: str, kind: str, count: int):
    if count != len(mesh.vertices):
        raise ValueError(f"{name}: {count} values for {len(mesh.vertices)} vertices")
    attribute = mesh.attributes.get(name)
    if attribute is not None and (attribute.data_type, attribute.domain) != (kind, "POINT"):
        mesh.attributes.remove(attribute)
        attribute = None
    return attribute or mesh.attributes.new(name, kind, "POINT")


def _checked(values: np.ndarray, columns: int | None, name: str) -> np.ndarray:
    values = np.asarray(values)
    wanted = values.ndim == 1 if columns is None else values.ndim == 2
    if not wanted or (columns is not None and values.shape[1] != columns):
        raise ValueError(f"{name} has shape {values.shape}")
    if not np.isfinite(values).all():
        raise ValueError(f"{name} contains values that are not finite")
    return values
