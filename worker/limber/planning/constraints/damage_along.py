"""Where a planned path would damage the branch: strain and probability along the branch."""

import csv
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import numpy as np
from scipy.spatial import cKDTree

from limber.core.errors import InputError
from limber.core.files.reading import read_columns
from limber.geometry.skeleton.skeleton import Skeleton
from limber.mechanics.strain import strain_state
from limber.planning.constraints.damage import Strength
from limber.planning.field.grasp_model import GraspModel

_COLUMNS = ("x_m", "y_m", "z_m", "parent", "strain")
_PROBABILITY = "damage_probability"
_WHAT = "the table of a plan's damage"


@dataclass(frozen=True)
class DamageAlong:
    """Values at the nodes of the branch's axes.

    Attributes:
        nodes: Positions in the hanging branch [m], shape [n, 3].
        parents: Row of each node's parent, -1 for the root, shape [n].
        strains: Largest principal strain there in any state of the motion, shape [n].
        probabilities: Probability that this strain breaks the branch there, shape [n]; None if the
            strength is not known.
    """

    nodes: np.ndarray
    parents: np.ndarray
    strains: np.ndarray
    probabilities: np.ndarray | None

    @classmethod
    def of(cls, grasp_model: GraspModel, skeleton: Skeleton, displacements: Iterable[np.ndarray],
           strength: Strength | None) -> "DamageAlong":
        """Return the values for the states with ``displacements`` [nodes, 3] each [m]."""
        model, mesh = grasp_model.model, grasp_model.mesh
        largest = np.zeros(mesh.tet_count)
        for moved in displacements:
            strain = strain_state(model, moved).principal_strain
            largest = np.maximum(largest, np.abs(strain).max(axis=1))
        middles = mesh.nodes[mesh.tets[:, :4]].mean(axis=1)
        # A node without a tetrahedron of its own has the value of the nearest.
        found = largest[cKDTree(middles).query(skeleton.nodes)[1]]
        np.maximum.at(found, cKDTree(skeleton.nodes).query(middles)[1], largest)
        return cls(skeleton.nodes, np.asarray(skeleton.parent), found,
                   None if strength is None else np.array([strength.damage(s) for s in found]))

    def write(self, stream: TextIO) -> None:
        """Write it as CSV, one row per node."""
        writer = csv.writer(stream, lineterminator="\n")
        known = [] if self.probabilities is None else [self.probabilities]
        writer.writerow((*_COLUMNS, *([_PROBABILITY] if known else ())))
        for x, y, z, parent, *values in np.column_stack(
                [self.nodes, self.parents, self.strains, *known]):
            writer.writerow((*(f"{one:.6g}" for one in (x, y, z)), int(parent),
                             *(f"{one:.6g}" for one in values)))

    @classmethod
    def read(cls, path: Path) -> "DamageAlong":
        """Read what :meth:`write` wrote.

        Raises:
            InputError: it is no such table.
        """
        table = read_columns(path, _COLUMNS, _WHAT)
        parents = table["parent"].astype(int)
        if (parents >= np.arange(len(parents))).any() or (parents < -1).any():
            raise InputError(f"A parent in {path} does not come before its node.",
                             "It was not written by `limber plan`, or is damaged.",
                             "Run `limber plan` again with --force.")
        return cls(np.column_stack([table[name] for name in _COLUMNS[:3]]), parents,
                   table["strain"], table.get(_PROBABILITY))
