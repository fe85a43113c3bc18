"""Lines and points of a scene as thin rods and small balls, coloured by a value at each point."""

from typing import Any

import numpy as np

from limber.core.numerics.rigid import any_normal
from limber.results.scene.arrays import SceneData
from limber.results.scene.colours import colours_of

_SIDES = 6


def add_rods(data: SceneData, name: str, title: str, points: np.ndarray, lines: np.ndarray,
             radius: float | np.ndarray, values: np.ndarray, scale: dict[str, Any], *,
             ball_from: int | None = None, ball_radius: float = 0.0) -> None:
    """Add lines between points as rods, coloured by a value.

    Args:
        data: Gets ``rods:NAME`` and ``rod_faces:NAME``, ``rod_color:NAME``; and
            ``info["rods"][NAME]``.
        name: Name of the rods in the file.
        title: Title that the user reads.
        points: Positions [m], shape [n, 3].
        lines: Indices of the two points that each line joins, shape [l, 2].
        radius: Radius of the rods [m], or one per point.
        values: At each point, shape [n].
        scale: Colour scale of the values.
        ball_from: Points from this one on are balls of ``ball_radius`` [m].
    """
    parts = [(*rods(points, np.asarray(lines, int).reshape(-1, 2), radius), 0)]
    if ball_from is not None:
        parts.append((*balls(points[ball_from:], ball_radius), ball_from))
    counts = np.cumsum([0, *(len(vertices) for vertices, *_ in parts)])
    faces = np.concatenate([part + count for (_, part, _, _), count in
                            zip(parts, counts[:-1], strict=True)])
    if not len(faces):
        return
    node = np.concatenate([part + first for _, _, part, first in parts])
    data.arrays |= {f"rods:{name}": np.concatenate([part for part, *_ in parts]),
                    f"rod_faces:{name}": faces,
                    f"rod_color:{name}": colours_of(np.asarray(values, float), scale)[node]}
    data.info["rods"][name] = {"title": title, "scale": scale}


def balls(points: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices [v, 3] m, triangles [f, 3] and the point of each vertex [v]: icosahedra."""
    golden = (1 + np.sqrt(5)) / 2
    base = np.array([[0.0, a, b] for a in (-1, 1) for b in (-golden, golden)])
    corners = np.concatenate([np.roll(base, turn, axis=1) for turn in range(3)])
    # Its triangles join corners that are 2 apart.
    near = np.abs(np.linalg.norm(corners[:, None] - corners, axis=2) - 2) < 1e-9
    triples = [(i, j, k) for i in range(12) for j in range(i) for k in range(j)
               if near[i, j] and near[j, k] and near[i, k]]
    one = np.array([triple if np.linalg.det(corners[list(triple)]) > 0 else triple[::-1]
                    for triple in triples])
    corners *= radius / np.linalg.norm(corners[0])
    node = np.repeat(np.arange(len(points)), 12)
    faces = (12 * np.arange(len(points))[:, None, None] + one).reshape(-1, 3)
    return points[node] + np.tile(corners, (len(points), 1)), faces, node


def rods(points: np.ndarray, lines: np.ndarray, radius: float | np.ndarray,
         ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices [v, 3] m, triangles [f, 3] and the point of each vertex [v] of open tubes.

    Lines without length get no rod.
    """
    points = np.asarray(points, float)
    size = np.broadcast_to(np.asarray(radius, float), len(points))
    vector = points[lines[:, 1]] - points[lines[:, 0]]
    length = np.linalg.norm(vector, axis=1)
    lines, vector = lines[length > 0], vector[length > 0] / length[length > 0, None]
    first = any_normal(vector)
    second = np.cross(vector, first)
    angle = 2 * np.pi * np.arange(_SIDES) / _SIDES
    ring = (first[:, None] * np.cos(angle)[:, None] + second[:, None] * np.sin(angle)[:, None])
    ends = points[lines][:, :, None] + size[lines][:, :, None, None] * ring[:, None]
    node = np.repeat(lines, _SIDES, axis=1).ravel()
    k = np.arange(_SIDES)
    after = (k + 1) % _SIDES
    one = np.concatenate([np.column_stack([k, after, k + _SIDES]),
                          np.column_stack([after, after + _SIDES, k + _SIDES])])
    faces = 2 * _SIDES * np.arange(len(lines))[:, None, None] + one
    return ends.reshape(-1, 3), faces.reshape(-1, 3), node
