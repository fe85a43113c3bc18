"""Tubes along bent axes whose slices are not folded over."""

import numpy as np

from limber.geometry.skeleton.sweep import bending_factor, frames, rings, tangents
from limber.geometry.tets.cylinder_mesh import tube
from limber.geometry.tets.quality import FLAT, shapes
from limber.geometry.tets.run_axis import RunAxis
from limber.geometry.tets.slices import Window, ring_positions
from limber.geometry.tets.tet_mesh import TetMesh

_SHIFTS = (1, -1, 2, -2, 3, -3)  # shifts tried for a twig's slice, in its own lengths


def unfolded(axis: RunAxis, start: float, windows: list[Window], sides: int, spacing: float,
             first_normal: np.ndarray | None, first_tangent: np.ndarray | None,
             ) -> tuple[np.ndarray, TetMesh]:
    """Rings along an axis whose prisms are not folded over, if possible.

    Cross-sections cross in a sharp bend; with one fewer they may not. A twig's slice there moves
    along the axis, and is given up (removed from ``windows``) if no position is left.

    Args:
        axis, start: Axis of the run, and position of its first ring along it [m].
        windows: Slices of its twigs; changed in place.
        sides: Corners of a ring.
        spacing: Length of a slice in local radii.
        first_normal: Direction of the first ring's first corner, shape [3]; None: any.
        first_tangent: Normal of the first ring, shape [3]; None: along the axis.

    Returns:
        Positions of the rings along it [m], and the tetrahedra.
    """
    moves = dict.fromkeys((window.run for window in windows), 0)
    first_low = {window.run: window.low for window in windows}
    where, ends = ring_positions(axis, start, windows, spacing), [start, axis.length]
    for _ in range(len(where) + 20):
        mesh = _tube_mesh(axis, where, sides, first_normal, first_tangent)
        flat = shapes(mesh.nodes[mesh.tets]) < FLAT
        if not flat.any():
            break
        folded = np.unique(np.flatnonzero(flat) // (3 * sides))
        kept = np.array([v for w in windows for v in (w.low, w.high)] + ends)
        loose = _loose(where, folded, kept)
        low, high = where[folded[0]:folded[0] + 2]
        touching = [w for w in windows if w.low < high + 1e-9 and w.high > low - 1e-9]
        if loose:
            where = np.delete(where, loose)
        elif touching:
            _move_on(touching[0], windows, moves, first_low[touching[0].run], *ends)
            where = ring_positions(axis, start, windows, spacing)
        else:
            break
    return where, mesh


def _loose(where: np.ndarray, folded: np.ndarray, kept: np.ndarray) -> list[int]:
    """One ring of each folded slice that need not be kept; none of two slices side by side."""
    found: list[int] = []
    for low in folded:
        free = [ring for ring in (low + 1, low) if np.abs(where[ring] - kept).min() > 1e-9]
        if free and not (found and low <= found[-1]):
            found.append(int(free[0]))
    return found


def _move_on(window: Window, windows: list[Window], moves: dict[int, int], first_low: float,
             start: float, end: float) -> None:
    """Move a twig's slice to the next untried position, or give it up."""
    windows.remove(window)
    moves[window.run] += 1
    length = window.high - window.low
    for shift in _SHIFTS[moves[window.run] - 1:]:
        low = first_low + shift * length
        if start + 0.2 * length < low and low + length < end:
            windows.append(Window(window.run, low, low + length, window.outward))
            break
        moves[window.run] += 1


def _tube_mesh(axis: RunAxis, where: np.ndarray, sides: int, first_normal: np.ndarray | None,
               first_tangent: np.ndarray | None) -> TetMesh:
    """Tetrahedra of a tube with rings at positions ``where`` [m] along an axis."""
    centres = axis.at(where)
    tangent = tangents(centres)
    # The flat end replaces a round one of the same volume.
    centres[-1] += 2 / 3 * axis.radius[-1] * tangent[-1]
    if first_tangent is not None:
        tangent[0] = first_tangent
    normals, binormals = frames(centres, tangent, first_normal)
    ring = rings(centres, axis.radius_at(where), normals, binormals, sides, bending_factor(sides))
    return tube(centres, ring)
