"""Control points followed through partial, noisy, one-sided clouds.

A curve of fixed length (:mod:`limber.perception.curve`) is fitted to each cloud, starting from
the frame before. A cloud's point says two things about the curve beside it: along the line of
sight the visible side of a round branch lies sqrt(r^2 - l^2) in front of the axis, l being how
far beside the axis the line passes; and, over many points, l is zero in the mean. Both hold
under depth noise larger than the branch, where a distance to the axis would be biased.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from limber.core.numerics.rigid import rotation_matrix
from limber.geometry.cloud.camera import SeenCloud
from limber.geometry.skeleton.skeleton import Skeleton
from limber.perception.curve import BentCurve, RestCurve

BEND_SIGMA = 0.6
"""Prior standard deviation of the turn between two knots [rad]."""
SMOOTH_SIGMA = 0.2
"""Prior standard deviation of the change of that turn from knot to knot [rad]."""
SEEN_SHARE = 0.01
"""A direction of a rigid motion counts as seen from this share of the best one's information."""
PIECES = 80
"""Pieces of the curve whose points' errors are taken to be independent of the next one's."""
MODEL_SIGMA_M = 5e-5
"""Error of a tube of the skeleton's radii as a model of the branch [m]; added to the covariance."""


@dataclass(frozen=True)
class TrackedFrame:
    """Control points on the axis [K, 3] [m] in a frame, their covariance [K, 3, 3] [m^2], and
    whether the cloud shows the branch around each; the share of its points that the curve explains,
    and that curve, the next frame's start."""

    positions: np.ndarray
    covariance: np.ndarray
    visible: np.ndarray
    inlier_share: float
    curve: BentCurve


@dataclass(frozen=True)
class Anchor:
    """A material point with a known position [3] and deviation [m], where the gripper holds;
    ``arc`` is the arc length [m] of the curve's point nearest to the grasp."""

    arc: float
    position: np.ndarray
    sigma: float = 1.5e-3


class CurveTracker:
    """Follows the control points of one branch; frames must come in the order of time."""

    def __init__(self, skeleton: Skeleton, fractions: tuple[float, ...], *,
                 point_limit: int = 2500, seed: int = 0):
        self.rest = RestCurve.of(skeleton)
        self.arcs = np.array(fractions) * self.rest.length
        self._point_limit = point_limit
        self._rng = np.random.default_rng(seed)

    def track(self, cloud: SeenCloud, before: BentCurve | None = None,
              anchor: Anchor | None = None) -> TrackedFrame:
        """Fit the curve to a cloud, starting from the frame ``before`` (None: rest). With fewer
        than 10 points the curve stays where it was, with nothing visible."""
        curve = before or self.rest.start()
        cloud = self.thinned(cloud)
        if anchor is not None:
            curve = _settle(curve, anchor)
        if len(cloud.points) < 10:
            return self._result(curve, np.linalg.inv(_prior(curve)[0]), np.empty(0), 0.0)
        arcs = np.empty(0)
        for reach in (0.12, 0.06, 0.03, *([0.0] * 9)):
            normal, gradient, arcs = _equations(curve, cloud, reach * self.rest.length, anchor)
            step = -np.linalg.solve(normal, gradient).reshape(-1, 3)
            step *= min(1.0, 0.5 / max(np.abs(step).max(), 1e-12))
            curve = curve.turned(step)
            if reach == 0.0 and np.abs(step).max() < 1e-5:
                break
        share = len(arcs) / len(cloud.points)
        return self._result(curve, _spread(curve, cloud, anchor), arcs, share)

    def arc_near(self, point: np.ndarray) -> float:
        """Return the arc length [m] of the point at rest that is nearest to ``point``."""
        return float(self.rest.arc[np.argmin(np.linalg.norm(self.rest.nodes - point, axis=1))])

    def _result(self, curve: BentCurve, spread: np.ndarray, arcs: np.ndarray, share: float,
                ) -> TrackedFrame:
        jacobian = _interpolated(curve, self.arcs).reshape(len(self.arcs), 3, -1)
        covariance = np.einsum("kia,ab,kjb->kij", jacobian, spread, jacobian)
        covariance += MODEL_SIGMA_M**2 * np.eye(3)
        window = self.rest.length / 16
        support = np.array([np.sum(np.abs(arcs - arc) < window) for arc in self.arcs])
        return TrackedFrame(curve.at(self.arcs), covariance, support >= 5, share, curve)

    def thinned(self, cloud: SeenCloud) -> SeenCloud:
        """Return a random selection of a cloud's points if it has more than needed."""
        count = len(cloud.points)
        if count <= self._point_limit:
            return cloud
        kept = np.sort(self._rng.choice(count, self._point_limit, replace=False))
        return SeenCloud(cloud.points[kept], cloud.sigma[kept], cloud.view[kept])


