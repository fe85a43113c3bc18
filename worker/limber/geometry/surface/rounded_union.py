"""Distances from round cylinders, and the level function of a fillet between them."""

import numpy as np

from limber.core.numerics.compiled import compiled_exactly


def segments(points: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Rounded cones along a polyline: start [m], step [m], radius and its change [m], start along
    the line and length [m]; shape [n - 1, 10].

    Args:
        points: Polyline [m], shape [n, 3].
        radius: Radii [m], shape [n].
    """
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
    """Level of the solid around the crease between a twig and others, shape [n].

    Args:
        points: Positions [m], shape [n, 3].
        twig: Its cones.
        others: Cones of all the others, one after the other.
        first: Index of the first cone of each of the others, and their total number, shape [k + 1].
        excess: Excess of the polygons' corners over the circles, in radii; the twig's, then the
            others', shape [k + 1].
        base: A point [m] on the flat cut at the root and its normal, upwards, shape [2, 3].
        shape: Radius of the fillet [m]; its reach and the distance at which its rim is lowest, in
            fillet radii; its height over and depth under the cylinders, likewise; and its end along
            the twig [m] (infinite: where the two are apart).
    """
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
