"""Radius-adaptive generalised cylinders along a skeleton, joined at forks into one surface."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from limber.errors import MeshingError
from limber.geometry.skeleton import Skeleton
from limber.geometry.surface import Surface
from limber.geometry.surface_checks import crossings
from limber.geometry.sweep import frames, polygon_factor, resample, rings, tangents


@dataclass(frozen=True)
class Tube:
    """Axis and radii of one unforked run, resampled and safe to sweep."""

    centres: np.ndarray
    radius: np.ndarray
    tangent: np.ndarray


def branch_surface(skeleton: Skeleton, *, sides: int = 12, spacing: float = 1.5) -> Surface:
    """Sweep a tube along each run and join them: watertight, rounded tips, a flat base.

    Circular cross-sections orthogonal to the tangent, as in the paper's section on the
    tetrahedral plant model; rotation-minimising frames keep them from twisting.

    Args:
        skeleton: Axes and radii.
        sides: Sides of a cross-section; the polygon has the circle's area.
        spacing: Distance of cross-sections in local radii.

    Raises:
        MeshingError: the union is empty or in several pieces.
    """
    tubes = {run: tubes_of_run(skeleton, run, spacing) for run in range(skeleton.branch_count)}
    in_pieces: set[int] = set()
    for _ in range(4):
        surface = _union(tubes, in_pieces, sides, 0.02 * float(skeleton.radius.min()))
        places = crossings(surface)
        more = _runs_near(tubes, places) - in_pieces
        if not more:
            return surface
        # A tube that loops through itself is no solid, whatever the union makes of it: convex
        # pieces from one cross-section to the next always are.
        in_pieces |= more
    return surface


def _union(tubes: dict[int, list[Tube]], in_pieces: set[int], sides: int, tolerance: float,
           ) -> Surface:
    import manifold3d

    solids = []
    for run, parts in tubes.items():
        for tube in parts:
            vertices, faces = tube_triangles(tube, sides)
            solids += _pieces(tube, vertices, sides) if run in in_pieces else [
                _solid(vertices, faces)]
    joined = manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add)
    # Where tubes cross, the union leaves slivers far below any size that matters.
    joined = joined.simplify(tolerance)
    pieces = joined.decompose()
    if not pieces:
        raise MeshingError("The union of the cylinders is empty.", "Radii may be zero.",
                           "Look at the skeleton's radii.")
    if len(pieces) > 1:
        # A cavity between crossing twigs comes out as a piece of negative volume: it is filled.
        joined = max(pieces, key=lambda piece: piece.volume())
    mesh = joined.to_mesh64()
    vertices = np.array(mesh.vert_properties, float)[:, :3].copy()
    return Surface(vertices, np.array(mesh.tri_verts, np.int64))


def _pieces(tube: Tube, vertices: np.ndarray, sides: int) -> list:
    import manifold3d

    ring_count = (len(vertices) - 2) // sides
    ring = vertices[:-2].reshape(ring_count, sides, 3)
    ends = len(tube.centres) - 1
    hulls = [np.vstack([ring[i], ring[i + 1]]) for i in range(ends - 1)]
    hulls.append(np.vstack([ring[ends - 1:].reshape(-1, 3), vertices[-1:]]))
    return [manifold3d.Manifold.hull_points(np.ascontiguousarray(hull)) for hull in hulls]


def _runs_near(tubes: dict[int, list[Tube]], places: np.ndarray) -> set[int]:
    if len(places) == 0:
        return set()
    near = set()
    for run, parts in tubes.items():
        for tube in parts:
            distance, _ = cKDTree(places).query(tube.centres)
            if (distance < 3 * tube.radius).any():
                near.add(run)
    return near


def tubes_of_run(skeleton: Skeleton, run: int, spacing: float) -> list[Tube]:
    """Return run ``run`` as a tube, or as several overlapping ones where it bends too sharply.

    A side run starts on its parent's axis, with a radius that stays inside the parent.
    """
    nodes = skeleton.runs()[run]
    points, radius = skeleton.nodes[nodes], skeleton.radius[nodes].copy()
    if run > 0:
        # The first node is the parent's, whose radius is not this twig's.
        radius[0] = min(radius[1] if len(radius) > 1 else radius[0], 0.95 * radius[0])
    points, radius = resample(points, radius, spacing * radius)
    if len(points) < 3:
        middle = np.linspace(0, 1, 3)[:, None]
        points = points[0] + middle * (points[-1] - points[0])
        radius = np.linspace(radius[0], radius[-1], 3)
    return [Tube(p, r, tangents(p)) for p, r in _split_at_folds(points, radius)]


def tube_triangles(tube: Tube, sides: int) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of a tube with a flat start and a rounded end: vertices [m], faces."""
    normals, binormals = frames(tube.centres, tube.tangent)
    tip_centres, tip_radius = _tip(tube)
    tip_count = len(tip_radius)
    centres = np.vstack([tube.centres, tip_centres])
    radius = np.concatenate([tube.radius, tip_radius])
    normals = np.vstack([normals, np.repeat(normals[-1:], tip_count, axis=0)])
    binormals = np.vstack([binormals, np.repeat(binormals[-1:], tip_count, axis=0)])
    ring = rings(centres, radius, normals, binormals, sides).reshape(-1, 3)
    apex = tube.centres[-1] + tube.tangent[-1] * tube.radius[-1]
    vertices = np.vstack([ring, tube.centres[:1], apex[None]])
    start, end = len(ring), len(ring) + 1
    k = np.arange(sides)
    after = (k + 1) % sides
    faces = [np.stack([np.full(sides, start), after, k], axis=1)]
    for i in range(len(centres) - 1):
        low, high = i * sides, (i + 1) * sides
        faces.append(np.stack([low + k, low + after, high + after], axis=1))
        faces.append(np.stack([low + k, high + after, high + k], axis=1))
    last = (len(centres) - 1) * sides
    faces.append(np.stack([last + k, last + after, np.full(sides, end)], axis=1))
    return vertices, np.vstack(faces)