def rest_offset(tracker: CurveTracker, cloud: SeenCloud) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation [3, 3] and translation [3] [m] that take a cloud of the branch at rest onto
    its skeleton: the camera pose's error."""
    curve = tracker.rest.start()
    centre = curve.nodes.mean(axis=0)
    rotation, shift = np.eye(3), np.zeros(3)
    cloud = tracker.thinned(cloud)
    lever = tracker.rest.length / 2
    scale = np.r_[np.full(3, 1 / lever), np.ones(3)]
    for reach in (0.2, 0.1, 0.05, 0.05, *([0.0] * 8)):
        moved = SeenCloud((cloud.points - centre) @ rotation.T + centre + shift,
                          cloud.sigma, cloud.view @ rotation.T)
        match = _match(curve, moved, reach * tracker.rest.length)
        points = moved.points[match.rows] - centre
        jacobian = np.concatenate([
            np.hstack([np.cross(points, direction), direction]) for direction in match.directions])
        residual, weight = np.concatenate(match.residuals), np.concatenate(match.weights)
        jacobian = jacobian * scale
        scaled = jacobian.T * weight
        values, directions = np.linalg.eigh(scaled @ jacobian)
        # A slide along the branch, or a turn about it, shows in its taper and bow alone, if at
        # all: errors of the model there would be taken for a motion.
        seen = directions[:, values > SEEN_SHARE * values[-1]]
        step = -scale * (seen @ np.linalg.solve(
            seen.T @ (scaled @ jacobian) @ seen, seen.T @ (scaled @ residual)))
        turn = rotation_matrix(step[:3])
        rotation, shift = turn @ rotation, turn @ shift + step[3:]
    return rotation, centre + shift - rotation @ centre


