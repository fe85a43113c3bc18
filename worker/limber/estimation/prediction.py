"""Equilibrium of a branch with estimated moduli under another load."""

from dataclasses import replace
from typing import Any

import numpy as np

from limber.core.errors import InputError, Option, WorkError
from limber.core.not_none import present
from limber.core.progress import SILENT, Progress
from limber.estimation.estimated_branch import Subject
from limber.estimation.forward.solved_pull import QuasiStaticForward
from limber.estimation.parameters import BULK, ParameterSpace, Values
from limber.estimation.settings import PredictSettings
from limber.recordings.recording import PullEntry
from limber.recordings.synchronisation import Frames


def require_one_load(settings: PredictSettings) -> None:
    """Require exactly one load. InputError if there is no load, or there are two."""
    if (settings.weight is None) == (settings.load is None):
        raise InputError("A prediction needs exactly one load.",
                         "The prediction differs from the recording by this load.",
                         "Give ", Option("weight"), " NEWTONS or ", Option("load"), " X Y Z.")


def predict_rest(known: dict[str, Any], subject: Subject, entry: PullEntry, down: np.ndarray,
                 settings: PredictSettings, progress: Progress = SILENT) -> dict[str, Any]:
    """Simulate the branch at rest under a load other than the recorded one.

    Args:
        known: Content of ``estimate.json``.
        subject: The branch that was estimated.
        entry: The pull that supplies the points and the grasp.
        down: Direction of gravity, unit vector [3].

    Returns:
        ``load_n`` [3], ``points_m`` and ``displacement_m`` [m][3] of the pull's points,
        ``displacement_sigma_m`` [m] (of its magnitude, from Young's modulus' covariance),
        ``drops_m`` [m] (along gravity), ``drop_m`` (their mean over the points that move at least
        half as far as the farthest) with ``drop_interval_m`` (95 %), ``grasp_displacement_m`` [3],
        ``young_pa``.

    Raises:
        WorkError: no equilibrium of the branch was found under the load.
    """
    load = np.array(settings.load) if settings.load else settings.weight * down
    forward, values = _forward(known, subject, entry, load)
    progress(0.1, "finding the equilibrium under the load")
    space = _space(known, values)
    found = forward.simulate(values, space.extra, True)
    if found is None:
        raise WorkError(f"The branch has no equilibrium under {np.linalg.norm(load):.3g} N.",
                        "The load may be far more than the branch can carry.",
                        "Check the unit of the load.")
    moved = found.positions[0] - forward.rest_points
    slopes = present(found.slopes, "derivative of the rest").positions[0]
    drop, sigma, drop_sigma = _uncertain(moved, slopes, down, space, known)
    grasp = forward.grasp
    held = grasp.weights @ forward.displacements()[0][grasp.nodes]
    return {
        "load_n": load, "points_m": forward.rest_points, "displacement_m": moved,
        "displacement_sigma_m": sigma, "drops_m": moved @ down, "drop_m": drop,
        "drop_interval_m": [drop - 1.96 * drop_sigma, drop + 1.96 * drop_sigma],
        "grasp_displacement_m": held, "young_pa": values.young}


def _forward(known: dict[str, Any], subject: Subject, entry: PullEntry, load: np.ndarray,
             ) -> tuple[QuasiStaticForward, Values]:
    # The modulus for which this mesh bends as the branch does.
    values = Values(np.array(known.get("young_mesh_pa", known["young_pa"])),
                    float(known["poisson"]), float(known.get("density", subject.start.density)),
                    form=tuple(known.get("field_form", ())))
    points = np.array(subject.control_points if entry.rest_points_m is None
                      else entry.rest_points_m)
    wrenches = np.full((2, 6), np.nan)
    wrenches[:, :3] = load
    frames = Frames(np.array([0.0, 1.0]), np.zeros((2, 6)), wrenches, np.ones(2, int),
                    np.broadcast_to(points, (2, *points.shape)),
                    np.broadcast_to(np.eye(3), (2, len(points), 3, 3)))
    driven = entry.model_copy(update={"drive": "force", "motion": "quasi_static"})
    if entry.grasp.mode == "rigid":
        # A force alone does not determine a hand's rotation.
        driven = driven.model_copy(update={
            "grasp": entry.grasp.model_copy(update={"mode": "point"})})
    return QuasiStaticForward("prediction", subject.model, subject.weights, driven, frames,
                              points, key_count=1, field=subject.field), values


def _space(known: dict[str, Any], values: Values) -> ParameterSpace:
    """The parameters of the estimate's covariance."""
    groups = tuple(known.get("groups") or range(len(values.young)))
    extra = tuple(name for name in known.get("parameters", ())
                  if name.startswith("form") or name in (BULK, "density"))
    return ParameterSpace(replace(values), groups, extra)


def _uncertain(moved: np.ndarray, slope: np.ndarray, down: np.ndarray, space: ParameterSpace,
               known: dict[str, Any]) -> tuple[float, np.ndarray, float]:
    """Return the mean drop, deviations of each point's displacement, and that of the drop [m], from
    the data's part alone: errors of radius and mesh cancel in modulus and prediction. Stiffness
    varies as between recordings."""
    count = len(space.groups)
    free = np.concatenate([slope[..., :count] @ space.membership, slope[..., count:]], axis=-1)
    group_count = space.group_count
    used = [*range(group_count), *(known["parameters"].index(name) for name in space.extra)]
    covariance = np.array(known["covariance"])[np.ix_(used, used)]
    covariance[:group_count, :group_count] += float(known.get("recording_spread", 0.0))**2
    each = np.einsum("mip,pq,miq->mi", free, covariance, free)
    size = np.linalg.norm(moved, axis=1)
    along = moved / np.maximum(size, 1e-12)[:, None]
    sigma = np.sqrt(np.maximum(np.einsum("mi,mi->m", along**2, each), 0.0))
    far = size >= 0.5 * size.max()
    mean = np.einsum("mip,i->p", free[far], down) / far.sum()
    return (float(np.mean(moved[far] @ down)), sigma,
            float(np.sqrt(max(mean @ covariance @ mean, 0.0))))
