"""The stress-free shape of a branch that was scanned while it sagged (inverse statics)."""

from dataclasses import replace

import numpy as np

from limber.errors import ConvergenceError, InputError
from limber.geometry.tet_mesh import EDGES, TetMesh
from limber.mechanics.model import BranchModel
from limber.mechanics.statics import StaticSettings, solve_static
from limber.mechanics.strain import deformation_gradients
from limber.progress import SILENT, Progress

_MAX_ITERATIONS = 40


def unloaded_rest_shape(model: BranchModel, *, tolerance: float = 1e-6,
                        start: np.ndarray | None = None,
                        progress: Progress = SILENT) -> TetMesh:
    """Return the mesh without load, such that the model's loads bend it to the model's mesh.

    Fixed-point iteration on the corner nodes: where the loaded candidate misses the scan, the
    miss is turned back by the local rotation and taken off the candidate. Sides stay straight,
    so middle nodes meet the scan but for the curvature within an element (micrometres).

    Args:
        model: Its mesh is the scanned, loaded shape; gravity and added masses are the loads.
        tolerance: Largest miss of a corner node [m].
        start: Rest positions to begin with [m], shape [node_count, 3]: those found with another
            Young's modulus, for example.

    Raises:
        ConvergenceError: no rest shape; the branch may be too soft to carry itself.
    """
    scan = model.mesh.nodes
    corners = np.unique(model.mesh.tets[:, :4])
    rest = scan.copy() if start is None else np.array(start, float)
    settings = StaticSettings()
    displacement, misses = None, []
    for number in range(_MAX_ITERATIONS):
        progress(number / _MAX_ITERATIONS, "seeking the rest shape",
                 miss=misses[-1] if misses else 0.0)
        try:
            candidate = model.with_rest_nodes(rest)
        except InputError as error:
            raise ConvergenceError(
                f"No rest shape: on the way to it elements turn inside out. {error.seen}",
                "The branch is too soft to carry itself in the scanned shape.",
                "Check Young's modulus, density and gravity.") from error
        guess = None if displacement is None else scan - rest
        found = solve_static(candidate, start=guess, settings=settings)
        if not found.converged and guess is not None:
            found = solve_static(candidate, settings=settings)
        displacement = found.require().displacement
        miss = rest + displacement - scan
        misses.append(float(np.linalg.norm(miss[corners], axis=1).max()))
        if misses[-1] <= tolerance:
            progress(1.0, "seeking the rest shape", miss=misses[-1])
            return replace(model.mesh, nodes=rest)
        if len(misses) > 5 and misses[-1] > 0.95 * misses[-4]:
            break
        turn = node_rotations(candidate, displacement)
        rest = rest - np.einsum("nji,nj->ni", turn, miss)
        rest[model.fixed] = scan[model.fixed]
        rest = _straight(model.mesh, rest)
    raise ConvergenceError(
        f"No rest shape: the loaded candidate still misses the scan by {1000 * misses[-1]:.2f} mm.",
        "The branch may be too soft to carry itself in this shape.",
        "Check Young's modulus, density and gravity.")


def node_rotations(model: BranchModel, displacement: np.ndarray) -> np.ndarray:
    """Return the rotation of the material at each node, shape [node_count, 3, 3]."""
    mean = deformation_gradients(model, displacement).mean(axis=1)
    summed = np.zeros((model.mesh.node_count, 3, 3))
    np.add.at(summed, model.mesh.tets, mean[:, None])
    left, _, right = np.linalg.svd(summed)
    return left @ right


def _straight(mesh: TetMesh, nodes: np.ndarray) -> np.ndarray:
    if mesh.is_quadratic:
        nodes = nodes.copy()
        nodes[mesh.tets[:, 4:]] = nodes[mesh.tets[:, EDGES]].mean(axis=2)
    return nodes
