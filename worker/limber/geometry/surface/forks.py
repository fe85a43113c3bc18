"""Fillets where twigs leave their parents, instead of the sharp creases of a plain union.

Around each crease a solid is added whose surface is that of a rounded union of twig and parent.
With a and b the distances from the two and rho the fillet's radius,

    max(rho, min(a, b)) = sqrt(max(rho - a, 0)^2 + max(rho - b, 0)^2).

It reaches about a twig's radius beyond the crease, is slightly above the cylinders near it and
below them at its rim, and is joined to them as a solid. The result is closed for any angle of the
fork and any number of twigs there.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from limber.core.errors import MeshingError
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.skeleton.sweep import polygon_factor, tangents
from limber.geometry.surface.cross_sections import SPACING, run_axis, sides_of_runs
from limber.geometry.surface.implicit_surface import level_surface
from limber.geometry.surface.rounded_union import distances, fillet_level, near_box, segments
from limber.geometry.surface.surface import Surface
from limber.geometry.surface.surface_checks import SurfaceCheck, check_surface, crossings
from limber.geometry.surface.tubes import largest_piece, solid

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
    """Round the creases between twigs and their parents.

    Args:
        surface: The union of the cylinders, :func:`branch_surface`: closed, oriented, not
            crossing itself.
        skeleton: The axes and radii from which it was made.
        sides: The sides with which it was made.
        spacing: The spacing with which it was made.

    Returns:
        The surface, within 2 % of the volume; its check; and warnings about forks that stayed
        sharp.
    """
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
    """A fillet from another lattice that crosses nothing around it; None if there is none.

    Args:
        fork: The fork.
        first: The solid that crosses something.
        others: The solids that it joins.
        tolerance: How far triangles may move when they are joined [m].
    """
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
