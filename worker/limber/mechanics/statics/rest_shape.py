"""The stress-free shape of a branch that was scanned while it sagged (inverse statics).

In the scanned shape x the stress balances the load. The unknown is the stress-free shape X
(Govindjee and Mihalic 1996). At fixed x a change e of X changes the strain alone, not the geometry,
so the derivative of the imbalance has no geometric stiffness. The inverse problem is therefore well
behaved however far the branch sags; a fixed-point iteration on loaded candidates diverges there.
Newton's step solves K_material d = imbalance on x, and d is pulled back to X through its gradient:
grad e = -F^-1 grad d in least squares.
"""

from dataclasses import replace

import numpy as np

from limber.core.errors import ConvergenceError, InputError
from limber.core.numerics.sparse import NotPositiveDefiniteError
from limber.core.progress import SILENT, Progress
from limber.geometry.tets.element_types import between_corners
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.linear.equations import Viscous
from limber.mechanics.model import BranchModel
from limber.mechanics.statics.solve import StaticResult, StaticSettings, solve_static
from limber.mechanics.strain import deformation_gradients, gradient_metric

# Limits are chosen, not measured; in tests/mechanics/statics branches sag beyond 90 % with them.
_MAX_ITERATIONS = 40
"""Most iterations that fit the loaded shape to the scan."""
_MAX_UNLOADING = 100
"""Most Newton steps that remove the load."""
_LARGEST_TURN = 0.15
"""Largest gradient of a Newton step; a larger load is removed in several steps."""
_AWAY = 0.02
"""Distance of a loaded candidate from the scan, as a fraction of the extent, above which stability
is checked.
"""
_BALANCED = 1e-4
"""Largest gradient of a step after which the load removed so far counts as balanced."""


def unloaded_rest_shape(model: BranchModel, *, tolerance: float = 1e-6,
                        start: np.ndarray | None = None,
                        progress: Progress = SILENT) -> TetMesh:
    """Return the unloaded mesh that the model's loads bend into the model's mesh.

    Edges stay straight. Corner nodes match the scan within the tolerance, mid-edge nodes up to the
    curvature within an element (micrometres).

    Args:
        model: Its mesh is the scanned, loaded shape; gravity and added masses are the loads.
        tolerance: Largest distance of a corner node from the scan [m].
        start: Initial rest positions [m], shape [node_count, 3], for example those of another
            Young's modulus.

    Raises:
        ConvergenceError: there is no rest shape; the branch may be too soft to carry its weight.
    """
    search = _Search(model, progress)
    rest = search.unloaded(model.mesh.nodes.copy() if start is None else np.array(start, float))
    return replace(model.mesh, nodes=search.refined(rest, tolerance))


