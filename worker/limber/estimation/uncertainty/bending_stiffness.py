"""Bending stiffness E I along a branch: what a pull determines even if the radius is uncertain.

If the scan is too thick, the estimate of E is too low, and the model bends as the branch does.
So the interval of E I is narrower than that of E, and predictions on the same mesh depend on E I.

A pull does not determine E I at a position but over a length of the branch: a radius may step at a
fork beside a control point. I is therefore the mean over the part for which the control point
stands, each piece by its share of the strain energy of the pulls: where the branch is not bent,
nothing is determined.
"""

from dataclasses import dataclass

import numpy as np

from limber.estimation.fitting.objective import Objective
from limber.estimation.forward.quasi_static import QuasiStaticForward
from limber.estimation.parameters import Values
from limber.geometry.skeleton.radii.cylinders import on_cylinders
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.materials.layered_section import LayeredSection


@dataclass(frozen=True)
class SectionMean:
    """Computes the mean over a control point's section of the main path.

    Attributes:
        share: Share of each skeleton node in the mean of each control point, [K, node_count].
    """

    share: np.ndarray

    @classmethod
    def of(cls, skeleton: Skeleton, mesh: TetMesh, weights: np.ndarray,
           energy: np.ndarray | None = None) -> "SectionMean":
        """Prepare the mean for a branch.

        Args:
            skeleton: The axes and radii of the mesh.
            mesh: The branch's tetrahedra.
            weights: Weight of each control point in each tetrahedron, shape [tet_count, K].
            energy: Strain energy of each tetrahedron [J], shape [tet_count]; None: each piece of
                the branch counts by its length, as where there is no energy.
        """
        low, high, fraction, _ = on_cylinders(skeleton, mesh.centroids)
        radius = (1 - fraction) * skeleton.radius[low] + fraction * skeleton.radius[high]
        # A twig's own bending does not contribute to that of the branch which carries it.
        weights = weights * np.isin(high, skeleton.main_path())[:, None]
        each = by_length = weights * (np.abs(mesh.volumes) / radius**2)[:, None]
        if energy is not None:
            each = weights * energy[:, None]
            each = np.where(each.sum(axis=0) > 0, each, by_length)
        share = np.array([
            np.bincount(low, (1 - fraction) * own, skeleton.node_count)
            + np.bincount(high, fraction * own, skeleton.node_count) for own in each.T])
        return cls(share / share.sum(axis=1, keepdims=True))

    def log_second_moment(self, radius: np.ndarray, section: LayeredSection | None = None,
                          ) -> np.ndarray:
        """Return the mean log of the second moment of area [log m^4], shape [K].

        Args:
            radius: At the skeleton's nodes [m], shape [node_count].
            section: Its layers; their moment is that of as much wood.
        """
        carrying = 1.0 if section is None else section.bending_factor(radius)
        return self.share @ np.log(np.pi / 4 * radius**4 * carrying)


def strain_energy(objective: Objective, values: Values) -> np.ndarray | None:
    """Strain energy of each tetrahedron, summed over the simulated frames [J], shape [tet_count].

    Args:
        objective: Its pulls were simulated for ``values``.

    Returns:
        None if a pull is dynamic.
    """
    forwards = [forward.full for forward in objective.forwards
                if isinstance(forward.full, QuasiStaticForward)]
    if len(forwards) < len(objective.forwards):
        return None
    energies = [forward.model_with(values).internal(state).tet_energy for forward in forwards
                for state in forward.displacements()]
    return np.sum(energies, axis=0) if energies else None
