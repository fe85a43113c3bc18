"""The cost of a path, and the comparison of two paths.

The paper's edge cost (its eq. 5) adds deformation and distance. Taken literally, summing the energy
over waypoints depends on their spacing and lets a planner win by long edges; so

    J = a_def * integral E ds / (E0 L0) + a_dis * integral ds / L0

with ``E0`` the peak energy and ``L0`` the length of the straight line. It is dimensionless,
additive, and independent of how an edge is divided. Limits on energy and force are part of
validity, not of cost: a branch breaks by the peak, not by the integral.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy

from limber.geometry.skeleton.sweep import arc_lengths
from limber.kernels import Kernel, for_kernels
from limber.planning.field.energy_field import EnergyField, FieldArrays

STEP = 0.005
"""Longest distance between evaluation points of an edge [m]; also the paper-like spacing."""


class EdgeWeights(NamedTuple):
    """Weights of an edge: ``energy`` [1/(J m)], ``length`` [1/m]; ``step`` [m] of quadrature."""

    energy: float
    length: float
    step: float


@dataclass(frozen=True)
class CostWeights:
    """The dimensionless weights ``a_def`` and ``a_dis``, and the scales ``E0`` [J], ``L0`` [m]. The
    baseline RRT* is ``a_def = 0``, ``a_dis = 1``."""

    deformation: float
    distance: float
    energy_scale: float
    length_scale: float

    @classmethod
    def between(cls, field: EnergyField, start: np.ndarray, goal: np.ndarray, deformation: float,
                distance: float) -> "CostWeights":
        """Scale to the straight line from ``start`` to ``goal`` [3]."""
        line = resample(np.stack([start, goal]), STEP)
        line = line[field.region.contains(line)]
        peak = float(field.energy(line).max()) if len(line) else 0.0
        length = float(np.linalg.norm(np.asarray(goal) - start))
        return cls(deformation, distance, peak or float(field.samples.energies.max()),
                   length or STEP)

    @property
    def weights(self) -> EdgeWeights:
        return EdgeWeights(self.deformation / (self.energy_scale * self.length_scale),
                           self.distance / self.length_scale, STEP)


@dataclass(frozen=True)
class PathMeasures:
    """The measures of any path. ``energy_sum_nmm`` sums energies at 5 mm spacing [N mm]: the
    paper's number. ``positive_work_j`` sums the increases of energy along the path."""

    length_m: float
    energy_integral_jm: float
    energy_sum_nmm: float
    peak_energy_j: float
    peak_force_n: float
    positive_work_j: float


def measure_path(positions: np.ndarray, energies: np.ndarray, forces: np.ndarray) -> PathMeasures:
    """Return the measures of a path by positions [n, 3] [m] at 5 mm spacing or less, energies [J]
    and the gripper's force magnitudes [N]."""
    along = arc_lengths(positions)
    spots = np.linspace(0.0, along[-1], max(round(along[-1] / STEP), 1) + 1)
    return PathMeasures(
        length_m=float(along[-1]),
        energy_integral_jm=float(scipy.integrate.trapezoid(energies, along)),
        energy_sum_nmm=float(np.interp(spots, along, energies).sum() * 1e3),
        peak_energy_j=float(energies.max()), peak_force_n=float(forces.max()),
        positive_work_j=float(np.maximum(np.diff(energies), 0.0).sum()))


def resample(path: np.ndarray, spacing: float) -> np.ndarray:
    """Return points of a polyline evenly spaced by at most ``spacing`` [m], ends included."""
    along = arc_lengths(path)
    count = max(int(np.ceil(along[-1] / spacing - 1e-9)), 1)
    spots = np.linspace(0.0, along[-1], count + 1)
    return np.stack([np.interp(spots, along, path[:, k]) for k in range(path.shape[1])], axis=1)


_PATH_COST = Kernel("path_cost", "path float64[points, 3]", "field float64[field]",
                    "energy float", "length float", "step float", returns="float")


def edge_cost(start: np.ndarray, stop: np.ndarray, field: FieldArrays,
              weights: EdgeWeights) -> float:
    """Return the cost of the straight edge; infinite if any of it is not allowed. Midpoint rule at
    ``weights.step`` or finer; ``stop`` is checked, ``start`` is assumed checked."""
    return _PATH_COST(np.array((start, stop)), field.numbers, *weights)


def path_cost(path: np.ndarray, field: FieldArrays, weights: EdgeWeights) -> float:
    """Return the summed cost of a polyline's edges."""
    return _PATH_COST(for_kernels(path), field.numbers, *weights)