class _Search:
    """Finds the rest positions of one scan."""

    def __init__(self, model: BranchModel, progress: Progress):
        self.model, self.progress = model, progress
        self.scan = model.mesh.nodes
        self.corners = np.unique(model.mesh.tets[:, :4])

    def unloaded(self, rest: np.ndarray) -> np.ndarray:
        """Return rest positions in balance with the scan, applying the load in steps."""
        for number in range(_MAX_UNLOADING):
            self.progress(min(0.7, number / 40), "finding the rest shape", step=number)
            step = self._step(rest, self.scan)
            turn = float(np.abs(_gradients(self.model, step)).max())
            rest = rest + min(1.0, _LARGEST_TURN / max(turn, 1e-30)) * step
            if turn <= _BALANCED:
                return rest
        raise ConvergenceError(
            f"No rest shape was found: the scan is not in equilibrium after {_MAX_UNLOADING} "
            "steps.",
            "The branch is too soft to carry itself in the scanned shape.",
            "Check Young's modulus, density and gravity.")

    def refined(self, rest: np.ndarray, tolerance: float) -> np.ndarray:
        """Return rest positions that the load bends into the scan, solving for the loaded shape."""
        target, misses = self.scan.copy(), []
        settings = StaticSettings()
        for number in range(_MAX_ITERATIONS):
            found = self._loaded(rest, target, settings)
            reached = rest + found.displacement
            miss = reached - self.scan
            misses.append(float(np.linalg.norm(miss[self.corners], axis=1).max()))
            self.progress(min(0.99, 0.7 + 0.03 * number), "finding the rest shape",
                          miss=misses[-1])
            if misses[-1] <= tolerance:
                self.progress(1.0, "finding the rest shape", miss=misses[-1])
                return rest
            if len(misses) > 5 and misses[-1] > 0.95 * misses[-4]:
                break
            # Corners lie on the scan; mid-edge nodes keep the curvature of the loaded shape.
            target = reached - _straight(self.model.mesh, miss)
            rest = rest + self._step(rest, target)
        raise ConvergenceError(
            f"No rest shape was found: the loaded candidate is still {1000 * misses[-1]:.2f} mm "
            "away from the scan.",
            "The branch may be too soft to carry itself in this shape.",
            "Check Young's modulus, density and gravity.")

    def _step(self, rest: np.ndarray, target: np.ndarray) -> np.ndarray:
        """Return Newton's change of the rest positions [m] with straight edges."""
        candidate = self._at(rest)
        u = target - rest
        equations = candidate.equations()
        # The constant part is minus the strain itself: the stress is 0, so there is no geometric
        # stiffness.
        no_stress = Viscous(1.0, -candidate.strains(u))
        try:
            tangent = equations.tangent(candidate, u, viscous=no_stress)
        except NotPositiveDefiniteError as error:
            raise _too_soft("The material stiffness is not positive.") from error
        out = equations.free_part(candidate.weight_force - candidate.internal(u).force)
        moved = tangent.solve(out)
        inverse = np.linalg.inv(deformation_gradients(candidate, u))
        newton_step = -inverse @ _gradients(candidate, moved)
        return _straight(self.model.mesh, _integrated(candidate, newton_step))

    def _loaded(self, rest: np.ndarray, target: np.ndarray,
                settings: StaticSettings) -> StaticResult:
        candidate = self._at(rest)
        found = solve_static(candidate, start=target - rest, settings=settings)
        away = np.linalg.norm(rest + found.displacement - target, axis=1).max()
        if not found.converged or away > _AWAY * self.model.extent:
            self._check_stable(candidate, target - rest)
            found = solve_static(candidate, settings=settings)
        return found.require()

    def _check_stable(self, candidate: BranchModel, displacement: np.ndarray) -> None:
        if not candidate.equations().tangent(candidate, displacement).is_positive_definite:
            raise ConvergenceError(
                "No rest shape was found: the equilibrium in the scanned shape is not stable. The "
                "branch would fall or roll over.",
                "The branch is too soft to stay in the scanned shape.",
                "Check Young's modulus, density and gravity.")

    def _at(self, rest: np.ndarray) -> BranchModel:
        try:
            return self.model.with_rest_nodes(rest)
        except InputError as error:
            raise _too_soft("Elements turn inside out on the path to the rest shape. "
                            f"{error.seen}") from error


def _too_soft(why: str) -> ConvergenceError:
    return ConvergenceError(f"No rest shape was found. {why}",
                            "The branch is too soft to carry itself in the scanned shape.",
                            "Check Young's modulus, density and gravity.")


def _gradients(model: BranchModel, field: np.ndarray) -> np.ndarray:
    """Return the gradient of a nodal field at all quadrature points, shape [tets, q, 3, 3]."""
    return np.swapaxes(np.matmul(model.gradients, field[model.mesh.tets][:, None]), 2, 3)


def _integrated(model: BranchModel, gradient: np.ndarray) -> np.ndarray:
    """Return the field, 0 at fixed nodes, whose gradient fits best in least squares."""
    from scipy.sparse.linalg import splu

    mesh = model.mesh
    right = np.zeros_like(mesh.nodes)
    np.add.at(right, mesh.tets, np.einsum("eq,eqij,eqjn->eni", model.weights, gradient,
                                          model.gradients, optimize=True))
    free = np.flatnonzero(~model.fixed)
    metric = gradient_metric(model).tocsc()[free][:, free]
    field = np.zeros_like(right)
    field[free] = splu(metric, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}
                       ).solve(right[free])
    return field


def _straight(mesh: TetMesh, nodes: np.ndarray) -> np.ndarray:
    """Return a nodal field that is linear between the corners of each tetrahedron."""
    if mesh.element.parents:
        nodes = nodes.copy()
        nodes[mesh.tets[:, 4:]] = between_corners(mesh.element, nodes[mesh.tets[:, :4]])
    return nodes
