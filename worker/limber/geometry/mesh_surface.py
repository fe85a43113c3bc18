"""From the closed surface of any slender body to tetrahedra with axis, base and grasp."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from limber.core.alignment import Alignment
from limber.core.constants import UNIT_METRES
from limber.core.errors import InputError, MeshingError
from limber.core.progress import SILENT, Progress
from limber.geometry.reconstruction import gravity_after, peak_memory_mb
from limber.geometry.settings import MeshSurfaceSettings
from limber.geometry.skeleton.control_points import FRACTIONS
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.skeleton.upright import upright_rotation
from limber.geometry.surface.surface import Surface
from limber.geometry.tets.marks import mark
from limber.geometry.tets.quality import measure_quality
from limber.geometry.tets.tet_mesh import TetMesh
from limber.geometry.tets.tetrahedra import MeshSettings, tetrahedralise

_SECTIONS = 24  # cross-sections of an axis


@dataclass(frozen=True)
class MeshedBody:
    """A solid in its own frame, filled with tetrahedra.

    Attributes:
        alignment: From the file's coordinates to the body's.
        skeleton: Its axis.
        surface: Closed.
        mesh: Marked with material, base, control points and grasp.
        numbers: The stage's result.
    """

    alignment: Alignment
    skeleton: Skeleton
    surface: Surface
    mesh: TetMesh
    numbers: dict[str, Any]


def mesh_body(surface: Surface, settings: MeshSurfaceSettings,
              progress: Progress = SILENT) -> MeshedBody:
    """Fill a closed surface [m] with tetrahedra and mark base, control points and grasp.

    Raises:
        InputError: it has no long axis. MeshingError: fTetWild failed.
    """
    scale = UNIT_METRES[settings.unit]
    skeleton = section_axis(
        surface, None if settings.root is None else np.array(settings.root) * scale)
    alignment, surface, skeleton = aligned_body(surface, skeleton, scale, settings)
    thick = float(np.median(skeleton.radius))
    limits = MeshSettings(mesh_time_limit=settings.mesh_time_limit,
                          mesh_memory_limit_mb=settings.mesh_memory_limit_mb)
    try:
        mesh, cached = tetrahedralise(
            surface, edge_length=2 * thick / settings.elements_across, epsilon=0.02 * thick,
            settings=limits, stop_energy=10.0, progress=progress.part(0.1, 0.9))
    except MeshingError as error:  # there are no axes to sweep along
        raise MeshingError(
            error.seen, error.why, "Raise --mesh-time-limit or --mesh-memory-limit-mb, lower "
            "--elements-across, or simplify the surface.") from error
    mesh = mark(mesh, skeleton, young=settings.young, poisson=settings.poisson,
                density=settings.density, fractions=FRACTIONS,
                grasp_fraction=settings.grasp_fraction)
    mesher = "ftetwild (cached)" if cached else "ftetwild"
    return MeshedBody(alignment, skeleton, surface, mesh, numbers_of(
        surface, skeleton, mesh, alignment, settings, mesher))


def numbers_of(surface: Surface, skeleton: Skeleton, mesh: TetMesh, alignment: Alignment,
               settings: MeshSurfaceSettings, mesher: str) -> dict[str, Any]:
    """Result of the stage for a body."""
    quality = measure_quality(mesh, surface.volume, skeleton, surface)
    return {
        "point_count": len(surface.vertices), "node_count": skeleton.node_count,
        "branch_count": 1, "length_m": skeleton.length, "main_length_m": skeleton.length,
        "radius_min_m": float(skeleton.radius.min()),
        "radius_max_m": float(skeleton.radius.max()), "clamped_radius_count": 0,
        "surface_volume_m3": surface.volume, "mesh_volume_m3": quality.volume_m3,
        "tet_count": mesh.tet_count, "mesh_node_count": mesh.node_count, "mesher": mesher,
        "watertight": True, "mesh_quality": quality.as_dict(),
        "peak_memory_mb": peak_memory_mb(),
        "gravity_m_s2": gravity_after(alignment, settings.up)}


def section_axis(surface: Surface, root: np.ndarray | None) -> Skeleton:
    """Return the axis of a slender solid: centroids of its cross-sections along its length.

    Radii are those of circles with the sections' areas. The body is one unforked run that starts at
    ``root``, or at the thicker end.

    Args:
        surface: Closed.
        root: A point near the end that is held [m], shape [3], or None.
    """
    axis = _long_axis(surface)
    along = surface.vertices @ axis
    low, high = float(along.min()), float(along.max())
    centres, radii = [], []
    for at in low + (high - low) * (np.arange(_SECTIONS) + 0.5) / _SECTIONS:
        area, centre = _section(surface, axis, at)
        if area > 0:
            centres.append(centre)
            radii.append(np.sqrt(area / np.pi))
    if len(centres) < 4:
        raise InputError("The surface has no clear long axis.", "The body is not slender.",
                         "Use a surface that is longer than it is thick.")
    return _to_the_ends(np.array(centres), np.array(radii), axis, low, high, root)


def _long_axis(surface: Surface) -> np.ndarray:
    """Unit vector of the solid's least moment of inertia, from tetrahedra to the origin."""
    corner = surface.vertices[surface.faces]
    volume = np.linalg.det(corner) / 6.0
    mean = corner.sum(axis=1) / 4.0
    centre = (volume[:, None] * mean).sum(axis=0) / volume.sum()
    # Second moments of a tetrahedron with one corner at the origin (Tonon 2004).
    total = corner.sum(axis=1)
    second = np.einsum("t,tij->ij", volume / 20.0, np.einsum(
        "tki,tkj->tij", corner, corner) + np.einsum("ti,tj->tij", total, total))
    spread = second - volume.sum() * np.outer(centre, centre)
    return np.linalg.eigh(spread)[1][:, -1]


