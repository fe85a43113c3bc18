"""A cloud from one depth camera, viewed as an image again, to find flying pixels.

A depth camera's readings at an edge are between foreground and background, or anywhere. In space
they look like twigs along the line of sight. In the image each differs from the pixels beside it by
more than a surface can change within a pixel.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from limber.core.numerics.rigid import any_normal

_BESIDE = 1.6  # pixels: the eight around a pixel
_REGULAR = 0.6  # 5 % quantile over median of the distances to the nearest pixel; 0.27 at random
_AXIS = np.cos(np.radians(35.0))  # largest angle at which the camera frame's own axis is used
_WIDEST = np.radians(75.0)  # largest angle from the view's centre; no image is wider
_TWO, _THERE = (1.8, 2.2), 0.4  # pixels to the second neighbour; tolerance around a pixel
_LEAST_FILL = 0.1
_NOISE = 3.0  # standard deviations by which neighbours may differ
_FEWEST_READINGS = 200  # fewest readings of an image


@dataclass(frozen=True)
class View:
    """Position [m] [3] from which a cloud was seen, and the width of a pixel at distance 1."""

    eye: np.ndarray
    pitch: float


@dataclass(frozen=True)
class Sight:
    """A cloud as the image of one camera: ``pixels`` [n, 2], ``depth`` [n] [m] along the middle of
    the view, and ``pitch``, the width of a pixel at depth 1."""

    pixels: np.ndarray
    depth: np.ndarray
    pitch: float

    @cached_property
    def fill(self) -> float:
        """Fraction of the pixels on the seen surface that are in the cloud; lower if thinned. It is
        the fraction of the midpoints between pixels two apart with a pixel there."""
        tree = cKDTree(self.pixels)
        pairs = tree.query_pairs(_TWO[1], output_type="ndarray")
        pairs = pairs[np.linalg.norm(np.subtract(*self.pixels[pairs.T]), axis=1) > _TWO[0]]
        if len(pairs) < _FEWEST_READINGS:
            return 1.0
        between = self.pixels[pairs].mean(axis=1)
        is_near = tree.query(between, distance_upper_bound=_THERE)[0] < np.inf
        return max(float(is_near.mean()), _LEAST_FILL)


def find_sight(points: np.ndarray, eye: np.ndarray | None = None,
               forward: np.ndarray | None = None) -> Sight | None:
    """View points [n, 3] [m] from ``eye`` [3] (None: the origin) along ``forward`` [3] (None:
    found). None if that is no image, which has one point for each of evenly spaced pixels. If
    ``eye`` is given, only points too wide apart for one view are refused."""
    if len(points) < _FEWEST_READINGS:
        return None
    offset = points if eye is None else points - eye
    distance = np.linalg.norm(offset, axis=1)
    if distance.min() <= 1e-9 * max(float(distance.max()), 1e-300):
        return None
    ray = offset / distance[:, None]
    forward = _forward(ray) if forward is None else forward
    if forward is None or (ray @ forward).min() < np.cos(_WIDEST):
        return None
    depth = offset @ forward
    right = any_normal(forward)
    image = np.stack([offset @ right, offset @ np.cross(forward, right)], axis=1) / depth[:, None]
    spacing = cKDTree(image).query(image, k=2)[0][:, 1]
    pitch = float(np.median(spacing))
    if pitch <= 0 or (eye is None and np.quantile(spacing, 0.05) < _REGULAR * pitch):
        return None
    return Sight(image / pitch, depth, pitch)


def flying_pixels(sight: Sight, grazing: float, speck: int) -> np.ndarray:
    """Mask [n] of pixels on no surface: fewer than ``speck`` connected ones, with others beside
    them. Noise as of a stereo camera (it grows with depth squared) and a surface at ``grazing``
    [deg] between normal and line of sight explain the depths of connected pixels."""
    depth, count = sight.depth, len(sight.depth)
    # Where pixels are missing, neighbours are farther away.
    pairs = cKDTree(sight.pixels).query_pairs(_BESIDE / np.sqrt(sight.fill), output_type="ndarray")
    one, other = pairs[:, 0], pairs[:, 1]
    mean = (depth[one] + depth[other]) / 2
    step = np.linalg.norm(sight.pixels[one] - sight.pixels[other], axis=1) * sight.pitch * mean
    allowed = np.tan(np.radians(grazing)) * step + _NOISE * np.sqrt(2) * _noise(
        depth, one, other) * mean**2
    held = np.abs(depth[one] - depth[other]) <= allowed
    graph = sparse.coo_matrix((np.ones(held.sum()), (one[held], other[held])), (count, count))
    group = connected_components(graph, directed=False)[1]
    beside = group[pairs[~held]]
    has_edge = np.isin(group, beside[beside[:, 0] != beside[:, 1]])
    return has_edge & (np.bincount(group)[group] < speck)


def _noise(depth: np.ndarray, one: np.ndarray, other: np.ndarray) -> float:
    """Noise of depth at depth 1: pixels against the mean of neighbours inside surfaces."""
    count = len(depth)
    around = np.bincount(one, minlength=count) + np.bincount(other, minlength=count)
    total = np.bincount(one, depth[other], count) + np.bincount(other, depth[one], count)
    inside = around >= 7
    if inside.sum() < _FEWEST_READINGS // 4:
        return 0.0
    off = (depth - total / np.maximum(around, 1))[inside] / depth[inside]**2
    off *= np.sqrt(around[inside] / (around[inside] + 1))
    return float(1.4826 * np.median(np.abs(off - np.median(off))))


def _forward(ray: np.ndarray) -> np.ndarray | None:
    """Middle of the view: the axis of the frame that points there, as in frames of cameras."""
    middle = ray.mean(axis=0)
    length = float(np.linalg.norm(middle))
    if length < 0.3:
        return None
    middle /= length
    axis = np.zeros(3)
    axis[int(np.argmax(np.abs(middle)))] = np.sign(middle[int(np.argmax(np.abs(middle)))])
    return axis if middle @ axis > _AXIS else middle


# Position of an image's camera, found from the order in which a file stores its pixels.
#
# Clouds made of a depth image store its pixels row by row or column by column. All points of a line
# are in one plane with the camera. All these planes meet in the line through the camera along which
# pixels are counted, and along a line the pixels are evenly spaced. So camera and direction of view
# are known even if the cloud was moved or rotated since.

_WINDOW, _STRIDE, _WINDOWS = 10, 5, 4000  # points of a window; its stride; number of windows
_PLANE = 1e-3  # thickness over the narrower extent below which points lie in a plane
_BENT = 0.02  # narrower over longer extent above which the plane is well defined
_PLANAR_WINDOWS, _PLANAR_FRACTION = 20, 0.15  # number and fraction of windows that must be planar
_APART = 0.03  # sine of the angle below which planes are parallel: a sorted grid
_NEAR = 3e-3  # distance of the median plane from the camera, over the cloud's extent
_TUKEY, _EXACT = 4.0, 1e-9  # cut-off in median distances; a median below it is zero
_EVEN = 0.2  # fraction of a pixel by which regular points may deviate
_ROUNDS = 20
_TRIED, _RULERS = 300, 3000  # planes for a first estimate; planes on which it is tested


def scan_line_view(points: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """A camera's position [3] [m] and direction of view [3], from points [n, 3] [m] in the file's
    order. None where that is not the order of an image."""
    if len(points) < _WINDOW:
        return None
    normals, offsets, weight = _planes(points)
    if len(normals) < max(_PLANAR_WINDOWS, _PLANAR_FRACTION * min(len(points) / _STRIDE, _WINDOWS)):
        return None
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    along, point = _common_line(normals, offsets, weight, extent)
    if along is None:
        return None
    offset = points - point
    forward = offset.mean(axis=0) - (offset.mean(axis=0) @ along) * along
    distance = float(np.linalg.norm(forward))
    forward /= distance
    depth = offset @ forward
    if depth.min() <= 0.05 * distance:
        return None
    eye = point + _uniform_position(offset @ along, depth) * along
    offset = points - eye
    column, row = offset @ along / depth, offset @ np.cross(forward, along) / depth
    turn = _turn(column, row)
    if turn is None:
        return None
    forward = np.cos(turn) * forward + np.sin(turn) * np.cross(forward, along)
    return eye, forward


def _planes(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Planes of consecutive points: normals [w, 3], offsets [m], and their extent [m^2]."""
    start = np.arange(0, len(points) - _WINDOW + 1, _STRIDE)
    start = start[np.linspace(0, len(start) - 1, min(len(start), _WINDOWS)).astype(int)]
    group = points[start[:, None] + np.arange(_WINDOW)]
    middle = group.mean(axis=1)
    offset = group - middle[:, None]
    values, axes = np.linalg.eigh(offset.transpose(0, 2, 1) @ offset)
    size = np.sqrt(np.maximum(values, 0.0))
    flat = (size[:, 0] < _PLANE * size[:, 1]) & (size[:, 1] > _BENT * size[:, 2])
    normal = axes[flat][:, :, 0]
    return normal, np.einsum("wj,wj->w", normal, middle[flat]), values[flat, 1]


