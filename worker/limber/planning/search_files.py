"""Search results saved beside a plan: ``plans/NAME-trees.csv`` and ``plans/NAME-bound.npz``.

The trees: one row per node with its planner, its position, and the row of its parent (-1: none).
The bound: least cost of a path from any position, on the grids of the certificate. The first
covers the whole sampled region, each later one what was left of it.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from limber.core.errors import BranchFolderError, Command, Option
from limber.core.files.reading import read_arrays, require_shapes
from limber.core.files.tables import csv_records

_POSITION = ("x_m", "y_m", "z_m")
_WHAT = "the bound of a plan"
_OF_GRID = ("origin_m", "edges_m", "costs", "has_cost", "known")


@dataclass(frozen=True)
class BoundGrid:
    """The bound on one grid from ``origin``, the first cell's corner [m]: a quadratic B-spline with
    a coefficient [nx, ny, nz] at each cell's centre, NaN if none, valid in ``known`` cells."""

    origin: np.ndarray
    edges: np.ndarray
    costs: np.ndarray
    known: np.ndarray

    def at(self, points: np.ndarray, axes: np.ndarray, *, fills: bool) -> np.ndarray:
        """Return it at points [n, 3], NaN where unknown. With ``fills`` a missing coefficient is
        the nearest cell's, and the bound is known in the whole grid."""
        from scipy.ndimage import distance_transform_edt, map_coordinates

        costs, known = self.costs, self.known
        if fills:
            costs = costs[tuple(distance_transform_edt(
                np.isnan(costs), return_distances=False, return_indices=True))]
            known = np.ones_like(known)
        numbers = (points - self.origin) @ axes.T / self.edges
        cells, last = np.floor(numbers).astype(int), np.array(costs.shape) - 1
        inside = ((cells >= 0) & (cells <= last)).all(axis=1)
        inside &= known[tuple(np.clip(cells, 0, last).T)]
        values = map_coordinates(np.nan_to_num(costs), numbers.T - 0.5, order=2, prefilter=False,
                                 mode="nearest")
        return np.where(inside, np.maximum(values, 0.0), np.nan)


@dataclass(frozen=True)
class CostToGo:
    """A lower bound on a path's further cost. The first grid, of cubes, holds for any; a later one
    where and for paths that may be cheaper than the known one. Axes [3, 3] are rows."""

    axes: np.ndarray
    grids: tuple[BoundGrid, ...]

    def at(self, points: np.ndarray) -> np.ndarray:
        """Return the largest bound of all grids at points [n, 3], for pictures; the nearest known
        cell's where a region is thinner than one. NaN outside the first grid."""
        out = self.grids[0].at(points, self.axes, fills=True)
        for grid in self.grids[1:]:
            out = np.fmax(out, grid.at(points, self.axes, fills=False))
        return out

    def write(self, path: Path) -> None:
        """Write it as plain arrays; 0 where there is no coefficient. Later grids have a number."""
        arrays = {"axes": self.axes}
        for number, grid in enumerate(self.grids):
            arrays |= {_numbered("origin_m", number): grid.origin,
                       _numbered("edges_m", number): grid.edges,
                       _numbered("costs", number): np.nan_to_num(grid.costs),
                       _numbered("has_cost", number): np.isfinite(grid.costs),
                       _numbered("known", number): grid.known}
        np.savez_compressed(path, **arrays)

    @classmethod
    def read(cls, path: Path) -> "CostToGo":
        """Read a file that :meth:`write` wrote. InputError if the file is damaged."""
        arrays = read_arrays(path, _WHAT)
        grids: list[BoundGrid] = []
        while not grids or _numbered("costs", len(grids)) in arrays:
            origin, edges, costs, has_cost, known = names = [
                _numbered(name, len(grids)) for name in _OF_GRID]
            require_shapes(path, arrays, {"axes": (3, 3)} | dict(zip(
                names, ((3,), (3,), *3 * [("x", "y", "z")]), strict=True)), _WHAT,
                           flags=(has_cost, known))
            grids.append(BoundGrid(arrays[origin], arrays[edges], np.where(
                arrays[has_cost], arrays[costs], np.nan), arrays[known].astype(bool)))
        return cls(arrays["axes"], tuple(grids))


def _numbered(name: str, number: int) -> str:
    return f"{name}_{number}" if number else name


def read_trees(path: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return nodes [n, 3] [m] and parents [n] of each planner's tree: the start first, with -1, and
    parents before children. BranchFolderError if the file is damaged."""
    rows = csv_records(path, "search trees")
    found = {}
    for planner in dict.fromkeys(row.get("planner") or "" for row in rows):
        own = [row for row in rows if row.get("planner") == planner]
        try:
            nodes = np.array([[float(row[name]) for name in _POSITION] for row in own])
            parents = np.array([int(row["parent"]) for row in own], np.int64)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise _damaged(path, str(error)) from error
        if not np.isfinite(nodes).all() or parents[0] != -1 or (
                (parents[1:] < 0) | (parents[1:] >= np.arange(1, len(parents)))).any():
            raise _damaged(path, f"the nodes of {planner} do not form a tree")
        found[planner] = nodes, parents
    return found


def _damaged(path: Path, why: str) -> BranchFolderError:
    return BranchFolderError(f"{path} does not contain search trees ({why}).",
                             "The file is damaged.",
                             "Run ", Command("plan"), " again with ", Option("force", True), ".")