def _tip(tube: Tube) -> tuple[np.ndarray, np.ndarray]:
    """Rings of the rounded end, between the last cross-section and the apex."""
    angle = np.deg2rad([35.0, 65.0])
    centres = tube.centres[-1] + tube.radius[-1] * np.sin(angle)[:, None] * tube.tangent[-1]
    return centres, tube.radius[-1] * np.cos(angle)


def _split_at_folds(points: np.ndarray, radius: np.ndarray,
                    ) -> list[tuple[np.ndarray, np.ndarray]]:
    """Cut a run where neighbouring cross-sections would cross; the parts overlap in one step.

    A tube of radius r around a bend of radius under r folds into itself; two straight parts that
    overlap do not, and their union is the bend.
    """
    tangent = tangents(points)
    step = np.diff(points, axis=0)
    length = np.linalg.norm(step, axis=1)
    turn = np.linalg.norm(np.diff(tangent, axis=0), axis=1)
    reach = np.maximum(radius[1:], radius[:-1]) * polygon_factor(6)
    folds = np.flatnonzero(turn * reach > 0.8 * length)
    parts, begin = [], 0
    for fold in folds:
        if fold <= begin:
            continue
        parts.append((points[begin:fold + 2], radius[begin:fold + 2]))
        begin = fold
    parts.append((points[begin:], radius[begin:]))
    return [part for part in parts if len(part[0]) > 1]


def _solid(vertices: np.ndarray, faces: np.ndarray):
    import manifold3d

    solid = manifold3d.Manifold(manifold3d.Mesh64(
        vert_properties=np.ascontiguousarray(vertices, np.float64),
        tri_verts=np.ascontiguousarray(faces, np.uint64)))
    if solid.status() != manifold3d.Error.NoError:
        raise MeshingError(f"A cylinder is no solid ({solid.status().name}).",
                           "Its cross-sections may coincide.", "Look at the skeleton there.")
    return solid
