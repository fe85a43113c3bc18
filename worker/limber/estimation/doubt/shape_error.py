"""What a scan leaves open of axis and radii, carried to Young's modulus through the pulls.

Branches as likely as the fitted one (:mod:`limber.geometry.likely_shapes`) are pulled as the branch
was, with the moduli found. By how much their points and forces differ, to first order, the fit
would have taken up in the moduli: that is how far off these may be. Errors of neighbouring places,
of axis and radius, and of several moduli go together as they do in the scan.
"""

import numpy as np
from scipy import stats

from limber.estimation.doubt.shape_slopes import shape_slopes
from limber.estimation.objective import Evaluation, Objective
from limber.estimation.preparation import Subject
from limber.geometry.likely_shapes import likely_skeletons, reshaped
from limber.progress import SILENT, Progress

FEWEST = 8
"""Fewer shapes do not tell how far shapes spread."""


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
        progress: Called as it goes.

    Returns:
        None where a pull is dynamic, since that would take too long, where shapes are too few, or
        where a pull finds no equilibrium.
    """
    if count < FEWEST or any(f.entry.motion == "dynamic" for f in objective.forwards):
        return None
    # Differences vary slowly along a pull: few key frames show them.
    forwards = [forward.led_elsewhere(forward.frames.poses) for forward in objective.forwards]
    alone = Objective(forwards, objective.space, force_sigma=objective.force_sigma)
    expected = alone.evaluate(evaluation.free, jacobian=True)
    if expected is None:
        return None
    values = objective.space.unpack(evaluation.free)
    meshes = [reshaped(subject.mesh, subject.skeleton, shape) for shape in likely_skeletons(
        subject.skeleton, points, count, np.random.default_rng(seed))]
    changes = []
    for number, forward in enumerate(forwards):
        progress(number / len(forwards), "other shapes that the scan allows")
        changes.append(shape_slopes(forward, values, meshes))
    steps = np.linalg.lstsq(expected.jacobian, alone.residual_slopes(expected, changes),
                            rcond=1e-9)[0]
    spread = np.sqrt(np.mean(steps[list(objective.space.groups)]**2, axis=1))
    return np.minimum(spread * stats.t.ppf(0.975, count) / stats.norm.ppf(0.975), 35.0)
