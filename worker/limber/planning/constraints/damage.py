"""The probability that a branch breaks, from the strains at which similar branches broke.

A branch breaks where its largest strain exceeds its strain at break: a Weibull variable, as is the
strength of brittle and fibrous parts (Weibull 1951). Its shape and scale come from the user's
own break tests, or from a species. A few tests do not determine them well: with shape k and scale s
fitted by maximum likelihood, ``k_fit / k`` and ``k_fit log(s_fit / s)`` have distributions that do
not depend on the truth (Thoman, Bain and Antle 1969). Samples of these distributions give shapes
and scales consistent with the tests. The probability of damage is the mean over them.

The gripper prescribes the pose: the strain there hardly depends on the stiffness, and grows with
the branch's radius.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

import numpy as np
import scipy
from scipy.spatial import cKDTree

from limber.core.errors import Command, InputError, Option, Text
from limber.core.files.tables import csv_records, read_columns, table_text
from limber.geometry.skeleton.skeleton import Skeleton
from limber.kernels import Kernel
from limber.mechanics.materials.materials import LEAST_YOUNG, SPECIES, STRENGTH_OVER_YOUNG
from limber.mechanics.strain import strain_state
from limber.planning.field.grasp_model import GraspModel

ASSUMED_SOURCE = "green wood, assumed"
_FEWEST = 5  # break tests
_DRAWS = 500
_COLUMN = "strain_at_break"
_SPREAD = 0.27
"""Coefficient of variation of a species' strain at rupture: those of modulus of rupture, 16 %, and
of elasticity, 22 %, combined (Wood Handbook, FPL-GTR-190, table 5-6).
"""
_RADII = np.array([-1.8, -1.1, -0.4, 0.4, 1.1, 1.8])  # deviations of the radius, equally likely


@dataclass(frozen=True)
class Strength:
    """The strain at break: equally likely Weibull distributions with shapes and scales (strains)
    [d], and the radius's relative deviation. ``source`` is in words; 0 tests: none."""

    shapes: np.ndarray
    scales: np.ndarray
    radius_deviation: float
    source: str
    tests: int = 0

    @classmethod
    def of_tests(cls, strains: np.ndarray, source: str, radius_deviation: float = 0.0,
                 ) -> "Strength":
        """Return the strength from break tests at ``strains`` [n]. InputError if there are too few,
        or all are equal."""
        if len(strains) < _FEWEST:
            raise InputError(f"{source} has {len(strains)} break tests.",
                             "The scatter of the strength cannot be told from so few.",
                             f"Break at least {_FEWEST} shoots, or give ", Option("wood"), ".")
        if np.ptp(strains) <= 1e-6 * strains.max():
            raise InputError(f"All {len(strains)} break tests of {source} have the same strain.",
                             "Strengths scatter, so these are no measurements.",
                             "State each shoot's own strain at break.")
        shape, scale = (float(one[0]) for one in _fitted(np.log(strains)[None]))
        generator = np.random.default_rng(0)
        standard = np.log(generator.weibull(1.0, (_DRAWS, len(strains))))
        shapes, scales = _fitted(standard)  # of shape 1, scale 1
        return cls(shape / shapes, scale * scales ** (-shapes / shape), radius_deviation, source,
                   len(strains))

    @classmethod
    def of_species(cls, name: str, radius_deviation: float = 0.0) -> "Strength":
        """Return the strength of green wood of a species with a known strain at rupture."""
        mean = SPECIES[name].rupture_strain
        if mean is None:
            raise KeyError(name)
        shape = float(scipy.optimize.brentq(lambda k: _variation(k) - _SPREAD, 1.0, 50.0))
        scale = mean / scipy.special.gamma(1.0 + 1.0 / shape)
        return cls(np.array([shape]), np.array([scale]), radius_deviation,
                   f"green wood of {name} (Wood Handbook)")

    def damage(self, strain: float) -> float:
        """Return the probability that a branch with this strain breaks."""
        felt = max(strain, 0.0) * np.exp(self.radius_deviation * _RADII)
        return float(-np.expm1(-(felt[:, None] / self.scales) ** self.shapes).mean())

    def strain_limit(self, damage: float) -> float:
        """Return the strain at which the probability of damage is ``damage``, between 0 and 1."""
        high = 10.0 * float(self.scales.max())
        return float(np.exp(scipy.optimize.brentq(
            lambda log: self.damage(np.exp(log)) - damage, np.log(1e-9 * high), np.log(high))))

    @property
    def median(self) -> float:
        """The strain that half of such branches bear."""
        return self.strain_limit(0.5)

    def describe(self, strain: float) -> dict[str, Any]:
        """Return the assessment of a largest ``strain`` as plain data."""
        return {"source": self.source, "tests": self.tests, "median_strain": self.median,
                "peak_strain": strain, "damage_probability": self.damage(strain)}


