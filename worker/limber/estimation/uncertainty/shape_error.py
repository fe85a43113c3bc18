"""Uncertainty of Young's modulus from the shape of the scan and the mass of twigs.

Branches that fit the scan as well as the fitted one (:mod:`limber.geometry.shape_samples`) are
pulled as the branch was, with the estimated moduli. To first order, the fit would have attributed
the differences of their points and forces to the moduli; that is the possible error of the moduli.
Errors at neighbouring positions, of axis and radius, and of several moduli are correlated as in the
scan.
"""

from dataclasses import replace

import numpy as np
import scipy

from limber.core.progress import SILENT, Progress
from limber.estimation.estimated_branch import Subject
from limber.estimation.fitting.objective import Evaluation, Objective
from limber.estimation.forward.quasi_static import QuasiStaticForward
from limber.estimation.uncertainty.bending_stiffness import SectionMean
from limber.estimation.uncertainty.path_error import WIDEST
from limber.estimation.uncertainty.shape_sensitivity import compensation, hung_slopes, shape_slopes
from limber.geometry.shape_samples import reshaped, sample_skeletons
from limber.geometry.skeleton.skeleton import Skeleton
from limber.mechanics.added_masses import HungTwig

FEWEST = 8
"""Fewest shapes that show the spread."""
NEARER = 0.03
"""Fraction of the way to another shape at which the pull's response is taken: linear in the radius'
logarithm, as E I is. Over the whole way, radii off by a fifth would seem to change E I by a tenth.
"""


def shape_error(evaluation: Evaluation, objective: Objective, subject: Subject,
                points: np.ndarray, count: int, mean: SectionMean, *, seed: int = 0,
                progress: Progress = SILENT) -> tuple[np.ndarray, np.ndarray] | None:
    """Relative standard deviations of E and of E I at the control points from axis and radii.

    Root mean square over the shapes of the changes that the fit would have made, times Student's
    quantile over the normal one since the shapes are few. A uniformly thicker shape changes E as it
    changes I, so that E I is unchanged.

    Args:
        evaluation: At the end of the fit.
        objective: The minimised objective.
        subject: The branch that was fitted.
        points: Its scan [m], shape [m, 3].
        count: Number of shapes.
        mean: Takes the means that E I is made of.
        seed: Seed of the shapes.
        progress: Called during the work.

    Returns:
        Those of E and of E I, shape [K] each; None if there are too few shapes, or as for
        :func:`compensation`.
    """
    if count < FEWEST:
        return None
    progress(0.0, "evaluating posterior samples of the shape")
    shapes = sample_skeletons(subject.skeleton, points, count, np.random.default_rng(seed))
    meshes = [reshaped(subject.mesh, subject.skeleton, _towards(subject.skeleton, shape))
              for shape in shapes]
    near = compensation(evaluation, objective,
                        lambda forward, values: shape_slopes(forward, values, meshes))
    if near is None:
        return None
    steps = near / NEARER
    thicker = 4 * mean.share @ np.log(np.column_stack(
        [shape.radius / subject.skeleton.radius for shape in shapes]))
    student, normal = scipy.special.stdtrit(count, 0.975), scipy.special.ndtri(0.975)
    of_young, of_bending = (np.minimum(np.sqrt(np.mean(change**2, axis=1)) * student / normal,
                                       WIDEST) for change in (steps, steps + thicker))
    return of_young, of_bending


def _towards(skeleton: Skeleton, shape: Skeleton) -> Skeleton:
    """The skeleton a small way towards another shape of it."""
    return replace(skeleton, nodes=skeleton.nodes + NEARER * (shape.nodes - skeleton.nodes),
                   radius=skeleton.radius * (shape.radius / skeleton.radius)**NEARER)


def hung_error(evaluation: Evaluation, objective: Objective, sigma: float) -> np.ndarray | None:
    """Relative standard deviation of E from the mass of twigs and leaves outside the mesh, [K].

    Args:
        evaluation, objective: As for :func:`shape_error`.
        sigma: Relative standard deviation of that mass, common to all.

    Returns:
        None if nothing hangs on the branch or there is no gravity, or as :func:`compensation`.
    """
    models = [forward.full.model for forward in objective.forwards
              if isinstance(forward.full, QuasiStaticForward)]
    # Stated masses are known; those of twigs and leaves come from their volume.
    if not sigma or not any(
            model.gravity.any() and any(isinstance(one, HungTwig) for one in model.point_masses)
            for model in models):
        return None
    steps = compensation(evaluation, objective, hung_slopes)
    return None if steps is None else np.minimum(sigma * np.abs(steps[:, 0]), WIDEST)
