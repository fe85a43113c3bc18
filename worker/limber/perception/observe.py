"""Pulls from depth frames: the branch's curve is found in each, and tracked from frame to frame."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from limber.core.errors import Command, InputError, Option
from limber.core.numerics.rigid import poses_at, rotation_angle, rotation_matrix
from limber.core.progress import SILENT, Progress
from limber.geometry.cloud.camera import Camera, SeenCloud, depth_to_cloud, read_camera, read_mask
from limber.geometry.io.depth_images import depth_metres
from limber.geometry.skeleton.skeleton import Skeleton
from limber.recordings.image_folders import segment_by_depth
from limber.recordings.recording import Observations, Pull

# Control points followed through partial, noisy, one-sided clouds.
#
# A curve of fixed length (above) is fitted to each cloud, starting from
# the frame before. A cloud's point says two things about the curve beside it: along the line of
# sight the visible side of a round branch lies sqrt(r^2 - l^2) in front of the axis, l being how
# far beside the axis the line passes; and, over many points, l is zero in the mean. Both hold
# under depth noise larger than the branch, where a distance to the axis would be biased.

# The main path of a branch as a curve that bends and twists but keeps its length.
#
# The base stays, every piece of the curve turns: a rotation a segment, changed by a rotation
# field that is piecewise linear between a few knots. Arc length therefore names a material point.

@dataclass(frozen=True)
class RestCurve:
    """A branch at rest: main path [n, 3] and side nodes [s, 3] [m], arc length and radius of the
    path [n] [m], each knot's hat function at segments' middles [n - 1, knots], and the path's node
    that each side node hangs on [s]."""

    nodes: np.ndarray
    arc: np.ndarray
    radius: np.ndarray
    hats: np.ndarray
    side_nodes: np.ndarray
    side_root: np.ndarray

    @property
    def length(self) -> float:
        return float(self.arc[-1])

    @classmethod
    def of(cls, skeleton: Skeleton, *, node_count: int = 81, knot_count: int = 8) -> "RestCurve":
        """Resample a skeleton's main path; what hangs beside it is carried along."""
        path = skeleton.main_path()
        along = skeleton.arc_length[path]
        arc = np.linspace(0.0, along[-1], node_count)
        nodes = np.column_stack([np.interp(arc, along, axis) for axis in skeleton.nodes[path].T])
        radius = np.interp(arc, along, skeleton.radius[path])
        middle = (arc[1:] + arc[:-1]) / 2
        # No knot at the base: the branch is rooted there and does not turn.
        knots = np.linspace(0.0, along[-1], knot_count + 1)
        hats = np.column_stack([np.interp(middle, knots, row)
                                for row in np.eye(knot_count + 1)[1:]])
        side = np.setdiff1d(np.arange(skeleton.node_count), path)
        root = _fork_arc(skeleton, path)[side]
        side_root = np.clip(np.searchsorted(arc, root), 0, node_count - 1)
        return cls(nodes, arc, radius, hats, skeleton.nodes[side], side_root)

    def start(self) -> "BentCurve":
        """Return the curve at rest."""
        turns = np.broadcast_to(np.eye(3), (len(self.nodes) - 1, 3, 3)).copy()
        return BentCurve(self, turns, np.zeros((self.hats.shape[1], 3)))


