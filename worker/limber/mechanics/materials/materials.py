"""Lamé coefficients, valid ranges of material values, damping."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from limber.core.errors import InputError
from limber.geometry.skeleton.radii.fit_kernels import on_cylinders
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.tets.tet_mesh import TetMesh

MAX_POISSON = 0.49999
"""At 0.5 the Lamé coefficients are infinite. A cantilever of quadratic tetrahedra is 3.5 % stiffer
here than at 0.3; linear ones lock long before, fivefold at 0.49.
"""


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


def lame(young: Any, poisson: Any) -> tuple[Any, Any]:
    """Return Lamé's lambda and mu [Pa] of Young's modulus [Pa] and Poisson's ratio."""
    return (young * poisson / ((1 + poisson) * (1 - 2 * poisson)), young / (2 * (1 + poisson)))


def log_bulk_over_shear(poisson: float) -> float:
    """Return log 3 K / 2 G, which is any number: Poisson's ratio is -1 to 0.5. 0: ratio 0."""
    return float(np.log((1 + poisson) / (1 - 2 * poisson)))


def poisson_of(log_bulk_over_shear: float) -> float:
    """Return Poisson's ratio of log 3 K / 2 G."""
    ratio = np.exp(log_bulk_over_shear)
    return float((ratio - 1) / (1 + 2 * ratio))


