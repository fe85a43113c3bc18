"""Bending stiffness E I along a branch: what a pull determines even if the radius is uncertain.

If the scan is too thick, the estimate of E is too low, and the model bends as the branch does.
So the interval of E I is narrower than that of E, and predictions on the same mesh depend on E I.
"""

from dataclasses import dataclass

import numpy as np

from limber.geometry.skeleton.radii.cylinders import on_cylinders
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.materials.layered_section import LayeredSection


@dataclass(frozen=True)
class SectionMean:
    """Computes the mean over a control point's section of the main path, by length.

    Attributes:
        low, high: Lower and upper node of the cylinder around each tetrahedron, shape [tet_count].
        fraction: Position of the tetrahedron between the two, shape [tet_count].
        weights: Weight of each tetrahedron in the mean of each control point, shape [K, tet_count].
    """

    low: np.ndarray
    high: np.ndarray
    fraction: np.ndarray
    weights: np.ndarray

    @classmethod
    def of(cls, skeleton: Skeleton, mesh: TetMesh, weights: np.ndarray) -> "SectionMean":
        """Prepare the mean for a branch.

        Args:
            skeleton: The axes and radii of the mesh.
            mesh: The branch's tetrahedra.
            weights: Weight of each control point in each tetrahedron, shape [tet_count, K].
        """
        low, high, fraction, _ = on_cylinders(skeleton, mesh.centroids)
        # A twig's own bending does not contribute to that of the branch which carries it.
        weights = weights * np.isin(high, skeleton.main_path())[:, None]
        radius = (1 - fraction) * skeleton.radius[low] + fraction * skeleton.radius[high]
        # Volume over cross-section: each piece of the branch counts by its length.
        share = (weights * (np.abs(mesh.volumes) / radius**2)[:, None]).T
        return cls(low, high, fraction, share / share.sum(axis=1, keepdims=True))

    def log_second_moment(self, radius: np.ndarray, section: LayeredSection | None = None,
                          ) -> np.ndarray:
        """Return the mean log of the second moment of area [log m^4], shape [K].

        Args:
            radius: At the skeleton's nodes [m], shape [node_count].
            section: Its layers; their moment is that of as much wood.
        """
        between = (1 - self.fraction) * radius[self.low] + self.fraction * radius[self.high]
        carrying = 1.0 if section is None else section.bending_factor(between)
        return self.weights @ np.log(np.pi / 4 * between**4 * carrying)