@dataclass(frozen=True)
class BentCurve:
    """A state of a :class:`RestCurve`: each segment's rotation against rest [n - 1, 3, 3], and the
    sum of rotation steps at each knot [knots, 3] [rad], which is no rotation vector."""

    rest: RestCurve
    turns: np.ndarray
    knots: np.ndarray

    @property
    def nodes(self) -> np.ndarray:
        """Positions [m], shape [n, 3]."""
        steps = np.einsum("nij,nj->ni", self.turns, np.diff(self.rest.nodes, axis=0))
        return self.rest.nodes[0] + np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])

    @property
    def side_nodes(self) -> np.ndarray:
        """Positions of side branches, carried rigidly [m], shape [s, 3]."""
        at = self.rest.side_root
        arm = self.rest.side_nodes - self.rest.nodes[at]
        turn = self.turns[np.minimum(at, len(self.turns) - 1)]
        return self.nodes[at] + np.einsum("nij,nj->ni", turn, arm)

    def at(self, arc: np.ndarray) -> np.ndarray:
        """Positions [m] at arc lengths [m], shape [m, 3]."""
        nodes = self.nodes
        return np.column_stack([np.interp(arc, self.rest.arc, axis) for axis in nodes.T])

    def turned(self, step: np.ndarray) -> "BentCurve":
        """Return the curve after a rotation step [rad] at the knots, shape [knots, 3]."""
        field = rotation_matrix(self.rest.hats @ step)
        return replace(self, turns=field @ self.turns, knots=self.knots + step)

    def jacobian(self) -> np.ndarray:
        """Derivative [n, 3, knots, 3] of the nodes [m] to a rotation step at the knots. A rotation
        d of a segment moves all nodes after it by d x (the segment's vector)."""
        steps = np.einsum("nij,nj->ni", self.turns, np.diff(self.rest.nodes, axis=0))
        cross = np.zeros((len(steps), 3, 3))
        cross[:, 0, 1], cross[:, 0, 2] = steps[:, 2], -steps[:, 1]
        cross[:, 1, 0], cross[:, 1, 2] = -steps[:, 2], steps[:, 0]
        cross[:, 2, 0], cross[:, 2, 1] = steps[:, 1], -steps[:, 0]
        each = np.einsum("nij,nk->nikj", cross, self.rest.hats)
        return np.concatenate([np.zeros((1, *each.shape[1:])), np.cumsum(each, axis=0)])


def _fork_arc(skeleton: Skeleton, path: np.ndarray) -> np.ndarray:
    """Arc length at which each node's ancestry leaves the main path [m], shape [nodes]."""
    arc = np.full(skeleton.node_count, np.nan)
    arc[path] = skeleton.arc_length[path]
    for node in range(skeleton.node_count):
        if np.isnan(arc[node]):
            arc[node] = arc[skeleton.parent[node]]
    return arc


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
        self._point_limit, self._rng = point_limit, np.random.default_rng(seed)
        self.roughness = 0.0

    def learn_surface(self, cloud: SeenCloud) -> None:
        """Take from a cloud of the branch at rest how far bark stands off a round tube, besides the
        camera's noise [m]. Taken for noise alone, half of a rough branch's points were outliers."""
        match = _match(self.rest.start(), cloud, 0.0)
        off, noise = np.abs(match.residuals[0]), np.median(cloud.sigma[match.rows])
        self.roughness = float(np.sqrt(max((1.4826 * np.median(off))**2 - noise**2, 0.0)))

    def track(self, cloud: SeenCloud, before: BentCurve | None = None,
              anchor: Anchor | None = None) -> TrackedFrame:
        """Fit the curve to a cloud, starting from the frame ``before`` (None: rest). With fewer
        than 10 points the curve stays where it was, with nothing visible."""
        curve = before or self.rest.start()
        cloud = self.thinned(cloud)
        cloud = replace(cloud, sigma=np.hypot(cloud.sigma, self.roughness))
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
        return self._result(curve, _spread(curve, cloud, anchor), arcs,
                            len(arcs) / len(cloud.points))

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
    scale = np.r_[np.full(3, 2 / tracker.rest.length), np.ones(3)]
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
    nodes, spacing = curve.nodes, curve.rest.arc[1]
    distance, nearest = cKDTree(np.vstack([nodes, curve.side_nodes])).query(cloud.points)
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
    count = curve.rest.hats.shape[1]
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


