"""What a scan leaves open of axis and radii, carried to Young's modulus through the pulls.

Branches as likely as the fitted one (:mod:`limber.geometry.likely_shapes`) are pulled
as the branch was, with the moduli found. By how much their points and forces differ, the fit
would have taken up in the moduli: that is how far off these may be. Errors of neighbouring
places, of axis and radius, and of several moduli go together as they do in the scan.
"""

import numpy as np
from scipy import stats

from limber.errors import WorkError
from limber.estimation.forward.forward import Forward
from limber.estimation.forward.quasi_static import FEW_KEYS, QuasiStaticForward
from limber.estimation.objective import Evaluation, Objective
from limber.estimation.preparation import Subject
from limber.geometry.likely_shapes import likely_skeletons, reshaped
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.model import BranchModel
from limber.progress import SILENT, Progress

FEWEST = 8
"""Shapes that must find an equilibrium for their spread to say anything."""


def shape_error(evaluation: Evaluation, objective: Objective, subject: Subject,
                points: np.ndarray, count: int, *, seed: int = 0,
                progress: Progress = SILENT) -> np.ndarray | None:
    """Relative standard deviation of E at the control points from axis and radii, shape [K].

    Linear in the change of the residuals r: d log E = -(J^T J)^-1 J^T dr. Root mean square over
    the shapes, times Student's quantile over the normal one since they are few.

    Args:
        evaluation: At the fit's end.
        objective: What was minimised.
        subject: The branch that was fitted.
        points: Its scan [m], shape [m, 3].
        count: How many shapes.
        seed: Of the shapes.
        progress: Called for each.

    Returns:
        None where a pull is dynamic, since that would take too long, or where too few shapes
        find an equilibrium.
    """
    if count < FEWEST or any(f.entry.motion == "dynamic" for f in objective.forwards):
        return None
    # With its own derivatives: of these few key frames, as the changes are.
    base = _pulled(evaluation, objective, subject, subject.mesh, None, jacobian=True)
    if base is None:
        return None
    expected, hints = base
    changes = []
    shapes = likely_skeletons(subject.skeleton, points, count, np.random.default_rng(seed))
    for number, shape in enumerate(shapes):
        progress(number / count, "other shapes that the scan allows")
        mesh = reshaped(subject.mesh, subject.skeleton, shape)
        found = None if mesh.volumes.min() <= 0 else _pulled(
            evaluation, objective, subject, mesh, hints)
        if found is not None:
            changes.append(found[0].residual - expected.residual)
    if len(changes) < FEWEST:
        return None
    steps = np.linalg.lstsq(expected.jacobian, np.array(changes).T, rcond=1e-9)[0]
    groups = list(objective.space.groups)
    spread = np.sqrt(np.mean(steps[groups]**2, axis=1))
    return np.minimum(spread * stats.t.ppf(0.975, len(changes)) / stats.norm.ppf(0.975), 35.0)


def _pulled(evaluation: Evaluation, objective: Objective, subject: Subject, mesh: TetMesh,
            hints: list[list[np.ndarray]] | None, *, jacobian: bool = False,
            ) -> tuple[Evaluation, list[list[np.ndarray]]] | None:
    """All pulls on a mesh, and the states of their key frames; None: no equilibrium."""
    start = subject.model
    model = BranchModel(mesh, young=start.young, poisson=start.poisson, density=start.density,
                        gravity=start.gravity, point_masses=start.point_masses)
    model = model if start.hanging is None else model.as_scanned()
    forwards = [_forward(forward, model) for forward in objective.forwards]
    for forward, hint in zip(forwards, hints or [], strict=False):
        forward.hint(hint)
    alone = Objective(forwards, objective.space, force_sigma=objective.force_sigma)
    # Forces with errors of their own are eliminated from residuals by their derivatives, which a
    # watched path brings by itself.
    linearised = any(forward.has_force_unknowns and not forward.watches_pose
                     for forward in forwards)
    try:
        found = alone.evaluate(evaluation.free, jacobian=jacobian or linearised)
    except WorkError:
        return None
    if found is None:
        return None
    return found, [forward.displacements() for forward in forwards]


def _forward(forward: Forward, model: BranchModel) -> QuasiStaticForward:
    """The same pull of another shape; its material stays what it is in each tetrahedron."""
    fitted = forward.full
    made = type(fitted)(fitted.name, model, fitted.weights, fitted.entry, fitted.frames,
                        fitted.rest_points, key_count=FEW_KEYS, field=fitted.field)
    made.begin_at(fitted)
    return made