def _section(surface: Surface, axis: np.ndarray, at: float) -> tuple[float, np.ndarray]:
    """Area [m^2] and centroid [m] of the cut by the plane ``axis . x = at``, by Green's theorem."""
    height = surface.vertices @ axis - at
    above = height[surface.faces] > 0
    cut = np.flatnonzero(above.any(axis=1) & ~above.all(axis=1))
    starts, ends = [], []
    for k in range(3):
        a, b = surface.faces[cut, k], surface.faces[cut, (k + 1) % 3]
        share = height[a] / np.where(height[a] == height[b], 1.0, height[a] - height[b])
        point = surface.vertices[a] + share[:, None] * (surface.vertices[b] - surface.vertices[a])
        down, up = above[cut, k] & ~above[cut, (k + 1) % 3], ~above[cut, k] & above[
            cut, (k + 1) % 3]
        starts.append((point, down))
        ends.append((point, up))
    if len(cut) == 0:
        return 0.0, np.zeros(3)
    start = sum(np.where(used[:, None], point, 0.0) for point, used in starts)
    end = sum(np.where(used[:, None], point, 0.0) for point, used in ends)
    origin = start.mean(axis=0)
    p, q = start - origin, end - origin
    twice = np.cross(p, q) @ axis
    area = twice.sum() / 2
    if abs(area) < 1e-300:
        return 0.0, origin
    return abs(float(area)), origin + (twice[:, None] * (p + q)).sum(axis=0) / (6 * area)


def _to_the_ends(centres: np.ndarray, radii: np.ndarray, axis: np.ndarray, low: float,
                 high: float, root: np.ndarray | None) -> Skeleton:
    first = centres[0] + (low - centres[0] @ axis) * axis
    last = centres[-1] + (high - centres[-1] @ axis) * axis
    nodes = np.vstack([first, centres, last])
    radius = np.concatenate([radii[:1], radii, radii[-1:]])
    if root is not None:
        turn = np.linalg.norm(nodes[-1] - root) < np.linalg.norm(nodes[0] - root)
    else:
        quarter = max(len(radius) // 4, 1)
        turn = radius[-quarter:].mean() > 1.02 * radius[:quarter].mean()
    if turn:
        nodes, radius = nodes[::-1], radius[::-1]
    return Skeleton.from_edges(nodes, np.arange(len(nodes)) - 1, radius)


def aligned_body(surface: Surface, skeleton: Skeleton, scale: float,
                 settings: MeshSurfaceSettings) -> tuple[Alignment, Surface, Skeleton]:
    """From a file's coordinates to the body's own: its root at the origin, and upright."""
    root = skeleton.nodes[0]
    rotation = upright_rotation(skeleton, np.array(settings.up), settings.upright)
    alignment = Alignment(scale=scale, origin=tuple(root.tolist()),
                          rotation=tuple(map(tuple, rotation.tolist())))
    return (alignment, Surface((surface.vertices - root) @ rotation.T, surface.faces),
            skeleton.moved((skeleton.nodes - root) @ rotation.T))
