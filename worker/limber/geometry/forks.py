"""Fillets where twigs leave their parents, in place of the sharp creases of a plain union.

Around each twig's first part goes a collar whose surface is that of a rounded union: with a and b
the distances from twig and parent, and rho the fillet's radius,

    max(rho, min(a, b)) = sqrt(max(rho - a, 0)^2 + max(rho - b, 0)^2).

A collar is a solid and is joined as one, so that the result is closed whatever the angle of the
fork; moving the vertices of the union instead folded its slivers.
"""

import numpy as np
from scipy.spatial import cKDTree

from limber.geometry.skeleton import Skeleton
from limber.geometry.surface import Surface
from limber.geometry.surface_checks import SurfaceCheck, check_surface
from limber.geometry.sweep import frames, resample, rings, tangents

ROUNDING = 0.5
"""Radius of a fillet, in radii of its twig; larger ones meet flat parents at ragged edges."""

VOLUME_CHANGE = 0.01
_STEP = 0.25  # between cross-sections of a collar, in radii of the twig
_BELOW = 0.02  # how far a collar's end lies below the twig's surface, so that the two cross well


def smooth_forks(surface: Surface, skeleton: Skeleton, sides: int = 16,
                 ) -> tuple[Surface, SurfaceCheck, list[str]]:
    """Round the creases between twigs and their parents.

    Args:
        surface: The union of the cylinders: closed, oriented, not crossing itself.
        skeleton: The axes and radii it was made of.
        sides: Sides of a collar.

    Returns:
        The surface, within 1 % of the volume; its check; and warnings about forks that had to
        stay sharp.
    """
    made = [(run, _collar(skeleton, run, sides)) for run in range(1, skeleton.branch_count)]
    collars = [collar for _, collar in made if collar is not None]
    plain = len(made) - len(collars)
    for _ in range(3):
        if not collars:
            break
        joined = _joined(surface, collars, 0.02 * float(skeleton.radius.min()))
        check = check_surface(joined)
        if check.valid and abs(check.volume_m3 / surface.volume - 1) <= VOLUME_CHANGE:
            return joined, check, _warnings(plain, len(made))
        keep = [c for c in collars if not _reaches(c[0], check.crossings)]
        if len(keep) == len(collars):
            break
        plain += len(collars) - len(keep)
        collars = keep
    return surface, check_surface(surface), _warnings(len(made), len(made))


