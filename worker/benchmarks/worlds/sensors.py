"""Sensors of the worlds: where they stand, what they see, and how they err."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.worlds.ray_casting import Hits, cast
from benchmarks.worlds.scenes import Scene


@dataclass(frozen=True)
class Seen:
    """A cloud [m], shape [n, 3], what each point is on, shape [n], and up in its axes.

    ``turn`` and ``shift`` bring the scene into the cloud's frame: ``turn @ (place - shift)``.
    """

    points: np.ndarray
    label: np.ndarray
    turn: np.ndarray
    shift: np.ndarray

    def placed(self, places: np.ndarray) -> np.ndarray:
        """Places of the scene [m], shape [n, 3], in the cloud's frame."""
        return (places - self.shift) @ self.turn.T


def one_station(scene: Scene, rng: np.random.Generator, noise: float) -> Seen:
    """A terrestrial laser scanner: noise along its rays, blurred edges, coordinates on a map."""
    return _stations(scene, rng, noise, 1)


def stations(scene: Scene, rng: np.random.Generator, noise: float) -> Seen:
    """Three to five stations all around, each with its own error of registration."""
    return _stations(scene, rng, noise, int(rng.integers(3, 6)))


def _stations(scene: Scene, rng: np.random.Generator, noise: float, count: int) -> Seen:
    middle, size = _middle(scene)
    begin, parts, labels = rng.uniform(0, 2 * np.pi), [], []
    spacing = rng.uniform(0.0013, 0.0022) * (1 if count == 1 else 1.5)
    for number in range(count):
        angle = begin + 2 * np.pi * number / count + rng.normal(0, 0.15)
        far = rng.uniform(2.5, 5.0) * size
        eye = middle + [far * np.cos(angle), far * np.sin(angle), rng.uniform(-0.3, 1.0) * size]
        hits = cast(scene.triangles, eye, middle, spacing / far, rng.uniform(0, 1, 2))
        spread = noise / np.sqrt(np.maximum(hits.incidence, 0.1))
        range_error = spread * rng.normal(size=len(spread)) + np.where(
            hits.edge & (rng.uniform(size=len(spread)) < 0.1), rng.exponential(0.004, len(spread)),
            0.0)
        points = _at(hits, range_error) + rng.normal(0, 0.0003 if count > 1 else 0.0, 3)
        kept = hits.incidence > 0.05
        parts.append(points[kept])
        labels.append(scene.label[hits.triangle[kept]])
    # One station's file may have its origin at the scanner, or be on a map as several are.
    origin = eye if count == 1 and rng.uniform() < 0.5 else np.round(rng.uniform(-50, 50, 3), 2)
    return _placed(np.vstack(parts), np.concatenate(labels), shift=origin)


def depth_camera(scene: Scene, rng: np.random.Generator, noise: float) -> Seen:
    """One image in the camera's frame; ``noise`` [m] is that of a surface seen face on.

    Structured light and stereo round to steps of disparity and err jointly in patches, time of
    flight does not; all err more at grazing angles, and mix depths at edges.
    """
    middle, size = _middle(scene)
    angle = rng.uniform(0, 2 * np.pi)
    far = 1.1 * size
    eye = middle + far * np.array([np.cos(angle), np.sin(angle), rng.uniform(-0.2, 0.3)])
    hits = cast(scene.triangles, eye, middle, rng.uniform(0.0013, 0.002) / far)
    depth = hits.distance * (hits.way @ hits.axes[2])
    spread = noise * (depth / far)**2 / np.maximum(hits.incidence, 0.15)
    error = spread * rng.normal(size=len(depth))
    if rng.uniform() < 0.6:
        waves = rng.normal(size=(12, 3)) * 40.0
        error = 0.7 * error + 0.7 * noise * np.sin(
            _at(hits, 0.0) @ waves.T + rng.uniform(0, 6.3, 12)).sum(axis=1) / np.sqrt(6)
        step = 0.5 * noise * (depth / far)**2
        error = np.round((depth + error) / step) * step - depth
    flying = hits.edge & (rng.uniform(size=len(depth)) < 0.06)
    error = np.where(flying, error + rng.exponential(0.02, len(depth)), error)
    kept = hits.incidence > 0.12
    return _placed(_at(hits, error / (depth / hits.distance))[kept],
                   scene.label[hits.triangle[kept]], hits.axes, eye)