CAMERA_OFFSET_M = 4e-3
"""Error of a camera pose at the branch above which it is corrected, with a warning [m]."""
LASTING_SIGMA_M = 2e-4
"""How far a tube of the skeleton's radii stands beside the branch [m]: a share of a point's error
that is alike in all frames of one bend. A tracker's covariance, right frame by frame, lacks it."""


@dataclass
class _Notes:
    empty: list[str] = field(default_factory=list)
    hidden: int = 0
    messages: list[str] = field(default_factory=list)


def observe(folder: Path, pull: Pull, skeleton: Skeleton, fractions: tuple[float, ...], *,
            progress: Progress = SILENT) -> tuple[Observations, list[str]]:
    """Find the control points, at ``fractions`` of the main path, in all frames of a pull; NaN
    where not visible. Returns warnings too. The first frame shows the branch at rest: it corrects
    the camera's pose. InputError if there are no frames, or the branch is in none."""
    frames = list_frames(folder, pull.entry.observation)
    load = _loader(folder, pull.entry.observation)
    tracker = CurveTracker(skeleton, fractions)
    notes, curve, correction, sight = _Notes(), None, None, None
    count = len(frames)
    positions = np.full((count, len(fractions), 3), np.nan)
    covariance = np.broadcast_to(np.eye(3), (*positions.shape, 3)).copy()
    times = np.array([time for time, _ in frames])
    poses = poses_at(pull.times, pull.poses,
                     np.clip(times + pull.entry.time_offset_s, pull.times[0], pull.times[-1]))
    for index, (_, path) in enumerate(frames):
        progress(index / count, "tracking the control points", frame=index)
        cloud = load(path)
        if len(cloud.points) < 10:
            notes.empty.append(path.stem)
            continue
        if not np.any(cloud.view):
            # Judged once, at rest: later the branch is elsewhere than its skeleton.
            sight = _line_of_sight(cloud, skeleton) if sight is None else sight
            cloud = replace(cloud, view=np.broadcast_to(sight, cloud.points.shape).copy())
        if correction is None:
            correction = _camera_correction(tracker, cloud, poses[index], poses[0], notes)
        cloud = _moved(cloud, *correction)
        tracked = tracker.track(cloud, curve, _anchor(tracker, pull, poses[index]))
        curve = tracked.curve
        notes.hidden += int(np.sum(~tracked.visible))
        positions[index, tracked.visible] = tracked.positions[tracked.visible]
        covariance[index] = tracked.covariance + LASTING_SIGMA_M**2 * np.eye(3)
    if len(notes.empty) == count:
        raise InputError(f"{folder}: the branch was not found in any of the {count} frames.",
                         "All masks are empty, or no points lie within the depth range.",
                         "Check the masks and the camera's depth_scale.")
    return Observations(times, positions, covariance), _sentences(pull.name, notes, count)


def list_frames(folder: Path, kind: str) -> list[tuple[float, Path]]:
    """Return time stamp [s] and file of each frame; stamps are the files' names."""
    sub, suffix = ("clouds", ".ply") if kind == "clouds" else ("depth", ".png")
    files = sorted((Path(folder) / sub).glob(f"*{suffix}"))
    try:
        frames = sorted((float(path.stem), path) for path in files)
    except ValueError as error:
        raise InputError(f"{folder}/{sub}: {error}.", "File names must be time stamps in seconds.",
                         "Import the frames with ",
                         Command("import-pull", Option("rate_hz"), "..."), ".") from error
    if len(frames) < 2:
        raise InputError(f"{folder}/{sub} has {len(frames)} frames.", "At least two are needed.",
                         "Import the recording again.")
    return frames


def write_depth(path: Path, depth: np.ndarray, camera: Camera) -> None:
    """Write depth [m] as a 16-bit PNG."""
    from PIL import Image

    steps = np.clip(np.round(depth * camera.depth_scale), 0, 65535).astype(np.uint16)
    Image.fromarray(steps).save(path)


