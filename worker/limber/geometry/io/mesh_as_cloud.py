"""A mesh given as a cloud: its vertices may be a scan, or far too few."""

from pathlib import Path

import numpy as np

from limber.core.errors import InputError

_LONG = 0.05
"""Fraction of the extent: triangles with so long an edge have surface where no vertex is."""


def mesh_notes(path: Path, vertices: np.ndarray, faces: np.ndarray) -> list[str]:
    """Return what a user should know whose cloud is a mesh.

    Args:
        path: Its file.
        vertices: Positions, shape [n, 3].
        faces: Triangles, shape [m, 3].

    Raises:
        InputError: half of the surface is of triangles so large that vertices do not show it.
    """
    good = ((faces >= 0) & (faces < len(vertices))).all(axis=1)
    corners = np.asarray(vertices, float)[faces[good]]
    if not len(corners):
        return []
    sides = np.roll(corners, -1, axis=1) - corners
    areas = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    longest = np.linalg.norm(sides, axis=2).max(axis=1)
    extent = float(np.linalg.norm(np.ptp(corners.reshape(-1, 3), axis=0)))
    large = longest > _LONG * extent
    if areas[large].sum() > 0.5 * areas.sum():
        raise InputError(
            f"{path} is a mesh of {len(vertices)} vertices and {len(faces)} faces.",
            "A point cloud was expected. Most of this surface lies in large faces, where a mesh "
            "has no points.",
            "If it is the closed surface of a branch, use `limber mesh`. Otherwise sample points "
            "on it (CloudCompare: Edit, Mesh, Sample points) and export those.")
    return [f"{path.name} is a mesh of {len(faces)} faces. Its {len(vertices)} vertices were read "
            "as a cloud. If it is the closed surface of a branch, `limber mesh` uses it as it is."]
