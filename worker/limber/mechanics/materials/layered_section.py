"""Hollow or layered cross-sections: pith, wood and bark of a branch that is meshed as one solid.

The mesh has one modulus over a cross-section. It gets the equivalent modulus that bends as the
layers do: pith does not carry, bark has its own ratio to the wood. This holds for bending and, with
one Poisson's ratio, for twisting. Stretched along its axis, a hollow section is stiffer than this
modulus gives: 1 - k^2 instead of 1 - k^4 for a pith of k times the radius. Branches are bent, so
that is not corrected. The density is that of the whole section.
"""

from dataclasses import dataclass

import numpy as np

from limber.core.errors import InputError
from limber.geometry.skeleton.radii.cylinders import on_cylinders
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.tets.tet_mesh import TetMesh

LEAST_WOOD = 0.02
"""Thickness of the wood over the radius below which the layers do not fit into the branch."""


@dataclass(frozen=True)
class LayeredSection:
    """Layers of the same thickness all along a branch.

    Attributes:
        pith_radius: Radius of the hollow, or of the pith, which carries nothing [m].
        bark_thickness: [m].
        bark_modulus: Young's modulus of the bark over that of the wood.
    """

    pith_radius: float = 0.0
    bark_thickness: float = 0.0
    bark_modulus: float = 0.0

    def bending_factor(self, radius: np.ndarray) -> np.ndarray:
        """Return the equivalent modulus of solid sections over that of the wood.

        Args:
            radius: Outer radius [m], any shape.

        Raises:
            InputError: the layers do not fit into the thinnest section.
        """
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