def _loader(folder: Path, kind: str) -> Callable[[Path], SeenCloud]:
    camera_path = folder / "camera.toml"
    if kind == "clouds":
        camera = read_camera(camera_path) if camera_path.exists() else None
        return lambda path: _read_cloud(path, camera)
    camera = read_camera(camera_path)
    empty_scene = folder / "background.png"
    background = depth_metres(empty_scene, camera) if empty_scene.exists() else None

    def load(path: Path) -> SeenCloud:
        mask_path = folder / "mask" / path.name
        mask = read_mask(mask_path) if mask_path.exists() else None
        depth = depth_metres(path, camera, mask)
        return depth_to_cloud(camera, depth, segment_by_depth(
            depth, background=background) if mask is None else mask)
    return load


def _read_cloud(path: Path, camera: Camera | None) -> SeenCloud:
    from limber.geometry.io.clouds import read_cloud

    try:
        points = read_cloud(path, unit="m").points
    except InputError:
        # An empty frame is no reason to give up the others; it is named in the warnings.
        points = np.empty((0, 3))
    points = points[np.isfinite(points).all(axis=1)]
    if camera is None:
        return SeenCloud(points, np.full(len(points), 2e-3), np.zeros((len(points), 3)))
    ray = points - camera.origin
    distance = np.linalg.norm(ray, axis=1)
    return SeenCloud(points, camera.depth_sigma(distance), ray / distance[:, None])


def _line_of_sight(cloud: SeenCloud, skeleton: Skeleton) -> np.ndarray:
    """Guess it where no camera is known: from the seen side towards the axis, shape [3]."""
    inward = np.median(skeleton.nodes[cKDTree(skeleton.nodes).query(cloud.points)[1]]
                       - cloud.points, axis=0)
    return inward / max(np.linalg.norm(inward), 1e-12)


def _moved(cloud: SeenCloud, turn: np.ndarray, shift: np.ndarray) -> SeenCloud:
    return SeenCloud(cloud.points @ turn.T + shift, cloud.sigma, cloud.view @ turn.T)


def _camera_correction(tracker: CurveTracker, cloud: SeenCloud, pose: np.ndarray,
                       rest_pose: np.ndarray, notes: _Notes) -> tuple[np.ndarray, np.ndarray]:
    nothing = np.eye(3), np.zeros(3)
    if np.linalg.norm(pose[:3] - rest_pose[:3]) > 2e-3:
        notes.messages.append("the branch is already pulled in the first usable frame. The "
                              "camera's pose could not be checked.")
        return nothing
    turn, shift = rest_offset(tracker, cloud)
    tracker.learn_surface(_moved(cloud, turn, shift))
    moved = np.linalg.norm(tracker.rest.nodes @ turn.T + shift - tracker.rest.nodes, axis=1)
    if moved.max() <= CAMERA_OFFSET_M:
        return nothing
    angle = np.degrees(rotation_angle(turn))
    notes.messages.append(
        f"the camera's pose has an error of up to {moved.max() * 1e3:.0f} mm and {angle:.1f} "
        "degrees at the branch at rest. The frames were moved onto the branch. Calibrate the "
        "camera again.")
    return turn, shift


def _anchor(tracker: CurveTracker, pull: Pull, pose: np.ndarray) -> Anchor:
    held = np.array(pull.entry.grasp.point_m)
    arc = tracker.arc_near(held)
    arm = tracker.rest.start().at(np.array([arc]))[0] - held
    return Anchor(arc, pose[:3] + rotation_matrix(pose[3:]) @ arm)


def _sentences(name: str, notes: _Notes, count: int) -> list[str]:
    found = [f"{name}: {message}" for message in notes.messages]
    if notes.empty:
        found.append(f"{name}: {len(notes.empty)} of {count} frames do not show the branch and "
                     f"were discarded. The first is at {notes.empty[0]} s.")
    if notes.hidden:
        found.append(f"{name}: control points were hidden {notes.hidden} times. They are not used "
                     "in those frames.")
    return found
