"""Marks on the nodes of a visible skeleton: its root, edited and uncertain nodes."""

from dataclasses import dataclass, field

import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader

from .. import compat
from ..branch import branches
from ..bridge import skeletons
from .skeleton_edits import Nodes, SkeletonEditError, edits_of

EDITED, DOUBTFUL = 128, 32 | 64
"""Bits of the worker's flags: edits applied; a radius not resolved, a gap bridged."""
COLORS = {"root": (0.25, 0.9, 0.3, 1.0), "edited": (1.0, 0.5, 0.1, 1.0),
          "doubtful": (1.0, 0.9, 0.2, 1.0), "pending": (0.95, 0.3, 1.0, 1.0)}
WORDS = {"root": "green: root", "edited": "orange: edited", "doubtful": "yellow: uncertain",
         "pending": "violet: not yet applied"}


@dataclass(frozen=True)
class Marks:
    """Points of each colour [m], and lines from marked nodes to their targets, two points each.

    ``edit_count`` is the number of edits not applied yet; ``trouble`` states why they cannot be.
    """

    points: dict[str, np.ndarray]
    lines: np.ndarray
    edit_count: int = 0
    trouble: str = ""
    batches: dict[str, gpu.types.GPUBatch] = field(default_factory=dict)


_kept: dict[tuple[str, str], Marks] = {}


def marks_in_sight(thing: bpy.types.Object) -> Marks:
    """Return the marks of a skeleton, computed once for each state of it."""
    key = (thing.name, thing.data.name)
    if key not in _kept:
        _kept.clear()
        _kept[key] = marks_of(skeletons.nodes_of(thing), thing.data)
    return _kept[key]


def marks_of(nodes: Nodes, mesh: bpy.types.Mesh) -> Marks:
    """Return the marks among the nodes of a skeleton's mesh."""
    given = skeletons.as_given(mesh)
    known = np.clip(nodes.number, 0, len(given.nodes) - 1)
    flags = skeletons.flags_of(mesh)[known]
    moved = (given.nodes[known].astype(np.float32) != nodes.places).any(axis=1)
    resized = given.radius[known].astype(np.float32) != nodes.radius
    pending = moved | resized | (nodes.marks > 0) | (nodes.is_root & (nodes.number != given.root))
    places = dict(zip(nodes.number.tolist(), nodes.places, strict=True))
    lines = [place for k in np.flatnonzero(nodes.marks) if int(nodes.targets[k]) in places
             for place in (nodes.places[k], places[int(nodes.targets[k])])]
    groups = {"pending": pending, "root": nodes.is_root, "edited": (flags & EDITED) > 0,
              "doubtful": (flags & DOUBTFUL) > 0}
    taken = np.zeros(len(nodes.number), bool)
    points = {}
    for name, chosen in groups.items():
        points[name] = nodes.places[chosen & ~taken]
        taken |= chosen
    count, trouble = 0, ""
    try:
        count = len(edits_of(given, nodes))
    except SkeletonEditError as error:
        trouble = str(error)
    return Marks(points, np.array(lines, np.float32).reshape(-1, 3), count, trouble)


def _draw() -> None:
    thing = branches.find_skeleton(bpy.context.scene)
    if thing is None or not thing.visible_get():
        return
    marks = marks_in_sight(thing)
    gpu.state.depth_test_set("NONE")
    with gpu.matrix.push_pop():
        gpu.matrix.multiply_matrix(thing.matrix_world)
        for name, points in marks.points.items():
            if len(points):
                gpu.state.point_size_set(9.0)
                _draw_batch(marks.batches, name, "POINTS", points, COLORS[name])
        if len(marks.lines):
            gpu.state.line_width_set(2.0)
            _draw_batch(marks.batches, "lines", "LINES", marks.lines, COLORS["pending"])
            gpu.state.line_width_set(1.0)


def _draw_batch(batches: dict, name: str, kind: str, points: np.ndarray, color) -> None:
    shader = gpu.shader.from_builtin(
        compat.POINT_SHADER if kind == "POINTS" else "UNIFORM_COLOR")
    if name not in batches:
        batches[name] = batch_for_shader(shader, kind, {"pos": points.tolist()})
    shader.bind()
    shader.uniform_float("color", color)
    batches[name].draw(shader)


def _changed(_scene, depsgraph=None) -> None:
    """Check the nodes again only if a mesh or an object has changed."""
    if depsgraph is None or depsgraph.id_type_updated("MESH") or (
            depsgraph.id_type_updated("OBJECT")):
        _kept.clear()


DRAWN = (_draw, "POST_VIEW")
HANDLERS = tuple((event, _changed) for event in (
    "depsgraph_update_post", "undo_post", "redo_post", "load_post"))
unregister = _kept.clear
