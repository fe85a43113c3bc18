"""Bodies given without a scan, as a surface, cylinders or sections, to tetrahedra."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.alignment import Alignment
from limber.core.constants import UNIT_METRES
from limber.core.errors import InputError, MeshingError, Option, Text
from limber.core.files.tables import csv_records
from limber.core.progress import SILENT, Progress
from limber.geometry.cloud.preparation import size_doubts
from limber.geometry.io.formats import Format, known_format
from limber.geometry.io.skeletons import SKELETONS, read_skeleton
from limber.geometry.io.surfaces import SURFACES
from limber.geometry.reconstruction import gravity_after, marked, mesh_skeleton, numbers_of
from limber.geometry.settings import MeshSurfaceSettings, ReconstructSettings
from limber.geometry.skeleton.skeleton import Skeleton, upright_rotation
from limber.geometry.skeleton.sweep import bending_factor, frames, resample, rings, tangents
from limber.geometry.surface.surface import Surface
from limber.geometry.tets.tet_mesh import TetMesh
from limber.geometry.tets.tetrahedra import tetrahedralise
from limber.geometry.tets.tree_sweep import swept

# From the closed surface of any slender body to tetrahedra with axis, base and grasp.

ELEMENTS_ACROSS = 3.0
"""Elements across a body's thickness."""
_SECTIONS = 24  # cross-sections of an axis
_SECONDS = 600.0  # of processor time for fTetWild; there are no axes to sweep along


@dataclass(frozen=True)
class MeshedBody:
    """A solid in its own frame, filled with tetrahedra. ``alignment`` leads there from the file's
    coordinates; ``mesh`` has material, base, control points and grasp."""

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
    try:
        mesh, cached = tetrahedralise(
            surface, edge_length=2 * thick / ELEMENTS_ACROSS, epsilon=0.02 * thick,
            time_limit=_SECONDS, stop_energy=10.0, progress=progress.part(0.1, 0.9))
    except MeshingError as error:  # there are no axes to sweep along
        raise MeshingError(error.seen, error.why, "Simplify the surface.") from error
    return _marked_body(alignment, skeleton, surface, mesh, settings,
                        "ftetwild (cached)" if cached else "ftetwild")


def _marked_body(alignment: Alignment, skeleton: Skeleton, surface: Surface, mesh: TetMesh,
                 settings: MeshSurfaceSettings, mesher: str) -> MeshedBody:
    gravity = gravity_after(alignment, settings.up)
    mesh = marked(mesh, skeleton, settings, gravity)
    return MeshedBody(alignment, skeleton, surface, mesh, numbers_of(
        skeleton, surface, mesh, mesher, skeleton) | {
            "point_count": len(surface.vertices), "gravity_m_s2": gravity})


def section_axis(surface: Surface, root: np.ndarray | None) -> Skeleton:
    """Return the axis of a slender solid, one run from ``root`` [3] [m] or the thicker end:
    centroids of its cross-sections, with radii of circles of the same area."""
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
    cut = above.any(axis=1) & ~above.all(axis=1)
    if not cut.any():
        return 0.0, np.zeros(3)
    # The corner that is alone on its side, and the two others in the order of the face.
    is_top = above[cut].sum(axis=1) == 1
    first = np.argmax(above[cut] == is_top[:, None], axis=1)
    alone, *others = (np.take_along_axis(surface.faces[cut], (first[:, None] + k) % 3, 1)[:, 0]
                      for k in range(3))
    p, q = (surface.vertices[alone] + (height[alone] / (height[alone] - height[other]))[:, None]
            * (surface.vertices[other] - surface.vertices[alone]) for other in others)
    origin = (p + q).mean(axis=0) / 2
    p, q = p - origin, q - origin
    twice = np.where(is_top, 1.0, -1.0) * (np.cross(p, q) @ axis)
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


# From a body drawn as sections along its axis, of width and height, to tetrahedra.
#
# Not every branch is round, and a test beam is drawn, not scanned. A table has the axis, at each
# position the width and the height of the ellipse across it, and the mass attached there.

COLUMNS = ("x", "y", "z", "width", "height")
MASS = "mass_kg"
SLICE, SIDES = 5.0, 8 / 3
"""Length of a slice for one element across, in half the smaller thickness; corners of a section per
element across.
"""
_UPWARDS = 0.3  # sine of the angle between axis and vertical below which the axis has no upper side


