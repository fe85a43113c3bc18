"""Axes and radii of branches that one sensor saw, from their width across its sight.

A scanner's or a camera's rays are evenly spaced, and their readings err along the ray. So points
lie evenly across a branch as the sensor saw it, from edge to edge, however far their ranges are
off. The edges show its radius and its middle; ranges only show its depth. A circle fitted to such
points by their distance from it comes out up to half too thin.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy

from limber.geometry.cloud.single_view import View
from limber.geometry.skeleton.radii.fit_kernels import on_cylinders
from limber.geometry.skeleton.skeleton import INTERPOLATED, MEASURED, Skeleton
from limber.geometry.skeleton.sweep import arc_lengths

_ROUNDS = 3
_NEAR = 30  # points to each side along the axis, whose spread is one width, at least
_LONG, _REACH = 2.0, 8.0  # radii to each side, at least and at most
_LEAST = 8  # points that make a width
_STRIPS = 9  # neighbouring nodes of which the median width counts
# Fraction of the points beyond each edge of what is measured: stray ones are there, and a quantile
# of so many is known to half the radius over the square root of their number.
_TAIL, _QUANTILE_SIGMA = 0.1, 0.5
_ASIDE = 0.5  # sine of the angle between axis and sight, from which a width shows
_BESIDE = 3.0  # radii across, from which a point belongs to something else
_CHANGE = 3.0  # times a radius of the fit by distances, and of these that its axis may move
_PRIOR = 0.03  # weight of the mean normal as the sight, against that of all points
_RISE = np.pi / 4  # mean height of a half circle over its chord
_HALF_CIRCLE = np.pi / 4  # length of the mean normal of points evenly spread across


@dataclass(frozen=True)
class SightField:
    """Directions towards one sensor: ``towards - nearer * (place - middle)``, made unit vectors;
    ``nearer`` is the inverse of its distance [1/m]."""

    towards: np.ndarray
    nearer: float
    middle: np.ndarray

    def at(self, places: np.ndarray) -> np.ndarray:
        """Unit vectors towards the sensor at places [m], shape [n, 3]."""
        direction = self.towards - self.nearer * (places - self.middle)
        return direction / np.maximum(np.linalg.norm(direction, axis=1), 1e-300)[:, None]


def sight_field(skeleton: Skeleton, points: np.ndarray, view: View | None = None) -> SightField:
    """Where one sensor stood: its ``view``, or from the sides of branches that have points: across
    each axis, the mean normal of its points points to the sensor."""
    if view is not None:
        middle = points.mean(axis=0)
        far = float(np.linalg.norm(view.eye - middle))
        return SightField((view.eye - middle) / far, 1 / far, middle)
    _, high, _, offset = on_cylinders(skeleton, points)
    axis = skeleton.axes()
    size = np.linalg.norm(offset, axis=1)
    near = size < _BESIDE * skeleton.radius[high]
    out = offset[near] / np.maximum(size[near], 1e-300)[:, None]
    count = np.bincount(high[near], minlength=skeleton.node_count)
    used = np.flatnonzero(count >= _LEAST)
    mean = np.stack([np.bincount(high[near], column, skeleton.node_count) for column in out.T],
                    axis=1)[used] / _HALF_CIRCLE
    across = np.eye(3) - axis[used][:, :, None] * axis[used][:, None, :]
    middle = points.mean(axis=0)
    offset = np.einsum("nij,nj->ni", across, skeleton.nodes[used] - middle)
    system = np.concatenate([across * count[used, None, None],
                             -(count[used, None] * offset)[:, :, None]], axis=2).reshape(-1, 4)
    normal = system.T @ system
    scale = max(float(np.trace(normal[:3, :3])) / 3, 1e-12)
    extent = max(float(np.linalg.norm(np.ptp(skeleton.nodes, axis=0))), 1e-12)
    # A direction along all axes does not show, nor does the distance of a far sensor.
    held = _PRIOR * scale * np.array([1, 1, 1, extent**2])
    expected = np.append(mean.sum(axis=0) / max(float(np.linalg.norm(mean.sum(axis=0))), 1e-300), 0)
    found = np.linalg.solve(normal + np.diag(held), system.T @ mean.reshape(-1) + held * expected)
    size = max(float(np.linalg.norm(found[:3])), 1e-300)
    return SightField(found[:3] / size, float(max(found[3], 0.0)) / size, middle)


def by_projected_widths(skeleton: Skeleton, points: np.ndarray, view: View | None = None,
                        ) -> tuple[Skeleton, SightField]:
    """Return the skeleton with axes and radii by the width of its points, and the sight."""
    field, start = sight_field(skeleton, points, view), skeleton
    for _ in range(_ROUNDS):
        skeleton = _near(start, _moved(skeleton, points, field))
        field = sight_field(skeleton, points, view)
    return skeleton, field


def _near(start: Skeleton, moved: Skeleton) -> Skeleton:
    """Limit what widths may change: those of crossing branches, or of few points, show nothing."""
    radius = np.clip(moved.radius, start.radius / _CHANGE, start.radius * _CHANGE)
    shift = moved.nodes - start.nodes
    size = np.linalg.norm(shift, axis=1)
    shift *= np.minimum(1.0, _CHANGE * start.radius / np.maximum(size, 1e-300))[:, None]
    return replace(moved, nodes=start.nodes + shift, radius=radius)


def _moved(skeleton: Skeleton, points: np.ndarray, field: SightField) -> Skeleton:
    """One round: each run by the points that are nearest to it."""
    low, high, share, offset = on_cylinders(skeleton, points)
    axis = skeleton.axes()
    beside, depth, aside = _across_sight(offset, axis[high], field.at(points))
    good = (aside > _ASIDE) & (np.abs(beside) < _BESIDE * skeleton.radius[high])
    nodes, radius = skeleton.nodes.copy(), skeleton.radius.copy()
    sigma, state = skeleton.radius_sigma.copy(), skeleton.radius_state.copy()
    branch = skeleton.branch[high]
    for run, (members, own) in enumerate(zip(skeleton.runs(), skeleton.own_runs(), strict=True)):
        along = arc_lengths(skeleton.nodes[members])
        place = np.zeros(skeleton.node_count)
        place[members] = along
        inside = np.flatnonzero(good & (branch == run))
        if len(inside) < _LEAST:
            continue
        at = place[low[inside]] + share[inside] * (place[high[inside]] - place[low[inside]])
        inside = inside[np.argsort(at, kind="stable")]
        at = np.sort(at, kind="stable")
        widths = np.array([_width(at, beside[inside], depth[inside], here, thick)
                           for here, thick in zip(along[-len(own):], skeleton.radius[own],
                                                  strict=True)])
        known = np.isfinite(widths[:, 0])
        if not known.any():
            continue
        # Gaps are filled; beyond the first and the last place nothing is known.
        within = slice(int(np.argmax(known)), len(known) - int(np.argmax(known[::-1])))
        own, here, known = own[within], along[-len(own):][within], known[within]
        widths = np.stack([np.interp(here, here[known], column[within][known])
                           for column in widths.T], axis=1)
        # Where a twig hides part of its carrier, a few widths are of strips.
        widths = scipy.ndimage.median_filter(widths, size=(_STRIPS, 1), mode="nearest")
        sight = field.at(skeleton.nodes[own])
        side = np.cross(axis[own], sight)
        side /= np.maximum(np.linalg.norm(side, axis=1), 1e-300)[:, None]
        nodes[own] += widths[:, 1:2] * side + widths[:, 2:3] * np.cross(side, axis[own])
        radius[own], sigma[own] = widths[:, 0], widths[:, 3]
        state[own] = np.where(known, MEASURED, INTERPOLATED)
    return replace(skeleton, nodes=nodes, radius=radius, radius_sigma=sigma, radius_state=state)


def cross_sections(skeleton: Skeleton, points: np.ndarray, field: SightField,
                   ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Each point's offset across the sight and towards the sensor [m], and the radius there [m];
    NaN on branches that point to the sensor."""
    _, high, _, offset = on_cylinders(skeleton, points)
    beside, depth, aside = _across_sight(offset, skeleton.axes()[high], field.at(points))
    hidden = aside <= _ASIDE
    return (np.where(hidden, np.nan, beside), np.where(hidden, np.nan, depth),
            skeleton.radius[high])