def _common_line(normals: np.ndarray, offsets: np.ndarray, weight: np.ndarray, extent: float,
                 ) -> tuple[np.ndarray | None, np.ndarray]:
    """Direction [3] of the line in which most of the planes meet, and a point on it [m]. Two planes
    propose it, most decide: windows over the end of a line are in no plane with the camera."""
    rng = np.random.default_rng(0)
    best, least, miss = None, np.inf, np.zeros(0)
    for one, other in rng.integers(len(normals), size=(_TRIED, 2)):
        along = np.cross(normals[one], normals[other])
        size = float(np.linalg.norm(along))
        if size < _APART:
            continue
        point = np.linalg.lstsq(np.stack([normals[one], normals[other], along / size]),
                                np.array([offsets[one], offsets[other], 0.0]), rcond=None)[0]
        missed = _missed(normals, offsets, along / size, point, extent)
        if np.median(missed) < least:
            best, least, miss = (along / size, point), float(np.median(missed)), missed
    if best is None or least > _NEAR:
        return None, np.zeros(3)
    for _ in range(_ROUNDS):
        near = miss <= _TUKEY * max(least, _EXACT)
        own, part = normals[near], weight[near]
        axes = np.linalg.eigh((own * part[:, None]).T @ own)[1]
        along, across = axes[:, 0], axes[:, 1:]
        flat = own @ across
        point = across @ np.linalg.solve((flat * part[:, None]).T @ flat,
                                         (flat * part[:, None]).T @ offsets[near])
        miss = _missed(normals, offsets, along, point, extent)
        if np.median(miss) > least:
            break
        best, least = (along, point), float(np.median(miss))
    return best


