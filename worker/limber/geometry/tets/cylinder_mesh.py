"""Structured tetrahedral meshes swept along axes: deterministic, fast, of known quality."""

import numpy as np

from limber.core.errors import InputError
from limber.geometry.skeleton.sweep import frames, resample, rings, tangents
from limber.geometry.tets.tet_mesh import TetMesh


def straight_beam(length: float, radius_root: float, radius_tip: float | None = None, *,
                  slice_count: int | None = None, sides: int = 6,
                  direction: tuple[float, float, float] = (0.0, 0.0, 1.0),
                  quadratic: bool = True, young: float = 1e8, poisson: float = 0.35,
                  density: float = 900.0, fractions: tuple[float, ...] = (0.2, 0.4, 0.6, 0.8),
                  grasp_fraction: float = 1.0) -> TetMesh:
    """Mesh a straight round beam that starts at the origin and is fixed there.

    The cross-section is a regular polygon of the circle's area (for 6 sides its second moment is
    0.8 % over the circle's), with one node on the axis.

    Args:
        length: Length [m].
        radius_root: Radius at the origin [m].
        radius_tip: Radius at the end [m]; None: as at the root.
        slice_count: Number of slices; None: each about two radii long.
        sides: Sides of the polygon.
        direction: Direction of the beam.
        quadratic: 10-node tetrahedra, else 4-node ones.
        young: Young's modulus [Pa].
        poisson: Poisson's ratio.
        density: Density [kg/m^3].
        fractions: Positions of the control points on the axis.
        grasp_fraction: Position of the grasp patch; at 1 the end face.

    Returns:
        A mesh with all the data that a branch's mesh has.
    """
    radius_tip = radius_root if radius_tip is None else radius_tip
    if not (length > 0 and radius_root > 0 and radius_tip > 0):
        raise InputError("The length and the radii of a beam must be positive.", "",
                         "Give them in metres.")
    if slice_count is None:
        slice_count = max(round(length / (radius_root + radius_tip)), 4)
    axis = np.array(direction, float) / np.linalg.norm(direction)
    centres = np.linspace(0, length, slice_count + 1)[:, None] * axis
    radius = np.linspace(radius_root, radius_tip, slice_count + 1)
    mesh = sweep_run(centres, radius, sides=sides)
    if quadratic:
        mesh = mesh.quadratic()
    return _with_beam_data(mesh, axis, length, fractions, grasp_fraction, young, poisson, density)


def curved_beam(points: np.ndarray, radius: np.ndarray, *, slice_length: float = 2.0,
                sides: int = 6, quadratic: bool = True) -> TetMesh:
    """Mesh a round beam along a polyline, without data on the mesh.

    Args:
        points: Axis [m], shape [n, 3].
        radius: Radii [m], shape [n].
        slice_length: Length of a slice in local radii.
        sides: Sides of the cross-section.
        quadratic: 10-node tetrahedra, else 4-node ones.
    """
    centres, radii = resample(np.asarray(points, float), np.asarray(radius, float),
                              slice_length * np.asarray(radius, float))
    mesh = sweep_run(centres, radii, sides=sides)
    return mesh.quadratic() if quadratic else mesh


def sweep_run(centres: np.ndarray, radius: np.ndarray, *, sides: int = 6) -> TetMesh:
    """Linear tetrahedra of the tube with rings around ``centres`` [n, 3]: one slice a step."""
    tangent = tangents(centres)
    normals, binormals = frames(centres, tangent)
    return swept(centres, rings(centres, radius, normals, binormals, sides))


def swept(centres: np.ndarray, ring: np.ndarray) -> TetMesh:
    """Linear tetrahedra of the tube with these rings, shape [n, sides, 3], around ``centres``."""
    return tube(centres, ring).oriented()


def tube(centres: np.ndarray, ring: np.ndarray) -> TetMesh:
    """The same, oriented like the rings."""
    count, sides = ring.shape[:2]
    nodes = np.concatenate([centres[:, None], ring], axis=1).reshape(-1, 3)
    centre, a = np.zeros(sides, np.int64), 1 + np.arange(sides)
    triangle = np.stack([centre, a, 1 + a % sides], axis=1)
    low = triangle + (np.arange(count - 1) * (sides + 1))[:, None, None]
    return TetMesh(nodes, split_wedges(np.concatenate(
        [low, low + sides + 1], axis=2).reshape(-1, 6)))


def split_wedges(wedges: np.ndarray) -> np.ndarray:
    """Split triangular prisms into three tetrahedra each, consistently on shared faces.

    Each quadrilateral is cut from its corner of the lowest index, so neighbours agree: Dompierre
    et al., How to subdivide pyramids, prisms and hexahedra into tetrahedra (1999).

    Args:
        wedges: Corners, shape [n, 6]: a triangle and, above it, its copy.
    """
    turns = np.array([[0, 1, 2, 3, 4, 5], [1, 2, 0, 4, 5, 3], [2, 0, 1, 5, 3, 4],
                      [3, 5, 4, 0, 2, 1], [4, 3, 5, 1, 0, 2], [5, 4, 3, 2, 1, 0]])
    # After the rotation the lowest index is first, so two quadrilaterals are cut from corner 0.
    w = np.take_along_axis(wedges, turns[np.argmin(wedges, axis=1)], axis=1)
    first = np.minimum(w[:, 1], w[:, 5]) < np.minimum(w[:, 2], w[:, 4])
    tets = np.where(
        first[:, None, None],
        w[:, [[0, 1, 2, 5], [0, 1, 5, 4], [0, 4, 5, 3]]],
        w[:, [[0, 1, 2, 4], [0, 4, 2, 5], [0, 4, 5, 3]]])
    return tets.reshape(-1, 4)


def _with_beam_data(mesh: TetMesh, axis: np.ndarray, length: float, fractions: tuple[float, ...],
                    grasp_fraction: float, young: float, poisson: float, density: float) -> TetMesh:
    along = mesh.nodes @ axis
    control = np.full(mesh.node_count, -1, np.int64)
    for k, fraction in enumerate(fractions):
        distance = np.linalg.norm(mesh.nodes - fraction * length * axis, axis=1)
        control[int(np.argmin(distance))] = k
    planes = np.unique(np.round(along, 12))
    grasp_plane = planes[int(np.argmin(np.abs(planes - grasp_fraction * length)))]
    tolerance = 1e-9 * length
    full = np.ones(mesh.tet_count)
    return mesh.with_data(
        cell_data={"young": young * full, "poisson": poisson * full, "density": density * full},
        point_data={"fixed": (along < tolerance).astype(np.int64), "control_point": control,
                    "grasp": (np.abs(along - grasp_plane) < 1e-6 * length).astype(np.int64)})
