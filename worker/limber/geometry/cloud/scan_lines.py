"""Position of an image's camera, found from the order in which a file stores its pixels.

Clouds made of a depth image store its pixels row by row or column by column. All points of a line
are in one plane with the camera. All these planes meet in the line through the camera along which
pixels are counted, and along a line the pixels are evenly spaced. So camera and direction of view
are known even if the cloud was moved or rotated since.
"""

import numpy as np

_WINDOW, _STRIDE, _WINDOWS = 10, 5, 4000  # points of a window; its stride; number of windows
_PLANE = 1e-3  # thickness over the narrower extent below which points lie in a plane
_BENT = 0.02  # narrower over longer extent above which the plane is well defined
_LEAST, _SHARE = 20, 0.15  # number and fraction of windows that must be planar
_APART = 0.03  # sine of the angle below which planes are parallel: a sorted grid
_NEAR = 3e-3  # distance of the median plane from the camera, over the cloud's extent
_TUKEY, _EXACT = 4.0, 1e-9  # cut-off in median distances; a median below it is zero
_EVEN = 0.2  # fraction of a pixel by which regular points may deviate
_ROUNDS = 20
_TRIED, _RULERS = 300, 3000  # planes for a first estimate; planes on which it is tested


def scan_line_view(points: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Find a camera's position [m], shape [3], and its direction of view, a unit vector, shape [3].

    Args:
        points: In the order of the file [m], shape [n, 3].

    Returns:
        None where the order of the points is not that of an image.
    """
    if len(points) < _WINDOW:
        return None
    normals, offsets, weight = _planes(points)
    if len(normals) < max(_LEAST, _SHARE * min(len(points) / _STRIDE, _WINDOWS)):
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
    """Direction [3] of the line in which most of the planes meet, and a point on it [m].

    Windows over the end of a line are in no plane with the camera. Two planes propose a line, and
    the line that most other planes pass through is taken.
    """
    rng = np.random.default_rng(0)
    best, least, miss = None, np.inf, None
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
    """Angle [rad] by which to rotate the view so that pixels of all lines are equally wide.

    Seen obliquely, they are p (cos a + row sin a) wide.
    """
    width, at = np.abs(np.diff(column)), (row[1:] + row[:-1]) / 2
    pitch = float(np.median(width))
    even = np.abs(width - pitch) < 2 * _EVEN * pitch
    for _ in range(_ROUNDS):
        if even.sum() < _LEAST:
            return None
        slope, start = np.polyfit(at[even], width[even], 1)
        off = np.abs(width - start - slope * at)
        even = off < min(_EVEN * pitch, _TUKEY * float(np.median(off[even])) + _EXACT * pitch)
    return float(np.arctan2(slope, start))
