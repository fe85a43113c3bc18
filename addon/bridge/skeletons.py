"""The skeleton as a mesh of editable nodes, to and from arrays.

The user's marks are attributes of the vertices, not properties of the object, because undo in Edit
Mode restores only the mesh.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import bmesh
import bpy
import numpy as np

from ..skeleton.skeleton_edits import Mark, Nodes, Skeleton, SkeletonEditError, edits_of
from . import meshes

NODES_KEY = "limber_skeleton_m"
"""Property of the mesh: positions [m] as the worker gave them, three numbers per node."""
_RADIUS_KEY, _PARENT_KEY, _FLAGS_KEY = (
    "limber_skeleton_radius_m", "limber_skeleton_parent", "limber_skeleton_flags")
# Booleans too: bmesh has no layers of them before Blender 5.0.
_INTEGERS = ("node", "mark", "mark_target", "mark_turn", "root", "flags")


def new_skeleton(name: str, skeleton: Skeleton, flags: np.ndarray) -> bpy.types.Mesh:
    """Make a mesh with one vertex per node and an edge to its parent.

    Attributes of the vertices: ``node`` (its number), ``radius`` [m], ``root`` (1 there), ``flags``
    of the worker, and the marks of :class:`~..skeleton_edits.Nodes`.
    """
    hung = np.flatnonzero(skeleton.parent >= 0)
    edges = np.column_stack([skeleton.parent[hung], hung])
    mesh = meshes.new_lines(name, skeleton.nodes, edges)
    count = len(skeleton.nodes)
    meshes.set_values(mesh, "radius", skeleton.radius)
    for attribute in _INTEGERS:
        meshes.set_values(mesh, attribute, np.zeros(count, int), "INT")
    meshes.set_values(mesh, "node", np.arange(count), "INT")
    meshes.set_values(mesh, "flags", flags, "INT")
    meshes.set_values(mesh, "root", (skeleton.parent < 0).astype(int), "INT")
    mesh[NODES_KEY] = skeleton.nodes.astype(float).ravel().tolist()
    mesh[_RADIUS_KEY] = skeleton.radius.astype(float).tolist()
    mesh[_PARENT_KEY] = skeleton.parent.tolist()
    mesh[_FLAGS_KEY] = flags.tolist()
    return mesh


def as_given(mesh: bpy.types.Mesh) -> Skeleton:
    """Return the skeleton as the worker gave it."""
    return Skeleton(np.array(mesh[NODES_KEY], float).reshape(-1, 3),
                    np.array(mesh[_RADIUS_KEY], float), np.array(mesh[_PARENT_KEY], int))


def flags_of(mesh: bpy.types.Mesh) -> np.ndarray:
    """Return the worker's flags of its nodes, shape [n]."""
    return np.array(mesh[_FLAGS_KEY], int)


def is_skeleton(thing: bpy.types.Object) -> bool:
    """Whether an object still has the mesh of a skeleton."""
    return thing.type == "MESH" and NODES_KEY in thing.data


def is_of(mesh: bpy.types.Mesh, skeleton: Skeleton) -> bool:
    """Whether the mesh was made of this skeleton."""
    given = as_given(mesh)
    return all(np.array_equal(one, other) for one, other in (
        (given.nodes, skeleton.nodes), (given.radius, skeleton.radius),
        (given.parent, skeleton.parent)))


def is_edited(thing: bpy.types.Object) -> bool:
    """Whether the nodes differ from those that the worker gave."""
    try:
        return bool(edits_of(as_given(thing.data), nodes_of(thing)))
    except SkeletonEditError:
        return True


def put_back(mesh: bpy.types.Mesh) -> None:
    """Reset a mesh to the skeleton as the worker gave it."""
    fresh = new_skeleton(mesh.name, as_given(mesh), flags_of(mesh))
    meshes.replace(mesh, fresh)
    bpy.data.meshes.remove(fresh)


def nodes_of(thing: bpy.types.Object) -> Nodes:
    """Return the present nodes, in Edit Mode too."""
    with nodes_edited(thing, is_changed=False) as builder:
        layer = {name: builder.verts.layers.int[name] for name in _INTEGERS}
        radius = builder.verts.layers.float["radius"]
        found = [(vertex.co[:], vertex[radius], [vertex[layer[name]] for name in _INTEGERS])
                 for vertex in builder.verts]
        edges = [[vertex.index for vertex in edge.verts] for edge in builder.edges]
    numbers = np.array([entry[2] for entry in found], int).reshape(-1, len(_INTEGERS))
    return Nodes(
        numbers[:, 0], np.array([entry[0] for entry in found], np.float32).reshape(-1, 3),
        np.array([entry[1] for entry in found], np.float32),
        numbers[:, 4] > 0, numbers[:, 1], numbers[:, 2], numbers[:, 3],
        np.array(edges, int).reshape(-1, 2))


@contextmanager
def nodes_edited(thing: bpy.types.Object, *, is_changed: bool = True,
                 ) -> Iterator[bmesh.types.BMesh]:
    """Provide the mesh of ``thing`` for reading or changing, in Edit Mode and in Object Mode."""
    if thing.mode == "EDIT":
        builder = bmesh.from_edit_mesh(thing.data)
        builder.verts.index_update()
        yield builder
        if is_changed:
            bmesh.update_edit_mesh(thing.data)
        return
    builder = bmesh.new()
    try:
        builder.from_mesh(thing.data)
        yield builder
        if is_changed:
            builder.to_mesh(thing.data)
            thing.data.update()
    finally:
        builder.free()


def mark(builder: bmesh.types.BMesh, vertex: bmesh.types.BMVert, kind: Mark,
         target: int = -1) -> None:
    """Mark a node; this replaces an earlier mark."""
    layers = builder.verts.layers.int
    turn = 1 + max(other[layers["mark_turn"]] for other in builder.verts)
    for name, value in (("mark", int(kind)), ("mark_target", target), ("mark_turn", turn)):
        vertex[layers[name]] = value


def set_root(builder: bmesh.types.BMesh, vertex: bmesh.types.BMVert) -> None:
    """Make a node the only root."""
    layer = builder.verts.layers.int["root"]
    for other in builder.verts:
        other[layer] = int(other is vertex)
