"""Fillets where twigs leave their parents, instead of the sharp creases of a plain union.

Around each crease a solid is added whose surface is that of a rounded union of twig and parent.
With a and b the distances from the two and rho the fillet's radius,

    max(rho, min(a, b)) = sqrt(max(rho - a, 0)^2 + max(rho - b, 0)^2).

It reaches about a twig's radius beyond the crease, is slightly above the cylinders near it and
below them at its rim, and is joined to them as a solid. The result is closed for any angle of the
fork and any number of twigs there.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from limber.core.errors import MeshingError
from limber.core.numerics.compiled import compiled_exactly
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.skeleton.sweep import polygon_factor, tangents
from limber.geometry.surface.surface import Surface, SurfaceCheck, check_surface, crossings
from limber.geometry.surface.tubes import SPACING, largest_piece, run_axis, sides_of_runs, solid

# Triangles of an implicit surface: marching tetrahedra, then smoothing on the surface itself.

_CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0],
                     [0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 1]])
# Six tetrahedra around the diagonal 0-7 of a cube (Kuhn): the same in each cube, so faces match.
_TETS = np.array([[0, 1, 3, 7], [0, 3, 2, 7], [0, 2, 6, 7], [0, 6, 4, 7], [0, 4, 5, 7],
                  [0, 5, 1, 7]])
_ROUNDS = 2  # rounds of smoothing of the vertices
_NEAR = 0.05  # fraction of the step; a closer lattice point would make a sliver


def level_surface(level: Callable[[np.ndarray], np.ndarray], low: np.ndarray, high: np.ndarray,
                  step: float) -> Surface:
    """Triangles of ``level(x) = 0``, about a distance [m] of points [n, 3], negative inside; closed
    by the box ``low`` to ``high`` [3] [m]. Marching tetrahedra (Doi and Koide 1991) on Kuhn's cubes
    of edge ``step`` [m] have no ambiguous case. Vertices are evened out on the surface."""
    count = np.maximum(np.ceil((high - low) / step).astype(int), 1) + 1
    axes = [low[k] + step * np.arange(count[k]) for k in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    value = level(points)
    value = np.where(np.abs(value) < _NEAR * step, np.where(value < 0, -1, 1) * _NEAR * step,
                     value)
    grid = value.reshape(count)
    for axis in range(3):  # the box closes cut surfaces
        for end in (0, -1):
            face: list[slice | int] = [slice(None)] * 3
            face[axis] = end
            grid[tuple(face)] = np.maximum(grid[tuple(face)], _NEAR * step)
    surface = _march(points, grid)
    return _evened(surface, level, step) if len(surface.faces) else surface


def _march(points: np.ndarray, grid: np.ndarray) -> Surface:
    inside = grid < 0
    count = np.array(grid.shape)
    parts = [inside[c[0]:count[0] - 1 + c[0], c[1]:count[1] - 1 + c[1], c[2]:count[2] - 1 + c[2]]
             for c in _CORNERS]
    number = sum(part.astype(np.int8) for part in parts)
    cube = np.argwhere((number > 0) & (number < 8))
    if not len(cube):
        return Surface(np.empty((0, 3)), np.empty((0, 3), np.int64))
    corner = np.ravel_multi_index(
        (cube[:, None] + _CORNERS[None]).reshape(-1, 3).T, grid.shape).reshape(-1, 8)
    tets = corner[:, _TETS].reshape(-1, 4)
    value = grid.ravel()
    # Corners inside come first, so that their number gives the case; the parity of the order is
    # kept.
    order = np.argsort(value[tets] >= 0, axis=1, kind="stable")
    odd = np.zeros(len(order), bool)
    for i in range(4):
        for j in range(i):
            odd ^= order[:, j] > order[:, i]
    tets = np.take_along_axis(tets, order, axis=1)
    within = (value[tets] < 0).sum(axis=1)
    edges, flip = [], []
    one, two, three = (np.flatnonzero(within == k) for k in (1, 2, 3))
    a, b, c, d = (tets[:, k] for k in range(4))

    def add(chosen: np.ndarray, *ends: tuple[np.ndarray, np.ndarray], turned: bool) -> None:
        edges.append(np.stack([np.stack([p[chosen], q[chosen]], axis=1) for p, q in ends], axis=1))
        flip.append(odd[chosen] ^ turned)

    add(one, (a, b), (a, c), (a, d), turned=False)
    add(two, (a, c), (a, d), (b, d), turned=False)
    add(two, (a, c), (b, d), (b, c), turned=False)
    add(three, (a, d), (b, d), (c, d), turned=False)
    corners, turned = np.vstack(edges), np.concatenate(flip)
    pairs = corners.reshape(-1, 2)
    # Both ends in one number: this sorts ten times as fast as rows.
    unique, index = np.unique(pairs.min(axis=1) * grid.size + pairs.max(axis=1),
                              return_inverse=True)
    faces = index.reshape(-1, 3)
    faces[turned] = faces[turned][:, ::-1]
    first, second = np.divmod(unique, grid.size)
    low, high = value[first], value[second]
    share = (low / (low - high))[:, None]
    vertices = points[first] + share * (points[second] - points[first])
    surface = Surface(vertices, faces)
    return surface if surface.volume > 0 else Surface(vertices, faces[:, ::-1])


def _evened(surface: Surface, level: Callable[[np.ndarray], np.ndarray], step: float,
            ) -> Surface:
    from scipy.sparse import coo_matrix

    vertices, faces = surface.vertices, surface.faces
    rows, columns = faces.ravel(), faces[:, [1, 2, 0]].ravel()  # each edge, once in each direction
    near = coo_matrix((np.ones(len(rows)), (rows, columns)), (len(vertices),) * 2).tocsr()
    degree = np.asarray(near.sum(axis=1))
    for _ in range(_ROUNDS):
        for _ in range(2):
            vertices = (vertices + near @ vertices / degree) / 2
        vertices = _onto(vertices, level, step)
    return Surface(vertices, faces)


def _onto(points: np.ndarray, level: Callable[[np.ndarray], np.ndarray], step: float,
          ) -> np.ndarray:
    """One step of Newton's method along the gradient, at most half a lattice step long."""
    small = 0.05 * step
    value = level(points)
    gradient = np.stack([level(points + small * np.eye(3)[k]) - value for k in range(3)],
                        axis=1) / small
    shift = -value[:, None] * gradient / np.maximum((gradient**2).sum(axis=1), 0.25)[:, None]
    size = np.linalg.norm(shift, axis=1, keepdims=True)
    return points + shift * np.minimum(1, 0.5 * step / np.maximum(size, 1e-300))


