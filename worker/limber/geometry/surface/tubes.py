"""Radius-adaptive generalised cylinders along a skeleton, joined at forks into one surface."""

import itertools
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from limber.core.errors import MeshingError
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.skeleton.sweep import frames, polygon_factor, resample, rings, tangents
from limber.geometry.surface.surface import Surface, crossings

_SIDES, _SPACING = 12, 1.5  # of the cross-sections; the distance between them in local radii


def _run_axis(skeleton: Skeleton, run: int, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Axis [m], shape [k, 3], and radii [m] of a run, ``spacing`` radii from point to point. A side
    run starts on its parent's axis, with a radius that stays inside the parent."""
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
    return points, radius


@dataclass(frozen=True)
class _Tube:
    """Axis and radii of one unforked run, resampled and safe to sweep."""

    centres: np.ndarray
    radius: np.ndarray
    tangent: np.ndarray
    flat_start: bool


_CAP = np.deg2rad([35.0, 65.0])  # angles of a rounded end's rings on its half sphere
_CORNER = np.deg2rad(30.0)


def branch_surface(skeleton: Skeleton, *, sides: int = _SIDES, spacing: float = _SPACING,
                   ) -> Surface:
    """Sweep a tube along each run and join them: watertight, rounded tips, a flat base; sections
    across the tangent, as in the paper's plant model. MeshingError if the union is empty."""
    tubes = {run: _tubes_of_run(skeleton, run, spacing) for run in range(skeleton.branch_count)}
    in_pieces: set[int] = set()
    for _ in range(4):
        surface = _union(tubes, in_pieces, sides, 0.02 * float(skeleton.radius.min()))
        points = crossings(surface)
        more = _runs_near(tubes, points) - in_pieces
        if not more:
            return surface
        # A tube that loops through itself is not a solid, whatever the union makes of it. Convex
        # pieces from one cross-section to the next always are.
        in_pieces |= more
    return surface


def _union(tubes: dict[int, list[_Tube]], in_pieces: set[int], sides: int, tolerance: float,
           ) -> Surface:
    import manifold3d

    solids = []
    for run, parts in tubes.items():
        for tube in parts:
            vertices, faces = _tube_triangles(tube, sides)
            solids += _pieces(tube, vertices, sides) if run in in_pieces else [
                _solid(vertices, faces)]
    joined = manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add)
    # Where tubes cross, the union leaves slivers far below any relevant size.
    return _largest_piece(joined.simplify(tolerance))


def _largest_piece(joined) -> Surface:
    """The surface of a union's largest piece; MeshingError if it is empty."""
    pieces = joined.decompose()
    if not pieces:
        raise MeshingError("The union of the cylinders is empty.", "Some radii may be zero.",
                           "Check the radii of the skeleton.")
    if len(pieces) > 1:
        # A cavity between crossing twigs becomes a piece of negative volume: it is filled.
        joined = max(pieces, key=lambda piece: piece.volume())
    mesh = joined.to_mesh64()
    vertices = np.array(mesh.vert_properties, float)[:, :3].copy()
    return Surface(vertices, np.array(mesh.tri_verts, np.int64))


def _pieces(tube: _Tube, vertices: np.ndarray, sides: int) -> list:
    import manifold3d

    ring = vertices[:-2].reshape(-1, sides, 3)
    begin = 0 if tube.flat_start else len(_CAP)
    end = len(ring) - 1 - len(_CAP)
    hulls = [np.vstack([ring[i], ring[i + 1]]) for i in range(begin, end)]
    hulls[0] = np.vstack([*ring[:begin], hulls[0], vertices[-2:-1]])
    hulls[-1] = np.vstack([hulls[-1], *ring[end + 1:], vertices[-1:]])
    return [manifold3d.Manifold.hull_points(np.ascontiguousarray(hull)) for hull in hulls]


def _runs_near(tubes: dict[int, list[_Tube]], points: np.ndarray) -> set[int]:
    if len(points) == 0:
        return set()
    near = set()
    for run, parts in tubes.items():
        for tube in parts:
            distance, _ = cKDTree(points).query(tube.centres)
            if (distance < 3 * tube.radius).any():
                near.add(run)
    return near


def _tubes_of_run(skeleton: Skeleton, run: int, spacing: float) -> list[_Tube]:
    """Return run ``run`` as a tube, or as several overlapping ones where it bends too sharply."""
    points, radius = _run_axis(skeleton, run, spacing)
    # A round start there would bulge out of the flat cut at the root.
    at_root = np.linalg.norm(points[0] - skeleton.nodes[0]) < 1.2 * skeleton.radius[0]
    return [_Tube(p, r, tangents(p), flat_start=bool(at_root and part == 0))
            for part, (p, r) in enumerate(_split_at_bends(points, radius))]


def _tube_triangles(tube: _Tube, sides: int) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of a tube with a rounded end and start, or a flat start: vertices [m], faces."""
    normals, binormals = frames(tube.centres, tube.tangent)
    centres, radius = tube.centres, tube.radius
    before = 0 if tube.flat_start else len(_CAP)
    over, under = np.sin(_CAP), np.cos(_CAP)
    ahead, back = (tube.radius[k] * tube.tangent[k] for k in (-1, 0))
    centres = np.vstack([centres[0] - over[::-1][:before, None] * back, centres,
                         centres[-1] + over[:, None] * ahead])
    radius = np.concatenate([radius[0] * under[::-1][:before], radius, radius[-1] * under])
    ends = ((before, len(_CAP)), (0, 0))
    ring = rings(centres, radius, np.pad(normals, ends, "edge"), np.pad(binormals, ends, "edge"),
                 sides).reshape(-1, 3)
    start_point = tube.centres[0] - (0 if tube.flat_start else 1) * back
    vertices = np.vstack([ring, start_point, tube.centres[-1] + ahead])
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


def _split_at_bends(points: np.ndarray, radius: np.ndarray,
                    ) -> list[tuple[np.ndarray, np.ndarray]]:
    """Cut a run at its corners, where a mitre would be inside the round cylinders' ball."""
    step = np.diff(points, axis=0)
    step /= np.maximum(np.linalg.norm(step, axis=1), 1e-300)[:, None]
    corners = 1 + np.flatnonzero(np.einsum("ij,ij->i", step[1:], step[:-1]) < np.cos(_CORNER))
    ends = [0, *corners.tolist(), len(points) - 1]
    return [part for low, high in itertools.pairwise(ends)
            for part in _split_at_folds(points[low:high + 1], radius[low:high + 1])]


def _split_at_folds(points: np.ndarray, radius: np.ndarray,
                    ) -> list[tuple[np.ndarray, np.ndarray]]:
    """Cut a run where neighbouring cross-sections would cross; the parts overlap in one step. A
    tube of radius r folds into itself around a bend of radius under r; two parts do not."""
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
    """A solid of manifold3d; MeshingError if the triangles do not close one."""
    import manifold3d

    solid = manifold3d.Manifold(manifold3d.Mesh64(
        vert_properties=np.ascontiguousarray(vertices, np.float64),
        tri_verts=np.ascontiguousarray(faces, np.uint64)))
    if solid.status() != manifold3d.Error.NoError:
        raise MeshingError(f"A cylinder is not a solid ({solid.status().name}).",
                           "Its cross-sections may coincide.", "Check the skeleton there.")
    return solid