def _across_sight(offset: np.ndarray, axis: np.ndarray, towards: np.ndarray,
                  ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Offsets from the axis across the sight and towards the sensor, and the sine between axis
    and sight, shape [m] each."""
    across = np.cross(axis, towards)
    aside = np.linalg.norm(across, axis=1)
    across /= np.maximum(aside, 1e-300)[:, None]
    return (np.einsum("ij,ij->i", offset, across),
            np.einsum("ij,ij->i", offset, np.cross(across, axis)), aside)


def _width(at: np.ndarray, beside: np.ndarray, depth: np.ndarray, here: float, thick: float,
           ) -> tuple[float, float, float, float]:
    """Radius, shift across and in depth ``here``, and the radius's deviation [m], from a run's
    points: ``at`` along it, ascending, ``beside`` the axis across the sight, ``depth`` to the
    sensor, all [m]. ``thick`` is the radius so far [m]."""
    middle, (least, most) = int(np.searchsorted(at, here)), (
        np.searchsorted(at, [here - reach * thick, here + reach * thick])
        for reach in (_LONG, _REACH))
    near = slice(max(min(middle - _NEAR, least[0]), most[0]),
                 min(max(middle + _NEAR, least[1]), most[1]))
    if near.stop - near.start < _LEAST:
        return np.nan, 0.0, 0.0, 0.0
    along, side = at[near] - here, beside[near]
    centred = along - along.mean()
    slope = float(centred @ side) / max(float(centred @ centred), 1e-300)
    side = side - slope * along
    count = len(side)
    rank = int(_TAIL * count)
    ordered = np.sort(side)
    first, last = ordered[rank], ordered[count - 1 - rank]
    # Of n even places, the k-th and the k-th last are (n + 1 - 2 k) / (n + 1) of the width apart.
    radius = float(last - first) / 2 * (count + 1) / (count - 1 - 2 * rank)
    shift = float(first + last) / 2
    rise = np.sqrt(np.maximum(radius**2 - (side - shift)**2, 0.0))
    return (radius, shift, float(np.sort(depth[near] - rise)[count // 2]),
            _QUANTILE_SIGMA * radius / np.sqrt(count))


def width_covariance(skeleton: Skeleton, field: SightField, noise: float) -> np.ndarray:
    """Covariance [n, 4, 4] of positions and radii by widths [m^2]. Across, a width's middle is
    known as its half is. In depth, the axis is behind the front by the mean rise of a circle.
    ``noise`` is that of ranges [m]."""
    across = np.cross(skeleton.axes(), field.at(skeleton.nodes))
    across /= np.maximum(np.linalg.norm(across, axis=1), 1e-300)[:, None]
    towards = np.cross(across, skeleton.axes())
    ways = np.zeros((skeleton.node_count, 3, 4))
    ways[:, 0, :3] = skeleton.radius_sigma[:, None] * across
    ways[:, 1, :3] = -_RISE * skeleton.radius_sigma[:, None] * towards
    ways[:, 1, 3] = skeleton.radius_sigma
    ways[:, 2, :3] = noise / np.sqrt(2 * _NEAR) * towards
    return np.einsum("nki,nkj->nij", ways, ways)


# Check of a skeleton's twigs against their silhouettes in a depth camera's image.
#
# Across the line of sight a depth camera is accurate to a pixel. Along it, readings scatter by
# millimetres or centimetres, correlated over whole patches. So a twig that only sticks out along
# the line of sight is taken for such scatter.


def without_hidden_twigs(skeleton: Skeleton, view: View, factor: float,
                         ) -> tuple[Skeleton, list[dict]]:
    """Drop twigs that do not reach, nor a twig on them, ``factor`` radii of their carrier beyond
    its axis as the camera saw it. Lists each with ``length`` [m] and its tip ``at``."""
    runs = skeleton.runs()
    keep = np.ones(skeleton.node_count, bool)
    dropped = []
    carriers = {int(skeleton.branch[members[0]]) for members in runs[1:]}
    for run in range(len(runs) - 1, 0, -1):
        # A twig with twigs of its own is never dropped: it carries too much.
        if run in carriers:
            continue
        members = runs[run]
        carrier = runs[int(skeleton.branch[members[0]])]
        reach, radius = _beyond(skeleton, members[1:], carrier, view)
        if reach < factor * radius:
            keep[members[1:]] = False
            dropped.append({"length": _length(skeleton.nodes[members]),
                            "at": skeleton.nodes[members[-1]]})
    return (skeleton.subset(keep), dropped) if dropped else (skeleton, [])


def _beyond(skeleton: Skeleton, twig: np.ndarray, carrier: np.ndarray, view: View,
            ) -> tuple[float, float]:
    """Reach of a twig beside its carrier's axis in the image [m], and the carrier's radius [m]."""
    nodes = skeleton.nodes
    depth = float(np.linalg.norm(nodes[twig].mean(axis=0) - view.eye))
    twig_ray, carrier_ray = _rays(nodes[twig], view), _rays(nodes[carrier], view)
    start, end = carrier_ray[:-1], carrier_ray[1:]
    axis = end - start
    share = np.einsum("tkj,kj->tk", twig_ray[:, None] - start, axis) / np.maximum(
        np.einsum("kj,kj->k", axis, axis), 1e-300)
    foot = start + np.clip(share, 0, 1)[..., None] * axis
    distance = np.linalg.norm(twig_ray[:, None] - foot, axis=2)
    nearest = distance.argmin(axis=1)
    aside = distance[np.arange(len(twig)), nearest] * depth
    best = int(np.argmax(aside / skeleton.radius[carrier[1:]][nearest]))
    return float(aside[best]), float(skeleton.radius[carrier[1:]][nearest[best]])


def _rays(points: np.ndarray, view: View) -> np.ndarray:
    offset = points - view.eye
    return offset / np.linalg.norm(offset, axis=1)[:, None]


def _length(nodes: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(nodes, axis=0), axis=1).sum())
