"""From a body drawn as sections along its axis, of width and height, to tetrahedra.

Not every branch is round, and a test beam is drawn, not scanned. A table has the axis, at each
position the width and the height of the ellipse across it, and the mass attached there.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.constants import UNIT_METRES
from limber.core.errors import InputError
from limber.core.files.reading import csv_records
from limber.geometry.io.formats import Format
from limber.geometry.mesh_surface import MeshedBody, aligned_body, numbers_of
from limber.geometry.settings import MeshSurfaceSettings
from limber.geometry.skeleton.control_points import FRACTIONS
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.skeleton.sweep import bending_factor, frames, resample, rings, tangents
from limber.geometry.surface.surface import Surface
from limber.geometry.tets.cylinder_mesh import swept
from limber.geometry.tets.marks import mark
from limber.geometry.tets.tet_mesh import TetMesh

COLUMNS = ("x", "y", "z", "width", "height")
MASS = "mass_kg"
SLICE, SIDES = 5.0, 8 / 3
"""Length of a slice for one element across, in half the smaller thickness; corners of a section per
element across.
"""
_UPWARDS = 0.3  # sine of the angle between axis and vertical below which the axis has no upper side


@dataclass(frozen=True)
class Sections:
    """Ellipses across an axis, from the end that is held.

    Attributes:
        axis: Their centres [m], shape [n, 3].
        width: Their thickness sideways [m], shape [n].
        height: Their thickness upwards [m], shape [n].
        mass: Mass attached at each in addition to the body itself [kg], shape [n].
    """

    axis: np.ndarray
    width: np.ndarray
    height: np.ndarray
    mass: np.ndarray

    @property
    def radius(self) -> np.ndarray:
        """Radii of circles of the same areas [m], shape [n]."""
        return np.sqrt(self.width * self.height) / 2


def read_sections(path: Path, unit: str) -> Sections:
    """Read a table with the columns x, y, z, width, height and optionally mass_kg.

    Lengths are in ``unit``, or in that of a column's name (``width_mm``).

    Raises:
        InputError: a column is missing, a value is not a number, or a size is not positive.
    """
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
                  ) -> tuple[MeshedBody, list[dict[str, Any]]]:
    """Sweep tetrahedra along drawn sections and mark base, control points and grasp.

    Width is across axis and up, height across axis and width. If the axis starts upwards, width is
    along x as far as possible. From there both follow the axis without a twist.

    Returns:
        The body, and the masses attached to it, as in ``point_masses.json``.
    """
    skeleton = Skeleton.from_edges(sections.axis, np.arange(len(sections.axis)) - 1,
                                   sections.radius)
    mesh = _swept(sections, settings)
    faces = mesh.surface_faces()
    used, corners = np.unique(faces, return_inverse=True)
    surface = Surface(mesh.nodes[used], corners.reshape(-1, 3))
    alignment, surface, skeleton = aligned_body(surface, skeleton, UNIT_METRES[settings.unit],
                                                settings)
    turn = np.array(alignment.rotation)
    mesh = mark(TetMesh((mesh.nodes - sections.axis[0]) @ turn.T, mesh.tets).quadratic(), skeleton,
                young=settings.young, poisson=settings.poisson, density=settings.density,
                fractions=FRACTIONS, grasp_fraction=settings.grasp_fraction)
    masses = [{"kind": "table", "attached_m": node.tolist(), "mass_kg": float(mass)}
              for node, mass in zip(skeleton.nodes, sections.mass, strict=True) if mass > 0]
    numbers = numbers_of(surface, skeleton, mesh, alignment, settings, "sweep")
    return MeshedBody(alignment, skeleton, surface, mesh, numbers | {
        "hung_mass_kg": float(sections.mass.sum())}), masses


def _swept(sections: Sections, settings: MeshSurfaceSettings) -> TetMesh:
    """Linear tetrahedra whose cross-sections bend as the ellipses do."""
    thin = np.minimum(sections.width, sections.height) / 2
    spacing = SLICE / settings.elements_across * thin
    centres, width = resample(sections.axis, sections.width, spacing)
    height = resample(sections.axis, sections.height, spacing)[1]
    sides = max(6, round(SIDES * settings.elements_across))
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
