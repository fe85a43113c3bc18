"""Species presets: stiffness, strength, density and allowable strain of green wood.

Wood Handbook, FPL-GTR-190 (Forest Products Laboratory, 2010): clear, straight-grained green stem
wood in bending. Branches are often softer.
"""

from dataclasses import dataclass

import numpy as np

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
    """Return the largest allowable principal strain for a branch of a species.

    Raises:
        KeyError: no limit is known for this species.
    """
    strain = SPECIES[name].rupture_strain
    if strain is None:
        raise KeyError(name)
    return strain / SAFETY


def strength_of(young: np.ndarray, strength: float | None = None) -> np.ndarray:
    """Return the stress [Pa] that breaks wood of these moduli [Pa]: ``strength``, or assumed."""
    young = np.asarray(young, float)
    return STRENGTH_OVER_YOUNG * young if strength is None else np.full(young.shape, strength)
