"""Lamé coefficients, valid ranges of material values, damping."""

from dataclasses import dataclass
from typing import overload

import numpy as np

from limber.core.errors import InputError

MAX_POISSON = 0.495
"""Above this, the tetrahedra lock; at 0.5, the Lamé coefficients are infinite."""


@dataclass(frozen=True)
class RayleighDamping:
    """Damping: ``mass`` [1/s] times the mass matrix, ``stiffness`` [s] times the stiffness.

    The stiffness part acts on the rate of the Green-Lagrange strain (Kelvin-Voigt), so that it does
    not damp a rotating branch; at small strain it is the usual Rayleigh term.
    """

    mass: float = 0.5
    stiffness: float = 0.002

    def __post_init__(self) -> None:
        if not (self.mass >= 0 and self.stiffness >= 0):
            raise InputError(f"The damping {self.mass}, {self.stiffness} is negative.",
                             "Negative damping would add energy to the motion.", "Use 0 or more.")


@overload
def lame(young: float, poisson: float) -> tuple[float, float]: ...
@overload
def lame(young: np.ndarray, poisson: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]: ...
@overload
def lame(young: float, poisson: np.ndarray) -> tuple[np.ndarray, np.ndarray]: ...
def lame(young: float | np.ndarray, poisson: float | np.ndarray,
         ) -> tuple[float | np.ndarray, float | np.ndarray]:
    """Return Lamé's lambda and mu [Pa] of Young's modulus [Pa] and Poisson's ratio."""
    return (young * poisson / ((1 + poisson) * (1 - 2 * poisson)), young / (2 * (1 + poisson)))


def lame_by_poisson(young: np.ndarray, poisson: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives of lambda and mu [Pa] to Poisson's ratio."""
    by_lambda = (1 + 2 * poisson**2) / ((1 + poisson) * (1 - 2 * poisson)) ** 2
    return young * by_lambda, -young / (2 * (1 + poisson) ** 2)


def per_tet(name: str, value: float | np.ndarray, tet_count: int) -> np.ndarray:
    """Return ``value`` for each tetrahedron, shape [tet_count].

    Raises:
        InputError: neither one number nor one per tetrahedron, or not finite.
    """
    array = np.asarray(value, float)
    if array.ndim > 1 or (array.ndim == 1 and len(array) != tet_count):
        raise InputError(f"{name} has shape {array.shape}; the mesh has {tet_count} tetrahedra.",
                         "Limber needs one number, or one for each tetrahedron.",
                         "Map control points to tetrahedra with young_weights.")
    if not np.isfinite(array).all():
        raise InputError(f"{name} is not finite everywhere.", "A value is missing.", "Give it.")
    return np.ascontiguousarray(np.broadcast_to(array, (tet_count,)))


def check_young(young: np.ndarray) -> None:
    """Raise InputError unless Young's modulus [Pa] is positive."""
    if young.min() <= 0:
        raise InputError(f"Young's modulus is {young.min():g} Pa in tetrahedron {young.argmin()}.",
                         "A modulus must be positive.", "Green wood has 1e8 to 1e10 Pa.")


def check_density(density: np.ndarray) -> None:
    """Raise InputError unless the density [kg/m^3] is positive."""
    if density.min() <= 0:
        raise InputError(f"The density is {density.min():g} kg/m3.", "It must be positive.",
                         "Green wood has 500 to 1100 kg/m3.")


def check_poisson(poisson: np.ndarray) -> None:
    """Raise InputError unless Poisson's ratio is in (-1, MAX_POISSON]."""
    worst = poisson[np.argmax(np.abs(poisson))]
    if poisson.min() <= -1 or poisson.max() > MAX_POISSON:
        raise InputError(f"Poisson's ratio is {worst:g}.",
                         f"It must be above -1 and at most {MAX_POISSON}: at 0.5 the material is "
                         "incompressible and these elements lock.",
                         "Wood has 0.3 to 0.45.")