def assumed_strain(young: float) -> float | None:
    """Return the strain at break assumed for a branch with this median modulus [Pa]; None for one
    that is softer than wood."""
    return STRENGTH_OVER_YOUNG if young >= LEAST_YOUNG else None


def assumed(strain: float) -> dict[str, Any]:
    """Return the assessment of a largest ``strain`` in wood of unknown strength, as plain data."""
    return {"source": ASSUMED_SOURCE, "tests": 0, "median_strain": STRENGTH_OVER_YOUNG,
            "peak_strain": strain, "damage_probability": None}


def read_break_tests(path: Path) -> np.ndarray:
    """Return strains at break [n] of a CSV with a column ``strain_at_break``. InputError if there
    is no such file or column, or a value is not a strain."""
    rows = csv_records(path, "a CSV file of break tests")
    if not rows or _COLUMN not in rows[0]:
        raise InputError(f"{path} has no column {_COLUMN}.",
                         "It states the largest strain of each shoot when it broke (0.05 is 5 %).",
                         f"Name that column {_COLUMN}.")
    strains = []
    for number, row in enumerate(rows, start=2):
        try:
            strain = float(row[_COLUMN])
        except (TypeError, ValueError):
            strain = np.nan
        if not 0.0 < strain < 1.0:
            raise InputError(f"Line {number} of {path} has the strain {row[_COLUMN]!r}.",
                             "A strain at break lies between 0 and 1; 0.05 is 5 %.",
                             "Correct or remove the line.")
        strains.append(strain)
    return np.array(strains)


def _variation(shape: float) -> float:
    """Return the coefficient of variation of a Weibull variable."""
    first, second = scipy.special.gamma(1.0 + np.array([1.0, 2.0]) / shape)
    return float(np.sqrt(second / first**2 - 1.0))


_weibull_fitted = Kernel("weibull_fitted", "logs float64[draws, count]",
                         "out shapes float64[draws]", "out scales float64[draws]")


def _fitted(logs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return maximum-likelihood shapes and scales [d] for ``logs`` [d, n] of Weibull variables."""
    shapes, scales = np.empty(len(logs)), np.empty(len(logs))
    _weibull_fitted.of(logs, shapes, scales)
    return shapes, scales


# Where a planned path would damage the branch: strain and probability along the branch.

_COLUMNS = ("x_m", "y_m", "z_m", "parent", "strain")
_PROBABILITY = "damage_probability"
_WHAT = "the table of a plan's damage"


@dataclass(frozen=True)
class DamageAlong:
    """At nodes [n, 3] [m] of the hanging branch's axes, with parent rows (-1: root), the largest
    strain of a motion and the probability [n] that it breaks there (None: strength unknown)."""

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
        known = {} if self.probabilities is None else {_PROBABILITY: self.probabilities}
        rows = np.column_stack([self.nodes, self.strains, *known.values()])
        stream.write(table_text((*_COLUMNS, *known), (
            (*row[:3], parent, *row[3:]) for row, parent in zip(rows, self.parents, strict=True)),
                                digits=6))

    @classmethod
    def read(cls, path: Path) -> "DamageAlong":
        """Read what :meth:`write` wrote. InputError if it is no such table."""
        table = read_columns(path, _COLUMNS, _WHAT)
        parents = table["parent"].astype(int)
        if (parents >= np.arange(len(parents))).any() or (parents < -1).any():
            raise InputError(f"A parent in {path} does not come before its node.",
                             Text("It was not written by ", Command("plan"), ", or is damaged."),
                             "Run ", Command("plan"), " again with ", Option("force", True), ".")
        return cls(np.column_stack([table[name] for name in _COLUMNS[:3]]), parents,
                   table["strain"], table.get(_PROBABILITY))