@dataclass(frozen=True)
class Sections:
    """Ellipses across ``axis`` [n, 3] [m] from the held end: ``width`` (sideways) and ``height``
    [m], and ``mass`` [kg] attached there beside the body itself, shape [n] each."""

    axis: np.ndarray
    width: np.ndarray
    height: np.ndarray
    mass: np.ndarray

    @property
    def radius(self) -> np.ndarray:
        """Radii of circles of the same areas [m], shape [n]."""
        return np.sqrt(self.width * self.height) / 2


def read_sections(path: Path, unit: str) -> Sections:
    """Read a table with x, y, z, width, height and optionally mass_kg, in ``unit`` or the unit of a
    column's name (``width_mm``). InputError if a column is missing or a value is invalid."""
    rows = csv_records(path, "a table of sections", comment="#")
    titles = [title.strip() for title in rows[0] if title] if rows else []
    found = {}
    for title in titles:
        head, _, tail = title.rpartition("_")
        name, scale = (head, UNIT_METRES[tail]) if head and tail in UNIT_METRES else (
            title, UNIT_METRES[unit])
        if name in COLUMNS or title == MASS:
            found[title if title == MASS else name] = (title, 1.0 if title == MASS else scale)
    missing = [name for name in COLUMNS if name not in found]
    if missing or len(rows) < 2:
        raise InputError(
            f"{path} has {len(rows)} rows and the columns {', '.join(titles) or 'none'}.",
            "A body needs at least two sections, each with a position on the axis, a width and a "
            "height.", "Write the columns x,y,z,width,height (and mass_kg for an attached mass).")
    try:
        columns = {name: scale * np.array([float(row[title]) for row in rows])
                   for name, (title, scale) in found.items()}
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: {error}.", "Each row needs a number in every column.",
                         "Complete the table.") from error
    mass = columns.pop(MASS, np.zeros(len(rows)))
    made = Sections(np.column_stack([columns[name] for name in COLUMNS[:3]]), columns["width"],
                    columns["height"], mass)
    if not (np.isfinite(made.axis).all() and np.all(np.minimum(made.width, made.height) > 0)
            and np.all(mass >= 0)):
        raise InputError(f"{path} has a position that is not finite, a width or height that is not "
                         "positive, or a negative mass.", "A body cannot have such a section.",
                         "Correct the table.")
    if np.any(np.linalg.norm(np.diff(made.axis, axis=0), axis=1) == 0):
        raise InputError(f"{path} has the same position in two consecutive rows.",
                         "Consecutive sections must be apart.", "Omit one of them.")
    return made


SECTIONS = Format("sections", (".csv",), read_sections)


def mesh_sections(sections: Sections, settings: MeshSurfaceSettings,
                  elements_across: float = ELEMENTS_ACROSS,
                  ) -> tuple[MeshedBody, list[dict[str, Any]]]:
    """Sweep tetrahedra along drawn sections: a marked body, and its masses as in
    ``point_masses.json``. Width is across axis and up (along x if the axis starts upwards), height
    across both. From there they follow the axis without a twist."""
    skeleton = Skeleton.from_edges(sections.axis, np.arange(len(sections.axis)) - 1,
                                   sections.radius)
    mesh = _swept(sections, settings, elements_across)
    faces = mesh.surface_faces()
    used, corners = np.unique(faces, return_inverse=True)
    surface = Surface(mesh.nodes[used], corners.reshape(-1, 3))
    alignment, surface, skeleton = aligned_body(surface, skeleton, UNIT_METRES[settings.unit],
                                                settings)
    turn = np.array(alignment.rotation)
    body = _marked_body(alignment, skeleton, surface, TetMesh(
        (mesh.nodes - sections.axis[0]) @ turn.T, mesh.tets).quadratic(), settings, "sweep")
    masses = [{"kind": "table", "attached_m": node.tolist(), "mass_kg": float(mass)}
              for node, mass in zip(skeleton.nodes, sections.mass, strict=True) if mass > 0]
    return replace(body, numbers=body.numbers | {
        "hung_mass_kg": float(sections.mass.sum())}), masses


