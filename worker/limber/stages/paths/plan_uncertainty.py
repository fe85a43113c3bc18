"""Uncertainty of Young's modulus as used in a plan."""

import numpy as np

from limber.core.errors import Command, InputError, Option, Text
from limber.mechanics.materials.materials import young_weights
from limber.planning.constraints.chance import YoungUncertainty
from limber.planning.constraints.limits import Limits
from limber.planning.field.grasp_model import GraspModel
from limber.store import Branch

_INTERVAL = 2 * 1.96  # standard deviations in a 95 % interval


def young_uncertainty(branch: Branch, grasp_model: GraspModel, limits: Limits) -> YoungUncertainty:
    """Return the moduli's distribution from the branch's estimate, for a plan with limits;
    InputError without limit or estimate, or for one without intervals."""
    if not limits.asked():
        raise InputError(Text(Option("confidence"), " was given without a limit."), "It is the "
                         "probability that the limits hold.", "Give ", Option("max_force"), ", ",
                         Option("max_strain"), " or another limit as well.")
    uncertainty = estimated_uncertainty(branch, grasp_model)
    if uncertainty is None:
        raise InputError(Text(Option("confidence"), " was given, but there is no estimate."),
                         Text("The uncertainty of Young's modulus comes from ", Command("estimate"),
                              "."),
                         "Import a pull and estimate, or omit ", Option("confidence"), ".")
    return uncertainty


def estimated_uncertainty(branch: Branch, grasp_model: GraspModel) -> YoungUncertainty | None:
    """Return the moduli's distribution from the branch's estimate, if any: deviations of the
    intervals of bending stiffness, as a plan uses the estimate's mesh, whose error of radius
    cancels with the modulus's, and the fit's correlations. Control points of one group share a
    modulus. InputError without interval."""
    from limber.estimation.estimate_file import read_estimate

    if not branch.has("estimate.json"):
        return None
    found = read_estimate(branch.require("estimate.json", "estimate"))
    interval = np.array(found.get("bending_stiffness_interval_nm2") or found["young_interval_pa"],
                        float)
    if not (np.isfinite(interval).all() and (interval > 0.0).all()):
        raise InputError("The estimate has no interval for some control points.",
                         "The uncertainty of Young's modulus is unknown there.",
                         "Record another pull and estimate again.")
    points = np.array(found["control_points_m"], float)
    covariance = np.array(found["covariance"], float)[np.ix_(found["groups"], found["groups"])]
    size = np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny))
    correlation = np.clip(covariance / np.outer(size, size), -1.0, 1.0)
    weights = young_weights(grasp_model.mesh, points) * np.array(
        found.get("young_mesh_pa") or found["young_pa"], float)
    return YoungUncertainty(weights / weights.sum(axis=1, keepdims=True),
                            np.log(interval[:, 1] / interval[:, 0]) / _INTERVAL, correlation)