def crease_angles(surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    """Angles [rad] by which faces turn towards each other at hollow edges, and their lengths.

    Returns:
        Angles, shape [k]; lengths [m], shape [k].
    """
    faces = surface.faces
    edges = np.sort(np.vstack([faces[:, [k, (k + 1) % 3]] for k in range(3)]), axis=1)
    owner = np.tile(np.arange(len(faces)), 3)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    pair, one, other = edges[order[::2]], owner[order[::2]], owner[order[1::2]]
    a, b, c = (surface.vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    ends = surface.vertices[pair]
    corner = surface.vertices[faces[other]].sum(axis=1) - ends.sum(axis=1)
    hollow = np.einsum("ij,ij->i", normal[one], corner - ends[:, 0]) > 0
    cosine = np.einsum("ij,ij->i", normal[one], normal[other])
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    return np.arccos(np.clip(cosine[hollow], -1, 1)), length[hollow]


def _warnings(plain: int, count: int) -> list[str]:
    return [f"{plain} of {count} forks stay sharp-edged in the surface: a fillet there would cross "
            "it or change its volume."] if plain else []


def _reaches(vertices: np.ndarray, places: np.ndarray) -> bool:
    if len(places) == 0:
        return False
    centre = vertices.mean(axis=0)
    reach = np.linalg.norm(vertices - centre, axis=1).max()
    return bool((np.linalg.norm(places - centre, axis=1) < 1.5 * reach).any())


def _collar(skeleton: Skeleton, run: int, sides: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Vertices and faces of the collar of a twig; None if the twig ends within its parent."""
    nodes = skeleton.runs()[run]
    if len(nodes) < 2:
        return None
    points, radius = skeleton.nodes[nodes], skeleton.radius[nodes].copy()
    radius[0] = min(radius[1], 0.95 * radius[0])
    rounding = ROUNDING * radius[0]
    points, radius = resample(points, radius, np.full(len(points), _STEP * radius[0]))
    parent = _Tube(skeleton, int(skeleton.branch[nodes[0]]), _STEP * float(radius[0]))
    tangent = tangents(points)
    ring = rings(points, radius, *frames(points, tangent), sides)
    to_parent = parent.distance(ring.reshape(-1, 3)).reshape(ring.shape[:2])
    out = to_parent.min(axis=1) > 1.05 * rounding
    count = int(np.argmax(out)) + 1
    if not out.any() or count < 3:
        return None
    points, radius, ring = points[:count], radius[:count], ring[:count]
    outwards = ring - points[:, None]
    outwards /= np.linalg.norm(outwards, axis=2, keepdims=True)
    lift = _lift(ring, outwards, parent, float(rounding)) - _BELOW * radius[0]
    ring = ring + lift[:, :, None] * outwards
    return _closed(ring, points)


def _lift(ring: np.ndarray, outwards: np.ndarray, parent: "_Tube", rounding: float) -> np.ndarray:
    """Height [m] of the rounded union over the twig: where each ray leaves it first.

    Rays that run on into the parent end there, a fillet's radius above the twig.
    """
    heights = np.linspace(0, rounding, 9)
    points = ring + heights[:, None, None, None] * outwards
    to_parent = parent.distance(points.reshape(-1, 3)).reshape(points.shape[:3])
    depth = np.hypot((rounding - heights)[:, None, None],
                     np.maximum(rounding - to_parent, 0)) - rounding
    after = np.maximum((depth < 0).argmax(axis=0), 1)
    high = np.take_along_axis(depth, after[None], axis=0)[0]
    low = np.take_along_axis(depth, after[None] - 1, axis=0)[0]
    share = np.clip(low / np.maximum(low - high, 1e-300), 0, 1)
    leaves = (depth < 0).any(axis=0)
    return np.where(leaves, heights[after - 1] + share * heights[1], rounding)


class _Tube:
    """Distances from a run's round cylinders."""

    def __init__(self, skeleton: Skeleton, run: int, step: float):
        nodes = skeleton.runs()[run]
        radius = skeleton.radius[nodes].copy()
        if run > 0 and len(radius) > 1:
            radius[0] = radius[1]
        points, self._radius = resample(skeleton.nodes[nodes], radius, np.full(len(nodes), step))
        self._tree = cKDTree(points)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Distance [m] of points from the surface, negative inside, shape [n]."""
        distance, near = self._tree.query(points)
        return distance - self._radius[near]


def _closed(ring: np.ndarray, centres: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    count, sides = ring.shape[:2]
    vertices = np.vstack([ring.reshape(-1, 3), centres[:1], centres[-1:]])
    k = np.arange(sides)
    after = (k + 1) % sides
    start, end = count * sides, count * sides + 1
    last = (count - 1) * sides
    faces = [np.stack([np.full(sides, start), after, k], axis=1),
             np.stack([last + k, last + after, np.full(sides, end)], axis=1)]
    for low in range(0, last, sides):
        high = low + sides
        faces.append(np.stack([low + k, low + after, high + after], axis=1))
        faces.append(np.stack([low + k, high + after, high + k], axis=1))
    return vertices, np.vstack(faces)


def _joined(surface: Surface, collars: list[tuple[np.ndarray, np.ndarray]], tolerance: float,
            ) -> Surface:
    import manifold3d

    solids = [manifold3d.Manifold(manifold3d.Mesh64(
        vert_properties=np.ascontiguousarray(vertices, np.float64),
        tri_verts=np.ascontiguousarray(faces, np.uint64)))
        for vertices, faces in [(surface.vertices, surface.faces), *collars]]
    joined = manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add).simplify(tolerance)
    # Cavities between crossing twigs come out as pieces of negative volume: they are filled.
    mesh = max(joined.decompose(), key=lambda piece: piece.volume()).to_mesh64()
    return Surface(np.array(mesh.vert_properties, float)[:, :3].copy(),
                   np.array(mesh.tri_verts, np.int64))