# Distances from round cylinders, and the level function of a fillet between them.


def segments(points: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Rounded cones along points [n, 3] [m], shape [n - 1, 10]: start [m], step [m], radius and its
    change [m], start along the line and length [m]."""
    step = np.diff(points, axis=0)
    length = np.linalg.norm(step, axis=1)
    start = np.concatenate([[0], np.cumsum(length)])[:-1]
    return np.column_stack([points[:-1], step, radius[:-1], np.diff(radius), start, length])


def near_box(cones: np.ndarray, low: np.ndarray, high: np.ndarray, reach: float) -> np.ndarray:
    """The cones that come within ``reach`` [m] of a box; at least the nearest one."""
    middle, half = cones[:, :3] + cones[:, 3:6] / 2, cones[:, 9] / 2
    outside = np.maximum(np.maximum(low - middle, middle - high), 0)
    distance = np.linalg.norm(outside, axis=1) - half - cones[:, 6] - np.maximum(cones[:, 7], 0)
    return cones[distance <= max(reach, float(distance.min()))]


@compiled_exactly
def nearest(cones: np.ndarray, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Distance [m] of a point from cones, negative inside; radius and position along there [m]."""
    best, radius, along = np.inf, 0.0, 0.0
    for k in range(len(cones)):
        dx, dy, dz = x - cones[k, 0], y - cones[k, 1], z - cones[k, 2]
        length = cones[k, 9]
        t = 0.0
        if length > 0:
            t = (dx * cones[k, 3] + dy * cones[k, 4] + dz * cones[k, 5]) / (length * length)
            t = min(max(t, 0.0), 1.0)
        dx, dy, dz = dx - t * cones[k, 3], dy - t * cones[k, 4], dz - t * cones[k, 5]
        here = cones[k, 6] + t * cones[k, 7]
        distance = np.sqrt(dx * dx + dy * dy + dz * dz) - here
        if distance < best:
            best, radius, along = distance, here, cones[k, 8] + t * length
    return best, radius, along


@compiled_exactly
def distances(cones: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances [m] of points [n, 3] from cones, negative inside, and the radii there [m]."""
    distance, radius = np.empty(len(points)), np.empty(len(points))
    for i in range(len(points)):
        distance[i], radius[i], _ = nearest(cones, points[i, 0], points[i, 1], points[i, 2])
    return distance, radius


@compiled_exactly
def fillet_level(points: np.ndarray, twig: np.ndarray, others: np.ndarray, first: np.ndarray,
                 excess: np.ndarray, base: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """Level [n] of the solid around the crease of a twig with others, whose cones start at
    ``first`` [k + 1]. ``excess`` [k + 1]: polygon corners over circles in radii, the twig's first.
    ``base`` [2, 3]: point [m] and normal of the root's cut. ``shape``: radius [m]; reach, lowest
    rim and margin over and under the cylinders in radii of it; end along the twig [m] or inf."""
    rho, reach, rim, margin, end = shape
    count = len(first) - 1
    distance, radius = np.empty(count), np.empty(count)
    level = np.empty(len(points))
    for i in range(len(points)):
        x, y, z = points[i]
        b, thick, along = nearest(twig, x, y, z)
        level[i] = b - reach * rho
        if level[i] > 0.2 * rho:
            continue
        a = np.inf
        for k in range(count):
            distance[k], radius[k], _ = nearest(others[first[k]:first[k + 1]], x, y, z)
            a = min(a, distance[k])
        cut = ((base[0, 0] - x) * base[1, 0] + (base[0, 1] - y) * base[1, 1]
               + (base[0, 2] - z) * base[1, 2])
        far = max(a, b, cut)
        if along > end:
            far = max(far, rho * (1 + (rim - 1) * (along - end) / thick))
        over = min(max(1 - 2 * (far / rho - 1) / (rim - 1), -1.0), 1.0)
        a = np.inf
        for k in range(count):
            a = min(a, distance[k] - over * (excess[k + 1] * radius[k] + margin * rho))
        b -= over * (excess[0] * thick + margin * rho)
        rounded = max(rho, min(a, b)) - np.hypot(max(rho - a, 0.0), max(rho - b, 0.0))
        level[i] = max(rounded, far - reach * rho, cut)
    return level


ROUNDING = 0.5
"""Radius of a fillet, in radii of its twig or of its parent, whichever is thinner."""

VOLUME_CHANGE = 0.02
_STEP = 0.7  # lattice step, in fillet radii
_COARSENED = 0.06  # deviation of coarsened triangles, in fillet radii
_REACH = 2.5  # extent of a fillet's solid from the crease, in fillet radii
_RIM = 2.2  # position where it is deepest under the cylinders
_MARGIN = 0.02  # height above them near the crease, depth at the rim, in fillet radii
_LONGEST = 8.0  # crease of a twig along its parent, in radii of both
_SCALES = (1.0, 0.83, 1.21)  # lattice steps tried in turn


def smooth_forks(surface: Surface, skeleton: Skeleton, *, sides: int | None = None,
                 spacing: float = SPACING) -> tuple[Surface, SurfaceCheck, list[str]]:
    """Round the creases of :func:`branch_surface`, made with these sides and spacing. Return the
    surface, within 2 % of the volume, its check, and warnings about forks that stayed sharp."""
    forks = {fork.run: fork for fork in _forks(skeleton, sides, spacing)}
    made = {run: fork.fillet(_SCALES[0]) for run, fork in forks.items()}
    fillets = {run: solid(f.vertices, f.faces) for run, f in made.items() if f is not None}
    cylinders = solid(surface.vertices, surface.faces)
    tolerance = 0.02 * float(skeleton.radius.min())
    # Where a fillet crosses something, another lattice is tried; if that fails, it is left out.
    for another in (True, False, False, False):
        joined = _joined([cylinders, *fillets.values()], tolerance)
        if joined is None or abs(joined.volume / surface.volume - 1) > VOLUME_CHANGE:
            break
        check = check_surface(joined)
        if check.valid:
            return joined, check, _warnings(len(forks) - len(fillets), len(forks))
        wrong = [run for run, fillet in fillets.items() if _holds(fillet, check.crossings)]
        if not wrong:
            break
        for run in wrong:
            first = fillets.pop(run)
            others = [cylinders, *(near for near in fillets.values() if _meet(near, first))]
            other = _uncrossed(forks[run], first, others, tolerance) if another else None
            if other is not None:
                fillets[run] = other
    return surface, check_surface(surface), _warnings(len(forks), len(forks))


def _uncrossed(fork: "_Fork", first: Any, others: list, tolerance: float) -> Any:
    """A fillet from another lattice than ``first``'s that crosses none of the ``others``; None if
    there is none. Joining may move triangles by ``tolerance`` [m]."""
    import manifold3d

    low, high = _box(first)
    room = manifold3d.Manifold.cube(tuple(high - low)).translate(tuple(low))
    around = [part ^ room for part in others]
    for scale in _SCALES[1:]:
        made = fork.fillet(scale)
        if made is None:
            continue
        fillet = solid(made.vertices, made.faces)
        joined = _joined([*around, fillet], tolerance)
        if joined is not None and len(crossings(joined)) == 0:
            return fillet
    return None


def _warnings(plain: int, count: int) -> list[str]:
    return [f"{plain} of {count} forks keep sharp edges in the surface, because a fillet would "
            "intersect the surface or change its volume."] if plain else []


def _box(fillet: Any) -> tuple[np.ndarray, np.ndarray]:
    """Corners of a box around a fillet's solid, with a margin [m], shape [3] each."""
    low, high = np.reshape(fillet.bounding_box(), (2, 3))
    margin = 0.1 * (high - low)
    return low - margin, high + margin


def _holds(fillet: Any, points: np.ndarray) -> bool:
    """Whether any of the positions [m], shape [n, 3], is in the box around a fillet."""
    low, high = _box(fillet)
    return bool(((points > low) & (points < high)).all(axis=1).any())


def _meet(one: Any, other: Any) -> bool:
    (low, high), (begin, end) = _box(one), _box(other)
    return bool((low < end).all() and (begin < high).all())


@dataclass(frozen=True)
class _Fork:
    """A twig, its carrier, and the stretch where the two meet."""

    run: int
    twig: np.ndarray
    others: tuple[np.ndarray, ...]
    excess: np.ndarray
    base: np.ndarray
    wide: float  # largest distance from the root's centre at which the cut matters [m]
    rounding: float
    axis: np.ndarray  # points [m] and radii [m] of the run, shape [k, 4]
    end: float  # position along the twig where the fillet fades out, if they do not separate

    def fillet(self, scale: float) -> Surface | None:
        """The solid of the rounded union around the crease; None if there is no crease."""
        step = scale * _STEP * self.rounding
        reach = (self.axis[:, 3] + _REACH * self.rounding + 2 * step)[:, None]
        # An irregular shift: a lattice in line with the axes meets the cylinders in edges.
        low = (self.axis[:, :3] - reach).min(axis=0) - np.array([0.31, 0.17, 0.43]) * step
        high = (self.axis[:, :3] + reach).max(axis=0)
        near = 2 * _REACH * self.rounding
        twig = near_box(self.twig, low, high, near)
        others = [near_box(other, low, high, near) for other in self.others]
        first = np.concatenate([[0], np.cumsum([len(other) for other in others])])
        shape = np.array([self.rounding, _REACH, _RIM, _MARGIN, self.end])
        stacked = np.vstack(others)
        # The cut is as wide as the root; a twig may well extend below it.
        root = self.base[0]
        beside = np.linalg.norm(np.maximum(np.maximum(low - root, root - high), 0)) > self.wide
        base = self.base - np.outer([1e6 * self.wide, 0], self.base[1]) if beside else self.base

        def level(points: np.ndarray) -> np.ndarray:
            return fillet_level(np.ascontiguousarray(points), twig, stacked, first, self.excess,
                                base, shape)

        made = level_surface(level, low, high, step)
        if len(made.faces) == 0:
            return None
        return largest_piece(solid(made.vertices, made.faces).simplify(
            _COARSENED * self.rounding))


def _forks(skeleton: Skeleton, sides: int | None, spacing: float) -> list[_Fork]:
    """Twigs that come out of their parents."""
    excess = np.array([polygon_factor(n) - 1 for n in sides_of_runs(skeleton, sides)])
    runs = skeleton.runs()
    axes = [run_axis(skeleton, run, spacing) for run in range(skeleton.branch_count)]
    cones = [segments(*axis) for axis in axes]
    points, radius = axes[0]
    upwards = tangents(points)[0]
    # Slightly above the root's flat cut, so that a fillet's end is within the solid.
    base = np.stack([points[0] + 0.05 * radius[0] * upwards, upwards])
    carrier = [-1] + [int(skeleton.branch[members[0]]) for members in runs[1:]]
    starts = np.array([axis[0][0] for axis in axes])
    forks = []
    for run in range(1, skeleton.branch_count):
        parent = carrier[run]
        reach = 4 * skeleton.radius[runs[run][0]]
        near = [other for other in range(1, skeleton.branch_count)
                if other != run and carrier[other] == parent
                and np.linalg.norm(starts[other] - starts[run]) < reach]
        others = [parent, *near, *([carrier[parent]] if carrier[parent] >= 0 else [])]
        fork = _fork(run, axes[run], cones[run], tuple(cones[other] for other in others),
                     excess[[run, *others]], base, 1.5 * float(radius[0]))
        if fork is not None:
            forks.append(fork)
    return forks


def _fork(run: int, axis: tuple[np.ndarray, np.ndarray], twig: np.ndarray,
          others: tuple[np.ndarray, ...], excess: np.ndarray, base: np.ndarray, wide: float,
          ) -> _Fork | None:
    """Position where a twig leaves its carrier; None if it stays within."""
    along = np.append(twig[:, 8], twig[-1, 8] + twig[-1, 9])
    count = max(int(4 * along[-1] / axis[1].mean()), 8)
    arc = np.linspace(0, along[-1], count + 1)
    points = np.stack([np.interp(arc, along, axis[0][:, k]) for k in range(3)], axis=1)
    radius = np.interp(arc, along, axis[1])
    found = [distances(other, points) for other in others]
    which = np.argmin([distance for distance, _ in found], axis=0)
    outside = np.min([distance for distance, _ in found], axis=0)
    if (outside + radius < 0).all():
        return None
    leaving = np.flatnonzero(outside > 0)
    at = leaving[0] if len(leaving) else count
    thick = float(found[which[at]][1][at])
    rounding = ROUNDING * min(float(radius[at]), thick)
    reach = radius + _REACH * rounding
    begin = np.flatnonzero(outside > -reach)[0]
    clear = np.flatnonzero(outside[begin:] > reach[begin:])
    end = begin + clear[0] if len(clear) else count
    longest = arc[begin] + _LONGEST * (radius[at] + thick)
    fades = arc[end] > longest
    stretch = np.column_stack([points, radius])[begin:end + 1]
    if fades:
        stretch = stretch[arc[begin:end + 1] <= longest + 2 * radius[at]]
    return _Fork(run, twig, others, excess, base, wide, rounding, stretch,
                 float(longest) if fades else np.inf)


def _joined(solids: list, tolerance: float) -> Surface | None:
    """The union of the cylinders and the fillets; None if that is empty."""
    import manifold3d

    joined = manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add).simplify(tolerance)
    try:
        return largest_piece(joined)
    except MeshingError:
        return None
