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

_BESIDE = 1.6  # pixels: the eight around a pixel
_REGULAR = 0.6  # 5 % quantile over median of the distances to the nearest pixel; 0.27 at random
_AXIS = np.cos(np.radians(35.0))  # largest angle at which the camera frame's own axis is used
_WIDEST = np.radians(75.0)  # largest angle from the view's centre; no image is wider
_TWO, _THERE = (1.8, 2.2), 0.4  # pixels to the second neighbour; tolerance around a pixel
_LEAST_FILL = 0.1
_NOISE = 3.0  # standard deviations by which neighbours may differ
_LEAST = 200  # fewest readings of an image


@dataclass(frozen=True)
class View:
    """Position from which a cloud was seen, and its image.

    Attributes:
        eye: The camera's position [m], shape [3].
        pitch: Width of a pixel at distance 1.
    """

    eye: np.ndarray
    pitch: float


@dataclass(frozen=True)
class Sight:
    """A cloud as the image of one camera.

    Attributes:
        pixels: Position of each point in the image, in pixels, shape [n, 2].
        depth: Distance along the middle of the view [m], shape [n].
        pitch: Width of a pixel at depth 1.
    """

    pixels: np.ndarray
    depth: np.ndarray
    pitch: float

    @cached_property
    def fill(self) -> float:
        """Fraction of the pixels on the seen surface that are in the cloud; lower if thinned.

        Estimated from the midpoints between pixels two apart: the fraction with a pixel there.
        """
        tree = cKDTree(self.pixels)
        pairs = tree.query_pairs(_TWO[1], output_type="ndarray")
        pairs = pairs[np.linalg.norm(np.subtract(*self.pixels[pairs.T]), axis=1) > _TWO[0]]
        if len(pairs) < _LEAST:
            return 1.0
        between = self.pixels[pairs].mean(axis=1)
        is_near = tree.query(between, distance_upper_bound=_THERE)[0] < np.inf
        return max(float(is_near.mean()), _LEAST_FILL)


def find_sight(points: np.ndarray, eye: np.ndarray | None = None,
               forward: np.ndarray | None = None) -> Sight | None:
    """View a cloud from its camera's position; None if it is not an image from there.

    An image has one point per pixel, and pixels are evenly spaced. Points that were scanned from
    all around, thinned or moved elsewhere are randomly placed in it.

    Args:
        points: Positions [m], shape [n, 3], camera and points in one frame.
        eye: The camera's position [m], shape [3]; None: the origin, if the cloud looks like an
            image from there. If given, only points too wide apart for one view are refused.
        forward: Middle of the view, a unit vector, shape [3]; None: found from the points.
    """
    if len(points) < _LEAST:
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
    right = np.cross(forward, np.eye(3)[int(np.argmin(np.abs(forward)))])
    right /= np.linalg.norm(right)
    image = np.stack([offset @ right, offset @ np.cross(forward, right)], axis=1) / depth[:, None]
    spacing = cKDTree(image).query(image, k=2)[0][:, 1]
    pitch = float(np.median(spacing))
    if pitch <= 0 or (eye is None and np.quantile(spacing, 0.05) < _REGULAR * pitch):
        return None
    return Sight(image / pitch, depth, pitch)


def flying_pixels(sight: Sight, grazing: float, speck: int) -> np.ndarray:
    """Find the pixels that are connected to no surface.

    Two pixels are connected if noise and a surface seen at the angle ``grazing`` can explain the
    difference of their depths. Noise is measured with a stereo camera's model: it grows with the
    square of the depth. A group with no pixel beside it does not fly: there is no edge.

    Args:
        sight: The image.
        grazing: Steepest surface that counts, between its normal and the line of sight [deg].
        speck: Fewest connected pixels that fly by no coincidence.

    Returns:
        True where a pixel flies, shape [n].
    """
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
    if inside.sum() < _LEAST // 4:
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