def lame_by_bulk(young: np.ndarray, poisson: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives of lambda and mu [Pa] to log 3 K / 2 G, for the same modulus."""
    by_lambda = (1 + 2 * poisson**2) / (3 * (1 + poisson) * (1 - 2 * poisson))
    return young * by_lambda, -young * (1 - 2 * poisson) / (6 * (1 + poisson))


def per_tet(name: str, value: float | np.ndarray, tet_count: int) -> np.ndarray:
    """Return ``value`` for each tetrahedron, shape [tet_count]. InputError if it is neither one
    number nor one per tetrahedron, or not finite."""
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
                         "incompressible.",
                         "Wood has 0.3 to 0.45.")


# Species presets: stiffness, strength, density and allowable strain of green wood.
#
# Wood Handbook, FPL-GTR-190 (Forest Products Laboratory, 2010): clear, straight-grained green stem
# wood in bending. Branches are often softer.

SOURCE = ("Wood Handbook 2010, tables 5-3a and 4-1: green stem wood. Branches are often softer, "
          "so estimate Young's modulus")

STRENGTH_OVER_YOUNG = 0.006
"""Modulus of rupture over Young's modulus of green wood if no strength is known. Table 5-3 has
0.0049 (Douglas fir) to 0.0067 (white ash), 0.006 in the middle.
"""

LEAST_YOUNG = 4.4e9
"""Least Young's modulus [Pa] of green wood in table 5-3a (northern white cedar). Nothing is assumed
of the strength of softer stems: that ratio has no source for them.
"""

SAFETY = 2.0
"""Rupture strain over allowable strain of a species: a branch has knots, forks and younger wood."""


@dataclass(frozen=True)
class Species:
    """The properties of a species.

    Attributes:
        title: Its name in the handbook.
        young, strength: Young's modulus and modulus of rupture [Pa], table 5-3a; for cherry and red
            maple table 5-3b, converted from psi.
        density: Density of green wood [kg/m^3], from the specific gravity of table 5-3a and the
            moisture of table 4-1, heartwood and sapwood in equal parts; None if the latter has
            none.
        rupture_strain: Modulus of rupture over Young's modulus in table 5-3b, which has more
            digits; None if no limit is offered. It would be the strain at rupture if wood stayed
            linear. Wood yields earlier and bears more strain, so the ratio is on the safe side.
    """

    title: str
    young: float
    strength: float
    density: float | None = None
    rupture_strain: float | None = None


SPECIES = {
    "ash": Species("Ash, white", 9.9e9, 66e6, 798.0, 9500 / 1.44e6),
    "beech": Species("Beech, American", 9.5e9, 59e6, 916.0),
    "birch": Species("Birch, yellow", 10.3e9, 57e6, 952.0),
    "cherry": Species("Cherry, black", 9.0e9, 55e6, None, 8000 / 1.31e6),
    "maple": Species("Maple, red", 9.6e9, 53e6, None, 7700 / 1.39e6),
    "sugar_maple": Species("Maple, sugar", 10.7e9, 65e6, 944.0),
    "oak": Species("Oak, northern red", 9.3e9, 57e6, 977.0, 8300 / 1.35e6),
    "tulip": Species("Yellow-poplar", 8.4e9, 41e6, 778.0),
    "walnut": Species("Walnut, black", 9.8e9, 66e6, 926.0, 9500 / 1.42e6),
}


def strain_limit(name: str) -> float:
    """Return the largest allowable principal strain for a branch of a species. KeyError if no limit
    is known for this species."""
    strain = SPECIES[name].rupture_strain
    if strain is None:
        raise KeyError(name)
    return strain / SAFETY


def strength_of(young: np.ndarray, strength: float | None = None) -> np.ndarray:
    """Return the stress [Pa] that breaks wood of these moduli [Pa]: ``strength``, or assumed."""
    young = np.asarray(young, float)
    return STRENGTH_OVER_YOUNG * young if strength is None else np.full(young.shape, strength)


# Hollow or layered cross-sections: pith, wood and bark of a branch that is meshed as one solid.
#
# The mesh has one modulus over a cross-section. It gets the equivalent modulus that bends as the
# layers do: pith does not carry, bark has its own ratio to the wood. This holds for bending and,
# with one Poisson's ratio, for twisting. Stretched along its axis, a hollow section is stiffer than
# this modulus gives: 1 - k^2 instead of 1 - k^4 for a pith of k times the radius. Branches are
# bent, so that is not corrected. The density is that of the whole section.

LEAST_WOOD = 0.02
"""Thickness of the wood over the radius below which the layers do not fit into the branch."""


@dataclass(frozen=True)
class LayeredSection:
    """Layers of one thickness all along a branch: a pith or hollow that carries nothing [m], and
    bark [m] whose modulus is relative to the wood's."""

    pith_radius: float = 0.0
    bark_thickness: float = 0.0
    bark_modulus: float = 0.0

    def bending_factor(self, radius: np.ndarray) -> np.ndarray:
        """Return the equivalent modulus of solid sections of outer radius [m] over the wood's.
        InputError if the layers do not fit into the thinnest."""
        wood = radius - self.bark_thickness
        thinnest = float(radius.min())
        if np.any(wood - self.pith_radius < LEAST_WOOD * radius):
            raise InputError(
                f"The branch has a radius of {1e3 * thinnest:.2g} mm at its thinnest section. Pith "
                f"and bark take {1e3 * (self.pith_radius + self.bark_thickness):.2g} mm of it.",
                "No wood is left there.", "State a thinner pith or bark.")
        return ((wood / radius)**4 - (self.pith_radius / radius)**4
                + self.bark_modulus * (1 - (wood / radius)**4))

    def on(self, mesh: TetMesh, skeleton: Skeleton) -> np.ndarray:
        """Return the factor of each tetrahedron, shape [tet_count]; errors as above."""
        low, high, share, _ = on_cylinders(skeleton, mesh.centroids)
        return self.bending_factor((1 - share) * skeleton.radius[low]
                                   + share * skeleton.radius[high])


# Interpolation of Young's modulus from a few control points to all tetrahedra.


def young_weights(mesh: TetMesh, control_points: np.ndarray, power: float = 2) -> np.ndarray:
    """Return W so that Young's modulus of the tetrahedra is ``W @ young_at_control_points``.

    Inverse-distance weighting (Shepard) from control points to centroids, as in the paper. It is
    linear in Young's modulus; rows sum to 1.

    Args:
        control_points: Positions [m], shape [K, 3].
        power: Exponent of the distance.

    Returns:
        Shape [tet_count, K].

    Raises:
        InputError: there is no control point, or one is not finite.
    """
    points = np.asarray(control_points, float)
    if points.ndim != 2 or points.shape[1] != 3 or not len(points) or not np.isfinite(points).all():
        raise InputError(f"The control points have shape {points.shape}.",
                         "At least one finite position is needed.", "Give an array [K, 3].")
    distance = np.linalg.norm(mesh.centroids[:, None] - points[None], axis=2)
    # Relative to the nearest, so that no power overflows; a centroid on a control point has that
    # point's weight 1.
    nearest = np.maximum(distance.min(axis=1, keepdims=True), np.finfo(float).tiny)
    weights = (nearest / np.maximum(distance, nearest)) ** power
    return weights / weights.sum(axis=1, keepdims=True)
