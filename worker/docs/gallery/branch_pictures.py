"""How gallery and moving picture draw a branch: triangles, projected and lit."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection, PolyCollection

WOOD = np.array([[0.62, 0.45, 0.30]])
GREY = np.array([[0.75, 0.75, 0.75]])
LIGHT = np.array([0.35, -0.75, 0.56])


@dataclass(frozen=True)
class Camera:
    """An orthographic view.

    Attributes:
        azimuth: Turn about the vertical [degrees]; at 0, x points right.
        tilt: How far the viewer looks down [degrees].
    """

    azimuth: float
    tilt: float = 12.0

    def __call__(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return places in the picture [m], shape [n, 2], and depths away from the viewer [m]."""
        turn, tilt = np.radians(self.azimuth), np.radians(self.tilt)
        right = np.array([np.cos(turn), np.sin(turn), 0.0])
        away = np.array([-np.sin(turn) * np.cos(tilt), np.cos(turn) * np.cos(tilt),
                         -np.sin(tilt)])
        return points @ np.column_stack([right, np.cross(right, away)]), points @ away


def outer_faces(mesh: Any) -> np.ndarray:
    """Return the corners of a mesh's outer triangles, shape [n, 3]."""
    return np.asarray(mesh.surface_faces())[:, :3]


def draw_surface(axes: Any, camera: Camera, nodes: np.ndarray, faces: np.ndarray,
                 colours: np.ndarray = WOOD, *, alpha: float = 1.0, edges: bool = False) -> None:
    """Draw triangles from behind to the front, lit from one side.

    Args:
        nodes: [m], shape [n, 3].
        colours: Of each face, or one for all, shape [faces or 1, 3].
    """
    flat, depth = camera(nodes)
    corners = nodes[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    order = np.argsort(-depth[faces].mean(1))
    lit = np.clip(colours * (0.62 + 0.38 * normals @ LIGHT)[:, None], 0, 1)[order]
    axes.add_collection(PolyCollection(
        flat[faces][order], facecolors=lit, alpha=alpha,
        edgecolors="#3b2a1a" if edges else lit, linewidths=0.35 if edges else 0.25))


def draw_axes(axes: Any, camera: Camera, skeleton: Any, share: float = 1.0) -> None:
    """Draw a skeleton as far as a share of the longest way from the base, with its nodes."""
    along = skeleton.arc_length
    shown = np.flatnonzero((skeleton.parent >= 0) & (along <= share * along.max()))
    flat, _ = camera(skeleton.nodes)
    axes.add_collection(LineCollection(
        [flat[[skeleton.parent[k], k]] for k in shown], colors="#b5401e", linewidths=2.2))
    axes.plot(*flat[shown].T, "o", ms=3.2, color="#7d2a12", mec="none")


def per_face(mesh: Any, faces: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return values of tetrahedra at faces: of each corner the largest about it, then the mean."""
    at_nodes = np.full(mesh.node_count, -np.inf)
    for corner in mesh.tets[:, :4].T:
        np.maximum.at(at_nodes, corner, values)
    return at_nodes[faces].mean(1)


def frame(axes: Any, camera: Camera, *bodies: np.ndarray) -> None:
    """Show all of some points, without axes, at one scale."""
    flat = np.vstack([camera(points)[0] for points in bodies])
    margin = 0.06 * np.ptp(flat, axis=0).max()
    (left, low), (right, high) = flat.min(0) - margin, flat.max(0) + margin
    axes.set(xlim=(left, right), ylim=(low, high), aspect="equal")
    axes.set_axis_off()
