"""Search results saved beside a plan: ``plans/NAME-trees.csv`` and ``plans/NAME-bound.npz``.

The trees: one row per node with its planner, its position, and the row of its parent (-1: none).
The bound: least cost of a path from any position, on the first grid of the certificate, which
covers the whole sampled region.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from limber.core.errors import BranchFolderError
from limber.core.files.reading import csv_records, read_arrays, require_shapes

_POSITION = ("x_m", "y_m", "z_m")
_WHAT = "the bound of a plan"


@dataclass(frozen=True)
class CostToGo:
    """A lower bound on the cost of any path to the goal, from the centres of a grid's cells.

    Attributes:
        origin: Corner of the first cell [m], shape [3].
        axes: Axes of the grid, unit, as rows, shape [3, 3].
        spacing: Edge of a cell [m].
        costs: NaN where no path leads, shape [nx, ny, nz].
    """

    origin: np.ndarray
    axes: np.ndarray
    spacing: float
    costs: np.ndarray

    def at(self, points: np.ndarray) -> np.ndarray:
        """Return it at ``points`` [n, 3] between the centres, for pictures.

        A region may be thinner than a cell: an unknown cell takes the value of the nearest known
        one. NaN outside the grid.
        """
        from scipy.ndimage import distance_transform_edt, map_coordinates

        nearest = distance_transform_edt(np.isnan(self.costs), return_distances=False,
                                         return_indices=True)
        indices = ((points - self.origin) @ self.axes.T) / self.spacing - 0.5
        return map_coordinates(self.costs[tuple(nearest)], indices.T, order=1, cval=np.nan)

    def write(self, path: Path) -> None:
        """Write it as plain arrays; -1 where it is not known."""
        np.savez_compressed(path, origin_m=self.origin, axes=self.axes,
                            costs=np.nan_to_num(self.costs, nan=-1.0),
                            spacing_m=np.array(self.spacing))

    @classmethod
    def read(cls, path: Path) -> "CostToGo":
        """Read a file that :meth:`write` wrote.

        Raises:
            InputError: the file is damaged.
        """
        arrays = read_arrays(path, _WHAT)
        require_shapes(path, arrays, {"origin_m": (3,), "axes": (3, 3), "spacing_m": (),
                                      "costs": ("x", "y", "z")}, _WHAT)
        costs = np.where(arrays["costs"] < 0.0, np.nan, arrays["costs"])
        return cls(arrays["origin_m"], arrays["axes"], float(arrays["spacing_m"]), costs)


def read_trees(path: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return nodes [n, 3] [m] and parents [n] of each planner's search tree, by planner.

    A parent comes before its children; the first node is the start and has the parent -1.

    Raises:
        BranchFolderError: the file is damaged.
    """
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
                             "Run `limber plan` again with --force.")