def _swept(sections: Sections, settings: MeshSurfaceSettings,
           elements_across: float) -> TetMesh:
    """Linear tetrahedra whose cross-sections bend as the ellipses do."""
    thin = np.minimum(sections.width, sections.height) / 2
    spacing = SLICE / elements_across * thin
    centres, width = resample(sections.axis, sections.width, spacing)
    height = resample(sections.axis, sections.height, spacing)[1]
    sides = max(6, round(SIDES * elements_across))
    tangent = tangents(centres)
    upper, across = frames(centres, tangent, _upper(tangent[0], np.array(settings.up)))
    ring = rings(np.zeros_like(centres), np.ones(len(centres)), upper, across, sides,
                 bending_factor(sides))
    # If scaled in each direction separately, a polygon keeps the second moments that it has of a
    # circle.
    stretched = (np.einsum("nsj,nj->ns", ring, upper)[..., None] * upper[:, None]
                 * height[:, None, None]
                 + np.einsum("nsj,nj->ns", ring, across)[..., None] * across[:, None]
                 * width[:, None, None]) / 2
    return swept(centres, centres[:, None] + stretched)


def _upper(tangent: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Direction of the first section's height, shape [3]."""
    up = up / np.linalg.norm(up)
    above = up - (up @ tangent) * tangent
    if np.linalg.norm(above) >= _UPWARDS:
        return above
    sideways = np.eye(3)[0] if abs(tangent[0]) < 0.9 else np.eye(3)[1]
    return np.cross(sideways - (sideways @ tangent) * tangent, tangent)


# From a cylinder model alone, without its scan, to a closed surface and tetrahedra.


def body_format(path: Path) -> Format:
    """Return the kind of a file given to `limber mesh`: a cylinder model, sections or a surface.
    InputError if it is none."""
    return known_format(path, "body", [*SKELETONS.readers(), SECTIONS, *SURFACES.readers()])


def mesh_model(path: Path, settings: MeshSurfaceSettings, progress: Progress = SILENT,
               ) -> tuple[MeshedBody, list[dict[str, Any]]]:
    """Return the branch of a cylinder model, and the masses of the pruned twigs. InputError for an
    unusable model, or a given root at another end than its own. MeshingError if it cannot be
    meshed."""
    scale = UNIT_METRES[settings.unit]
    read = read_skeleton(path, scale=scale, near=settings.root, progress=progress)
    ends = read.nodes[np.r_[0, np.flatnonzero(read.child_counts() == 0)]]
    if settings.root is not None and np.linalg.norm(
            ends - scale * np.array(settings.root), axis=1).argmin() > 0:
        raise InputError(Text("A tip of the cylinder model is nearer to the root (",
                              Option("root"), ") than its own root."),
                         "The model defines its own root.", "Omit ", Option("root"), ".")
    if (read.radius <= 0).any():
        raise InputError(f"{int((read.radius <= 0).sum())} of {read.node_count} nodes of {path} "
                         "have radius 0.", "A branch has a thickness.",
                         "Give each node its radius.")
    for text in size_doubts(read.nodes, "cylinder model", settings.unit,
                            is_stated="unit" in settings.model_fields_set):
        progress.warn(text)
    alignment, skeleton = _aligned(read, scale, settings)
    meshed = mesh_skeleton(skeleton, ReconstructSettings(
        young=settings.young, poisson=settings.poisson, density=settings.density,
        grasp_fraction=settings.grasp_fraction, leave_out=True),
        gravity_after(alignment, settings.up), progress)
    return MeshedBody(alignment, skeleton, meshed.surface, meshed.mesh, meshed.numbers | {
        "point_count": len(meshed.surface.vertices),
        "gravity_m_s2": gravity_after(alignment, settings.up)}), meshed.masses


def _aligned(skeleton: Skeleton, scale: float, settings: MeshSurfaceSettings,
             ) -> tuple[Alignment, Skeleton]:
    root = skeleton.nodes[0]
    turn = upright_rotation(skeleton, np.array(settings.up), settings.upright)
    return (Alignment(scale=scale, origin=tuple(root.tolist()),
                      rotation=tuple(map(tuple, turn.tolist()))),
            skeleton.moved((skeleton.nodes - root) @ turn.T))