def photogrammetry(scene: Scene, rng: np.random.Generator, noise: float) -> Seen:
    """Structure from motion: heavy tails, blur, holes, stray points, a scale that drifts."""
    points, label = _walked(scene, rng, 10, 0.0024, 0.0)
    holes = points[rng.integers(len(points), size=6)]
    away = cKDTree(holes).query(points)[0]
    kept = (away > rng.uniform(0.004, 0.012)) & (rng.uniform(size=len(points)) < 0.6)
    points, label = points[kept], label[kept]
    near = cKDTree(points).query(points, k=6)[1]
    points = 0.5 * points + 0.5 * points[near].mean(axis=1)
    points = points + 0.6 * noise * rng.standard_t(3, size=points.shape)
    stray = rng.integers(len(points), size=len(points) // 50)
    points[stray] += rng.normal(0, 0.02, (len(stray), 3))
    base = points[:, 2].min()
    points = points * (1 + 0.004 * rng.normal() * ((points[:, 2] - base) / np.ptp(points[:, 2]))[
        :, None])
    return _placed(points, label)


def hand_scanner(scene: Scene, rng: np.random.Generator, noise: float) -> Seen:
    """Many close frames whose pose drifts; small noise of its own, merged on a fine grid."""
    points, label = _walked(scene, rng, 14, 0.002, 0.3 * noise)
    points = points + 0.5 * noise * rng.normal(size=points.shape)
    _, first = np.unique(np.round(points / 0.0017).astype(int), axis=0, return_index=True)
    return _placed(points[first], label[first])


def _walked(scene: Scene, rng: np.random.Generator, views: int, spacing: float, drift: float,
            ) -> tuple[np.ndarray, np.ndarray]:
    """Hits of views on a walk around, whose pose errors [m] add up, and their labels."""
    middle, size = _middle(scene)
    error, parts, labels = np.zeros(3), [], []
    for angle in np.linspace(0, 2 * np.pi, views, endpoint=False):
        far = rng.uniform(0.9, 1.4) * size
        eye = middle + far * np.array([np.cos(angle), np.sin(angle), rng.uniform(-0.5, 0.6)])
        hits = cast(scene.triangles, eye, middle, spacing * np.sqrt(views / 3) / far,
                    rng.uniform(0, 1, 2))
        kept = hits.incidence > 0.25
        error = 0.8 * error + rng.normal(0, drift, 3)
        parts.append(_at(hits, 0.0)[kept] + error)
        labels.append(scene.label[hits.triangle[kept]])
    return np.vstack(parts), np.concatenate(labels)


def _at(hits: Hits, error: np.ndarray | float) -> np.ndarray:
    """Positions [m] of hits whose ranges have an error [m]."""
    return hits.eye + (hits.distance + error)[:, None] * hits.way


def _middle(scene: Scene) -> tuple[np.ndarray, float]:
    """Middle [m] and size [m] of a scene."""
    low, high = scene.triangles.min(axis=(0, 1)), scene.triangles.max(axis=(0, 1))
    return (low + high) / 2, float((high - low).max())


def _placed(points: np.ndarray, label: np.ndarray, turn: np.ndarray | None = None,
            shift: np.ndarray | None = None) -> Seen:
    turn = np.eye(3) if turn is None else turn
    shift = np.zeros(3) if shift is None else shift
    return Seen((points - shift) @ turn.T, label, turn, shift)


ONE_SIDED = (one_station, depth_camera)
ALL_AROUND = (stations, photogrammetry, hand_scanner)
