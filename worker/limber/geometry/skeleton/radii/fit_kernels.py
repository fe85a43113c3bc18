"""Loops of the axis fit over points: nearest cylinder of each, and its normal equations."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from limber.core.numerics.compiled import compiled_exactly
from limber.geometry.skeleton.skeleton import Skeleton

_EVEN = 1e-9  # of a radius
_WIDE, _FINE = 60.0, 150  # concentration (7 degrees); positions on the circle
_NORMAL, _TERMS = 30.0, 30  # concentration of the normal approximation; terms of the series
_TOLD = 14.0  # log weight below the best position's at which a position still counts


@compiled_exactly
def nearest_of(points: np.ndarray, near: np.ndarray, parent: np.ndarray, own_radius: np.ndarray,
               nodes: np.ndarray, radius: np.ndarray,
               ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Find the cylinder nearest to each of m points among k candidates: its upper node, the
    fraction of the path to it, unit vector from the axis [m, 3], distance from the surface [m],
    positive outside, and radius. ``own_radius``: the cylinder has its upper node's throughout."""
    count = len(points)
    segment, share = np.empty(count, np.int64), np.empty(count)
    normal = np.empty((count, 3))
    residual, thick = np.empty(count), np.empty(count)
    for i in range(count):
        best, chosen = np.inf, 0.0
        for k in range(near.shape[1]):
            end = near[i, k]
            start = parent[end]
            ax, ay, az = (nodes[end, 0] - nodes[start, 0], nodes[end, 1] - nodes[start, 1],
                          nodes[end, 2] - nodes[start, 2])
            px, py, pz = (points[i, 0] - nodes[start, 0], points[i, 1] - nodes[start, 1],
                          points[i, 2] - nodes[start, 2])
            square = max(ax * ax + ay * ay + az * az, 1e-300)
            t = min(max((px * ax + py * ay + pz * az) / square, 0.0), 1.0)
            dx, dy, dz = px - t * ax, py - t * ay, pz - t * az
            distance = np.sqrt(dx * dx + dy * dy + dz * dz)
            here = radius[end] if own_radius[end] else (1 - t) * radius[start] + t * radius[end]
            # Two cylinders that meet are equally near to a point beyond both: rounding must not
            # decide.
            if distance - here < best - _EVEN * here:
                best, chosen = distance - here, max(distance, 1e-300)
                segment[i], share[i], thick[i], residual[i] = end, t, here, best
                normal[i, 0], normal[i, 1], normal[i, 2] = dx / chosen, dy / chosen, dz / chosen
    return segment, share, normal, residual, thick


