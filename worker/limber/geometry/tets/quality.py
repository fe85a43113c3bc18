"""Quality of a tetrahedral mesh: volume, dihedral angles, radius ratios, elements across."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.surface.surface import Surface
from limber.geometry.tets.tet_mesh import EDGES, TetMesh

FLAT = 0.02
"""Shape of a tetrahedron (1 is regular) below which it is avoided."""


@dataclass(frozen=True)
class MeshQuality:
    """Measures of a tetrahedral mesh.

    Attributes:
        tet_count: Number of tetrahedra.
        volume_m3: Their volume.
        volume_ratio: That volume over the surface's.
        min_dihedral_deg: Smallest angle between two faces of a tetrahedron.
        min_radius_ratio: Smallest 3 r_in / r_out; 1 is regular, 0 flat.
        mean_radius_ratio: Mean of these ratios.
        elements_across: Median over the nodes of the skeleton of the diameter over the mean edge
            of the elements there; None without a skeleton.
        surface_distance_mean: Mean distance of the mesh's boundary (its corners, edge middles and
            face centres) from the surface, in local radii; None without a surface.
        surface_distance_max_m: The largest [m].
        fork_distance_mean: Mean of the distances within two radii of a fork, in radii.
        fork_distance_max: The largest of them, in radii.
    """

    tet_count: int
    volume_m3: float
    volume_ratio: float
    min_dihedral_deg: float
    min_radius_ratio: float
    mean_radius_ratio: float
    elements_across: float | None
    surface_distance_mean: float | None = None
    surface_distance_max_m: float | None = None
    fork_distance_mean: float | None = None
    fork_distance_max: float | None = None

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def measure_quality(mesh: TetMesh, surface_volume: float, skeleton: Skeleton | None = None,
                    surface: Surface | None = None) -> MeshQuality:
    """Measure a mesh against the surface it fills (volume [m^3]) and, if given, its skeleton."""
    ratio = radius_ratios(mesh)
    volume = float(mesh.volumes.sum())
    distances = {} if skeleton is None or surface is None else _surface_distances(
        mesh, skeleton, surface)
    return MeshQuality(
        mesh.tet_count, volume, volume / surface_volume, float(dihedral_angles(mesh).min()),
        float(ratio.min()), float(ratio.mean()),
        None if skeleton is None else _elements_across(mesh, skeleton), **distances)


def _surface_distances(mesh: TetMesh, skeleton: Skeleton, surface: Surface) -> dict[str, Any]:
    from limber.geometry.surface.distance import distance_to_surface

    corner = mesh.nodes[mesh.surface_faces()]
    points = np.vstack([corner.reshape(-1, 3), corner.mean(axis=1),
                        ((corner + corner[:, [1, 2, 0]]) / 2).reshape(-1, 3)])
    points = np.unique(points, axis=0)
    distance = distance_to_surface(points, surface)
    _, near = cKDTree(skeleton.nodes).query(points)
    share = distance / np.maximum(skeleton.radius[near], 1e-300)
    found: dict[str, Any] = {"surface_distance_mean": float(share.mean()),
                             "surface_distance_max_m": float(distance.max())}
    forks = skeleton.forks()
    if len(forks):
        away, fork = cKDTree(skeleton.nodes[forks]).query(points)
        at_fork = away < 2 * skeleton.radius[forks][fork]
        if at_fork.any():
            local = distance[at_fork] / skeleton.radius[forks][fork[at_fork]]
            found |= {"fork_distance_mean": float(local.mean()),
                      "fork_distance_max": float(local.max())}
    return found


def dihedral_angles(mesh: TetMesh) -> np.ndarray:
    """Angles between faces [degrees], one for each edge, shape [tet_count, 6]."""
    corner = mesh.nodes[mesh.tets[:, :4]]
    angles = []
    for a, b in EDGES:
        c, d = (k for k in range(4) if k not in (a, b))
        edge = corner[:, b] - corner[:, a]
        edge = edge / np.maximum(np.linalg.norm(edge, axis=1), 1e-300)[:, None]
        sides = []
        for other in (c, d):
            side = corner[:, other] - corner[:, a]
            sides.append(side - np.einsum("ij,ij->i", side, edge)[:, None] * edge)
        cosine = np.einsum("ij,ij->i", *sides) / np.maximum(
            np.linalg.norm(sides[0], axis=1) * np.linalg.norm(sides[1], axis=1), 1e-300)
        angles.append(np.rad2deg(np.arccos(np.clip(cosine, -1, 1))))
    return np.stack(angles, axis=1)


def radius_ratios(mesh: TetMesh) -> np.ndarray:
    """Three times the inscribed over the circumscribed radius, shape [tet_count]."""
    corner = mesh.nodes[mesh.tets[:, :4]]
    a, b, c = (corner[:, k] - corner[:, 0] for k in (1, 2, 3))
    volume6 = np.abs(np.einsum("ij,ij->i", a, np.cross(b, c)))
    area2 = sum(np.linalg.norm(n, axis=1) for n in (
        np.cross(a, b), np.cross(b, c), np.cross(c, a), np.cross(b - a, c - a)))
    centre = (np.einsum("ij,ij->i", a, a)[:, None] * np.cross(b, c)
              + np.einsum("ij,ij->i", b, b)[:, None] * np.cross(c, a)
              + np.einsum("ij,ij->i", c, c)[:, None] * np.cross(a, b))
    outer = np.linalg.norm(centre, axis=1) / np.maximum(2 * volume6, 1e-300)
    inner = volume6 / np.maximum(area2, 1e-300)
    return np.where(volume6 > 0, 3 * inner / np.maximum(outer, 1e-300), 0.0)


def _elements_across(mesh: TetMesh, skeleton: Skeleton) -> float:
    corner = mesh.nodes[mesh.tets[:, :4]]
    edges = np.linalg.norm(corner[:, EDGES[:, 0]] - corner[:, EDGES[:, 1]], axis=2).mean(axis=1)
    _, near = cKDTree(mesh.centroids).query(skeleton.nodes, k=min(6, mesh.tet_count))
    local = edges[near].reshape(skeleton.node_count, -1).mean(axis=1)
    return float(np.median(2 * skeleton.radius / local))


def shapes(corner: np.ndarray) -> np.ndarray:
    """Volume over the cube of the mean edge, 1 if a tetrahedron is regular, negative if inverted.

    Args:
        corner: Corners [m], shape [..., 4, 3].
    """
    edges = [corner[..., i, :] - corner[..., j, :] for i in range(4) for j in range(i)]
    square = sum(np.einsum("...k,...k->...", e, e) for e in edges) / 6
    a, b, c = (corner[..., k, :] - corner[..., 0, :] for k in (1, 2, 3))
    volume = np.einsum("...k,...k->...", a, np.cross(b, c)) / 6
    return 6 * np.sqrt(2) * volume / np.maximum(square, 1e-300)**1.5