def _missed(normals: np.ndarray, offsets: np.ndarray, along: np.ndarray, point: np.ndarray,
            extent: float) -> np.ndarray:
    """Distance by which planes miss a line, over the cloud's extent, and in radians, shape [w]."""
    return np.abs(normals @ along) + np.abs(normals @ point - offsets) / extent


def _uniform_position(side: np.ndarray, depth: np.ndarray) -> float:
    """Position of the camera along that line [m]: from it, pixels in a row are evenly spaced."""
    image, inverse = side / depth, 1 / depth
    bend = image[:-2] - 2 * image[1:-1] + image[2:]
    change = inverse[:-2] - 2 * inverse[1:-1] + inverse[2:]
    known = np.abs(change) > 1e-9 * float(np.median(inverse))
    if not known.any():
        return 0.0
    bend, change = bend[known], change[known]
    # Most pixels that are consecutive in the file are neighbours in the image. Each triple proposes
    # a position; the one that fits most triples is taken.
    tried = np.linspace(0, len(bend) - 1, _TRIED).astype(int)
    ruler = np.linspace(0, len(bend) - 1, _RULERS).astype(int)
    position, most = 0.0, -1
    for start in bend[tried] / change[tried]:
        step = np.median(np.abs(image[ruler + 1] - image[ruler] - start * (
            inverse[ruler + 1] - inverse[ruler])))
        even = int((np.abs(bend[ruler] - start * change[ruler]) < _EVEN * step).sum())
        if even > most:
            position, most = float(start), even
    for _ in range(_ROUNDS):
        step = np.median(np.abs(np.diff(image - position * inverse)))
        even = np.abs(bend - position * change) < _EVEN * step
        position = float(bend[even] @ change[even] / max(float(change[even] @ change[even]),
                                                         1e-300))
    return position


def _turn(column: np.ndarray, row: np.ndarray) -> float | None:
    """Angle a [rad] by which to rotate the view so that pixels of all lines are equally wide. Seen
    obliquely, they are p (cos a + row sin a) wide."""
    width, at = np.abs(np.diff(column)), (row[1:] + row[:-1]) / 2
    pitch = float(np.median(width))
    even = np.abs(width - pitch) < 2 * _EVEN * pitch
    for _ in range(_ROUNDS):
        if even.sum() < _PLANAR_WINDOWS:
            return None
        slope, start = np.polyfit(at[even], width[even], 1)
        off = np.abs(width - start - slope * at)
        even = off < min(_EVEN * pitch, _TUKEY * float(np.median(off[even])) + _EXACT * pitch)
    return float(np.arctan2(slope, start))