@compiled_exactly
def normal_blocks(segment: np.ndarray, share: np.ndarray, low: np.ndarray, high: np.ndarray,
                  normal: np.ndarray, across: np.ndarray, gradient: np.ndarray,
                  weight: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations of each cylinder's points in (x, y, z, r) of both ends: [count, 8, 8],
    [count, 8]. ``low`` and ``high`` are the radius's derivatives by the ends' radii, ``gradient``
    those of the residual, ``across`` how firmly points hold the axis across their direction."""
    block, right = np.zeros((count, 8, 8)), np.zeros((count, 8))
    row, side = np.empty(8), np.zeros(8)
    for i in range(len(segment)):
        w, s = weight[i], segment[i]
        if w == 0.0:
            continue
        for k in range(3):
            row[k] = -(1 - share[i]) * normal[i, k]
            row[4 + k] = -share[i] * normal[i, k]
            side[k] = -(1 - share[i]) * across[i, k]
            side[4 + k] = -share[i] * across[i, k]
        row[3], row[7] = -low[i], -high[i]
        for a in range(8):
            right[s, a] += w * gradient[i, a]
            for b in range(a, 8):
                block[s, a, b] += w * (row[a] * row[b] + side[a] * side[b])
    for s in range(count):
        for a in range(8):
            for b in range(a):
                block[s, a, b] = block[s, b, a]
    return block, right


@compiled_exactly
def mean_on_circle(cosine: np.ndarray, sine: np.ndarray, sharpness: np.ndarray,
                   density: np.ndarray) -> np.ndarray:
    """Mean (cos, sin) [points, 2] of positions on a circle with a ``density`` in the middles of
    even intervals, times exp(sharpness (cos(place - angle) - 1)) for each point (von Mises)."""
    step_count = len(density)
    angle = 2 * np.pi * (np.arange(step_count) + 0.5) / step_count
    across, up, log = np.cos(angle), np.sin(angle), np.log(density)
    power = np.empty(step_count)
    mean = np.empty((len(cosine), 2))
    for i in range(len(cosine)):
        # Positions farther away have no weight.
        reach = step_count
        if sharpness[i] > _TOLD / 2:
            reach = int(np.ceil(np.arccos(1 - _TOLD / sharpness[i]) * step_count / (2 * np.pi))) + 1
        own = int(np.arctan2(sine[i], cosine[i]) % (2 * np.pi) * step_count / (2 * np.pi))
        first, count = (own - reach, 2 * reach + 1) if 2 * reach < step_count else (0, step_count)
        # If it is wide enough, intervals three times as wide, each by its middle, sum it as well.
        step = 3 if sharpness[i] < _WIDE and step_count % 3 == 0 and step_count >= _FINE else 1
        if step == 3:
            first -= (first - 1) % 3
        most = -np.inf
        for j in range(0, count, step):
            k = (first + j) % step_count
            power[k] = sharpness[i] * (cosine[i] * across[k] + sine[i] * up[k] - 1) + log[k]
            most = max(most, power[k])
        total, x, y = 0.0, 0.0, 0.0
        for j in range(0, count, step):
            k = (first + j) % step_count
            weight = np.exp(power[k] - most)
            total += weight
            x += weight * across[k]
            y += weight * up[k]
        mean[i, 0], mean[i, 1] = x / total, y / total
    return mean


@compiled_exactly
def reach_on_circle(angle: np.ndarray, sharpness: np.ndarray, bessel: np.ndarray, limit: float,
                    least: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Log-likelihood of points on a side seen up to ``limit``, and its derivatives by angle and
    limit. Positions beyond count ``least``, each is blurred by a von Mises distribution; the sum
    over all does not divide it. ``bessel`` is I0(sharpness) exp(-sharpness). Angles in [rad]."""
    log, by_angle, by_limit = np.empty(len(angle)), np.empty(len(angle)), np.empty(len(angle))
    for i in range(len(angle)):
        k, low, high = sharpness[i], -limit - angle[i], limit - angle[i]
        blurred = least + (1 - least) * (_below(high, k, bessel[i]) - _below(low, k, bessel[i]))
        at_low = np.exp(k * (np.cos(low) - 1)) / (2 * np.pi * bessel[i])
        at_high = np.exp(k * (np.cos(high) - 1)) / (2 * np.pi * bessel[i])
        log[i] = np.log(blurred)
        by_angle[i] = (1 - least) * (at_low - at_high) / blurred
        by_limit[i] = (1 - least) * (at_low + at_high) / blurred
    return log, by_angle, by_limit


@compiled_exactly
def _below(angle: float, sharpness: float, bessel: float) -> float:
    """Fraction of a von Mises distribution around 0 below an angle, counting whole turns: its
    series (Hill, ACM Algorithm 518, 1977), or the normal distribution that it approaches."""
    turns = np.floor((angle + np.pi) / (2 * np.pi))
    angle -= 2 * np.pi * turns
    if sharpness > _NORMAL:
        half = np.sqrt(2 / np.pi) / bessel * np.sin(angle / 2)
        return turns + 0.5 * (1 + math.erf(half / np.sqrt(2)))
    sine, cosine = np.sin(angle), np.cos(angle)
    order = _TERMS
    up, across = np.sin(order * angle), np.cos(order * angle)
    ratio, total = 0.0, 0.0
    for _ in range(_TERMS - 1):
        order -= 1
        up, across = up * cosine - across * sine, across * cosine + up * sine
        ratio = 1 / (2 * order / max(sharpness, 1e-12) + ratio)
        total = (up / order + total) * ratio
    return turns + 0.5 + (angle / 2 + total) / np.pi


# Which cylinder of a skeleton each scanned point belongs to: the one whose surface is nearest.

_CANDIDATES = 6


def nearest_cylinders(skeleton: Skeleton, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return for each point the node whose cylinder is nearest, and its distance [m] from it."""
    segments, residuals = [], []
    for begin in range(0, len(points), 100_000):
        match = match_cylinders(skeleton.parent, skeleton.order, skeleton.nodes, skeleton.radius,
                                points[begin:begin + 100_000])
        segments.append(match.segment)
        residuals.append(match.residual)
    return np.concatenate(segments), np.concatenate(residuals)


def point_counts(skeleton: Skeleton, points: np.ndarray) -> np.ndarray:
    """Number of points on each node's cylinder, shape [n]."""
    return np.bincount(nearest_cylinders(skeleton, points)[0], minlength=skeleton.node_count)


def on_cylinders(skeleton: Skeleton, points: np.ndarray,
                 ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Lower and upper node of the cylinder nearest to each point, or around it, the fraction of the
    path between them (1 in the first of a twig, which has the twig's radius), and the vector from
    the axis to the point [m]."""
    match = match_cylinders(skeleton.parent, skeleton.order, skeleton.nodes, skeleton.radius,
                            points)
    low, high = skeleton.parent[match.segment], match.segment
    foot = (1 - match.share)[:, None] * skeleton.nodes[low] + match.share[:, None] * (
        skeleton.nodes[high])
    return low, high, np.where(match.own_radius, 1.0, match.share), points - foot


@dataclass(frozen=True)
class Match:
    """For each of m points: the upper node of its cylinder, the fraction of the path to it, the
    unit normal away from the axis [m, 3], the distance from the surface [m], the radius there [m],
    and whether the cylinder has the twig's radius throughout."""

    segment: np.ndarray
    share: np.ndarray
    normal: np.ndarray
    residual: np.ndarray
    thick: np.ndarray
    own_radius: np.ndarray


def match_cylinders(parent: np.ndarray, order: np.ndarray, nodes: np.ndarray, radius: np.ndarray,
                    points: np.ndarray, near: np.ndarray | None = None) -> Match:
    """Find the cylinder whose surface is nearest to each point, among those of the upper nodes
    ``near`` [m, k]; None: those nearby."""
    near = cylinders_around(parent, nodes, points) if near is None else near
    # The first cylinder of a side run has the twig's radius throughout, not its carrier's.
    own = order > order[parent]
    segment, share, normal, residual, thick = nearest_of(
        np.ascontiguousarray(points, np.float64), np.ascontiguousarray(near), parent, own,
        np.ascontiguousarray(nodes, np.float64), np.ascontiguousarray(radius, np.float64))
    return Match(segment, share, normal, residual, thick, own[segment])


def cylinders_around(parent: np.ndarray, nodes: np.ndarray, points: np.ndarray,
                     count: int = _CANDIDATES) -> np.ndarray:
    """Upper nodes of the cylinders whose middles are nearest to each point, shape [m, k]."""
    ends = np.arange(1, len(nodes))
    tree = cKDTree((nodes[ends] + nodes[parent[ends]]) / 2)
    _, near = tree.query(points, k=min(count, len(ends)))
    return ends[near.reshape(len(points), -1)]