def _equations(curve: BentCurve, cloud: SeenCloud, reach: float, anchor: Anchor | None,
               ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Normal matrix, gradient and the arc lengths of the points that were used."""
    match = _match(curve, cloud, reach)
    at = _interpolated(curve, match.arcs).reshape(len(match.arcs), 3, -1)
    normal, gradient = _prior(curve)
    for direction, value, strength in zip(match.directions, match.residuals, match.weights,
                                          strict=True):
        jacobian = -np.einsum("ni,nia->na", direction, at)
        normal = normal + (jacobian.T * strength) @ jacobian
        gradient = gradient + jacobian.T @ (strength * value)
    if anchor is not None:
        jacobian = _interpolated(curve, np.array([anchor.arc])).reshape(3, -1)
        off = curve.at(np.array([anchor.arc]))[0] - anchor.position
        normal = normal + jacobian.T @ jacobian / anchor.sigma**2
        gradient = gradient + jacobian.T @ off / anchor.sigma**2
    return normal, gradient, match.arcs[match.inlier]


def _spread(curve: BentCurve, cloud: SeenCloud, anchor: Anchor | None) -> np.ndarray:
    """Covariance of the knots' turns, from the scatter of whole pieces of the curve (sandwich of
    Huber and White, clustered by arc length). Pixels beside each other add up to nearly nothing,
    flying ones do not: as independent errors they make it tenfold too large."""
    normal, _, _ = _equations(curve, cloud, 0.0, anchor)
    match = _match(curve, cloud, 0.0)
    at = _interpolated(curve, match.arcs).reshape(len(match.arcs), 3, -1)
    score = np.zeros((len(match.arcs), normal.shape[0]))
    for direction, value, strength in zip(match.directions, match.residuals, match.weights,
                                          strict=True):
        score -= np.einsum("ni,nia->na", direction, at) * (strength * value)[:, None]
    piece = np.minimum((match.arcs / curve.rest.length * PIECES).astype(int), PIECES - 1)
    summed = np.zeros((PIECES, normal.shape[0]))
    np.add.at(summed, piece, score)
    seen = len(np.unique(piece))
    inverse = np.linalg.inv(normal)
    prior = _prior(curve)[0]
    if anchor is not None:
        jacobian = _interpolated(curve, np.array([anchor.arc])).reshape(3, -1)
        prior = prior + jacobian.T @ jacobian / anchor.sigma**2
    # The fit has followed the scatter with as many turns as the points determine.
    followed = float(np.trace(inverse @ (normal - prior)))
    freedom = seen / max(seen - followed, 0.25 * seen)
    return inverse @ (freedom * summed.T @ summed + prior) @ inverse


@dataclass(frozen=True)
class _Match:
    """What ``rows``, n points of a cloud on the main path, say: arc lengths of the curve's nearest
    points [m]; directions [n, 3] towards the back and the side, across the axis, with residuals [m]
    and robust weights over variance for both; and whether a point counts."""

    rows: np.ndarray
    arcs: np.ndarray
    directions: tuple[np.ndarray, np.ndarray]
    residuals: tuple[np.ndarray, np.ndarray]
    weights: tuple[np.ndarray, np.ndarray]
    inlier: np.ndarray


def _match(curve: BentCurve, cloud: SeenCloud, reach: float) -> _Match:
    rows, arcs, offset, radius = _feet(curve, cloud, reach)
    back, side, slant = _across(curve, arcs, cloud.view[rows])
    sigma = cloud.sigma[rows] * slant
    beside = np.einsum("ni,ni->n", offset, side)
    depth = np.einsum("ni,ni->n", offset, back)
    depth = depth + np.sqrt(np.maximum(radius**2 - beside**2, 0.0))
    side_sigma = np.sqrt(radius**2 / 3 + (0.3 * sigma)**2)
    wide = 3.0 * sigma + reach
    robust = 1.0 / (1.0 + (depth / wide)**2)**2
    robust = np.where(np.abs(beside) > 2.0 * radius + 2.0 * sigma + reach, 0.0, robust)
    return _Match(rows, arcs, (back, side), (depth, beside),
                  (robust / sigma**2, robust / side_sigma**2), robust > 0.3)


def _feet(curve: BentCurve, cloud: SeenCloud, reach: float,
          ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    nodes = curve.nodes
    distance, nearest = cKDTree(np.vstack([nodes, curve.side_nodes])).query(cloud.points)
    spacing = curve.rest.arc[1]
    radius = np.interp(np.minimum(nearest, len(nodes) - 1), np.arange(len(nodes)),
                       curve.rest.radius)
    mine = (nearest < len(nodes)) & (
        distance < np.hypot(3 * radius + 5 * cloud.sigma, spacing) + reach)
    rows = np.flatnonzero(mine)
    index = nearest[rows]
    tangent = np.gradient(nodes, axis=0)[index]
    tangent /= np.linalg.norm(tangent, axis=1)[:, None]
    beyond = np.einsum("ni,ni->n", cloud.points[rows] - nodes[index], tangent)
    raw = curve.rest.arc[index] + beyond
    # What lies beyond the tip or before the base is not beside the curve.
    inside = (raw > -spacing) & (raw < curve.rest.length + spacing)
    rows, arcs = rows[inside], np.clip(raw[inside], 0.0, curve.rest.length)
    offset = cloud.points[rows] - curve.at(arcs)
    return rows, arcs, offset, np.interp(arcs, curve.rest.arc, curve.rest.radius)


def _across(curve: BentCurve, arcs: np.ndarray, view: np.ndarray,
            ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directions across the axis: away from the camera, and sideways; and the view's slant."""
    tangents = np.gradient(curve.nodes, axis=0)
    tangent = np.column_stack([np.interp(arcs, curve.rest.arc, axis) for axis in tangents.T])
    tangent /= np.linalg.norm(tangent, axis=1)[:, None]
    back = view - np.einsum("ni,ni->n", view, tangent)[:, None] * tangent
    slant = np.maximum(np.linalg.norm(back, axis=1), 0.1)
    back = back / slant[:, None]
    return back, np.cross(tangent, back), slant


def _interpolated(curve: BentCurve, arcs: np.ndarray) -> np.ndarray:
    jacobian = curve.jacobian()
    position = np.clip(arcs / curve.rest.arc[1], 0, len(curve.rest.arc) - 1 - 1e-9)
    low = position.astype(int)
    share = (position - low)[:, None, None, None]
    return (1 - share) * jacobian[low] + share * jacobian[low + 1]


def _prior(curve: BentCurve) -> tuple[np.ndarray, np.ndarray]:
    count = curve.rest.knot_count
    # The first knot's neighbour is the base, which does not turn.
    first = np.eye(count) - np.eye(count, k=-1)
    second = np.diff(first, axis=0)
    matrix = first.T @ first / BEND_SIGMA**2 + second.T @ second / SMOOTH_SIGMA**2
    return np.kron(matrix, np.eye(3)), (matrix @ curve.knots).ravel()


def _settle(curve: BentCurve, anchor: Anchor) -> BentCurve:
    """Bend the curve so that the anchored point is where it is known to be."""
    for _ in range(6):
        normal, _ = _prior(curve)
        jacobian = _interpolated(curve, np.array([anchor.arc])).reshape(3, -1)
        off = curve.at(np.array([anchor.arc]))[0] - anchor.position
        # The smoothest step that does it: weights of the prior, the anchor as a constraint.
        spread = np.linalg.solve(normal, jacobian.T)
        step = -spread @ np.linalg.solve(jacobian @ spread + 1e-10 * np.eye(3), off)
        step *= min(1.0, 0.5 / max(np.abs(step).max(), 1e-12))
        curve = curve.turned(step.reshape(-1, 3))
    return curve
