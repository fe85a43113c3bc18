"""Rotation-minimising frames and rings along a curve, for tubes and swept meshes."""

import numpy as np

from limber.core.numerics.rigid import any_normal

_SAME = 1e-13  # fraction of the coordinates; closer nodes coincide


def arc_lengths(points: np.ndarray) -> np.ndarray:
    """Length of a polyline up to each of its points [m], shape [n]."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def stretches(chosen: np.ndarray) -> list[slice]:
    """Consecutive indices where ``chosen`` is true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], chosen.astype(int), [0]])))
    return [slice(begin, end) for begin, end in zip(edges[::2], edges[1::2], strict=True)]


def tangents(points: np.ndarray) -> np.ndarray:
    """Unit tangents of a polyline by central differences, shape [n, 3]."""
    step = np.diff(points, axis=0)
    step /= np.maximum(np.linalg.norm(step, axis=1), 1e-300)[:, None]
    tangent = np.vstack([step[:1], step[:-1] + step[1:], step[-1:]])
    return tangent / np.maximum(np.linalg.norm(tangent, axis=1), 1e-300)[:, None]


def frames(points: np.ndarray, tangent: np.ndarray, normal: np.ndarray | None = None,
           ) -> tuple[np.ndarray, np.ndarray]:
    """Rotation-minimising frames: normals and binormals [n, 3] along points [n, 3] with unit
    tangents, by double reflection (Wang, Jüttler, Zheng, Liu: Computation of Rotation Minimizing
    Frames, 2008). The first ``normal`` [3] is made orthogonal to the tangent; None: any."""
    normals = np.empty_like(points)
    first = any_normal(tangent[0]) if normal is None else normal - tangent[0] * (
        normal @ tangent[0])
    normals[0] = first / np.linalg.norm(first)
    across = np.diff(points, axis=0)
    size = (points[:-1]**2).sum(axis=1)
    same = (across**2).sum(axis=1) < _SAME**2 * np.maximum(size, 1e-300)
    across[same] = tangent[:-1][same]  # two nodes coincide: continue along the tangent
    one = _reflections(across)
    second = tangent[1:] - np.einsum("nij,nj->ni", one, tangent[:-1])
    onto = np.eye(3) - tangent[1:, :, None] * tangent[1:, None]
    for i, turn in enumerate(onto @ _reflections(second) @ one):
        following = turn @ normals[i]
        normals[i + 1] = following / np.sqrt(following @ following)
    return normals, np.cross(tangent, normals)


def _reflections(across: np.ndarray) -> np.ndarray:
    """Reflections along vectors [n, 3], shape [n, 3, 3]; the identity for a zero vector."""
    square = (across**2).sum(axis=1)
    scale = np.where(square > 1e-30, 2 / np.maximum(square, 1e-30), 0.0)
    return np.eye(3) - scale[:, None, None] * across[:, :, None] * across[:, None]


def polygon_factor(sides: int) -> float:
    """Circumradius of the regular polygon with the area of the unit circle. An inscribed hexagon
    has 17 % less; at equal area its second moment is 0.8 % over the circle's."""
    return float(np.sqrt(np.pi / (sides / 2 * np.sin(2 * np.pi / sides))))


def bending_factor(sides: int) -> float:
    """Circumradius of the regular polygon with the second moment of area of the unit circle, to
    bend as it does. Area is 0.4 % under the circle's for a hexagon, 2.3 % for a square, whose
    second moment is 4.7 % over at equal area."""
    turn = 2 * np.pi / sides
    # Second moment of a polygon of circumradius 1: n/48 (4 sin a + sin 2a) with a = 2 pi / n.
    return float((np.pi / 4 / (sides / 48 * (4 * np.sin(turn) + np.sin(2 * turn))))**0.25)


def rings(centres: np.ndarray, radius: np.ndarray, normals: np.ndarray, binormals: np.ndarray,
          sides: int, factor: float | None = None) -> np.ndarray:
    """Polygons [n, sides, 3] for circles of ``radius`` [n] [m] around ``centres``, first corners
    along ``normals``. ``factor`` is the circumradius in radii; None: that of equal area."""
    factor = polygon_factor(sides) if factor is None else factor
    angle = 2 * np.pi * np.arange(sides) / sides
    around = (np.cos(angle)[None, :, None] * normals[:, None]
              + np.sin(angle)[None, :, None] * binormals[:, None])
    return centres[:, None] + (radius * factor)[:, None, None] * around


def resample(points: np.ndarray, radius: np.ndarray, spacing: np.ndarray | float,
             ) -> tuple[np.ndarray, np.ndarray]:
    """Resample points and radii along a polyline at ``spacing`` (a number, or one per point)."""
    along = arc_lengths(points)
    spacings = np.broadcast_to(np.asarray(spacing, float), along.shape)
    # Equal steps in the integral of 1/spacing follow a spacing that varies along the path.
    density = np.concatenate([[0], np.cumsum(np.diff(along) * 2 / (spacings[1:] + spacings[:-1]))])
    count = max(round(density[-1]), 1)
    at = np.interp(np.linspace(0, density[-1], count + 1), density, along)
    centres = np.stack([np.interp(at, along, points[:, k]) for k in range(3)], axis=1)
    return centres, np.interp(at, along, radius)
