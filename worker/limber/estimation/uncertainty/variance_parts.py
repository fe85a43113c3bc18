"""Causes of the uncertainty of a modulus, as parts that add up to its variance.

With the information of all measurements and priors in rows J, the covariance is C = (J^T J)^-1, and
C = sum over groups of rows of C J_g^T J_g C: each group's part is the effect of its errors on the
result through the fit. The unknown zero of a force sensor uses up part of the information; that is
included in the part of the measurements that determine it.
"""

from dataclasses import dataclass
from typing import TypedDict

import numpy as np

from limber.estimation.fitting.objective import Evaluation, Objective
from limber.estimation.uncertainty.covariance import inverse_information

ADVICE = {
    "noise of the points": "use more frames, more pulls, or more visible markers",
    "noise of the force": "pull farther, or slower with more readings",
    "noise of the gripper's poses": "use more pulls",
    "gripper frame": "calibrate the gripper's frame against the branch's (hand-eye), and state "
                     "its standard deviation under [calibration] in pull.toml",
    "force gain": "check the sensor with a known weight",
    "zero of the force sensor": "tare the sensor before each pull, and state it under "
                                "[calibration]",
    "camera frame": "register the camera to the branch (fixed markers), or add a second view",
    "places of the points": "mark the points on the branch before the scan, and give their "
                            "positions (--nominal of import-pull)",
    "clock": "record all sensors with one clock",
    "slip of the grasp": "grasp without slip, or put a marker at the grasp",
    "modulus between the control points": "add markers along the branch, or pull at another point",
    "Poisson's ratio": "give it (--poisson, --poisson-sigma); pulls do not determine it",
    "density": "weigh a piece of the branch (--density, --density-sigma)",
    "moduli that the pulls do not determine": "pull at a point farther out",
    "shape of the scan": "scan from more sides, or with less noise",
    "skeleton of the scan": "look at the alternatives (`limber skeleton`), and confirm or edit the "
                            "doubtful parts",
    "mass of twigs and leaves": "weigh the twigs and leaves, and state the uncertainty "
                                "(--hung-sigma); or mesh more twigs (--twig-radius of "
                                "reconstruct)",
    "length in the gripper": "measure it, and state it under [grasp] (radius_m: half of it) and "
                             "[calibration] (held_length_sigma_m) in pull.toml",
    "creep of the branch": "hold the branch at the end of the pull, or pull there and back",
    "mesh": "use a finer mesh (--mesh-spacing of reconstruct)",
    "clamp": "scan farther down, so that the clamped position is known",
}
"""Advice to narrow an interval, by cause."""

_GROUPS = (("camera clock", "clock"), ("camera", "camera frame"), ("gripper", "gripper frame"),
           ("grasp position", "gripper frame"), ("position of point", "places of the points"),
           ("slip", "slip of the grasp"),
           ("force gain", "force gain"), ("force", "zero of the force sensor"),
           ("curvature of the force", "zero of the force sensor"),
           ("torque", "zero of the force sensor"),
           ("creep", "creep of the branch"),
           ("form", "modulus between the control points"),
           ("poisson", "Poisson's ratio"), ("density", "density"))


@dataclass(frozen=True)
class InformationRows:
    """Rows of the information on all unknowns, with one origin.

    Attributes:
        cause: Cause of uncertainty.
        rows: Over the free vector, the errors, and the unknowns of each pull's force.
        name: Unknown of which they are the prior; empty: measurements, or a link.
        pull: Number of the pull that they were measured in; None: a prior, or a link.
    """

    cause: str
    rows: np.ndarray
    name: str = ""
    pull: int | None = None


def variance_parts(evaluation: Evaluation, objective: Objective, scale: float = 1.0,
                   ) -> dict[str, np.ndarray]:
    """Return the part of each cause in the variance of log E at the control points, [K] each.

    Args:
        evaluation: At the end of the fit, with derivatives.
        objective: The minimised objective.
        scale: Variance of the measurements over the stated one.
    """
    rows = information_rows(evaluation, objective, scale)
    covariance = inverse_information(np.vstack([each.rows for each in rows]))
    total = covariance[list(objective.space.groups)]
    parts: dict[str, np.ndarray] = {}
    for each in rows:
        part = np.sum((total @ each.rows.T)**2, axis=1)
        parts[each.cause] = parts.get(each.cause, 0.0) + part
    return parts


class Cause(TypedDict):
    """One cause of the moduli's variance; see :func:`largest`."""

    cause: str
    share: float
    deviation: float
    advice: str


def largest(parts: dict[str, np.ndarray], count: int = 3) -> list[Cause]:
    """Return the causes of most of the variance over all moduli, with a remedy for each.

    Each has ``cause``, ``share`` (its fraction of the variance, mean over the moduli),
    ``deviation`` (largest standard deviation of a log E from it) and ``advice``.
    """
    total = np.sum(list(parts.values()), axis=0)
    share = {cause: float(np.mean(part / np.maximum(total, 1e-300)))
             for cause, part in parts.items()}
    order = sorted(parts, key=lambda cause: -share[cause])[:count]
    return [{"cause": cause, "share": share[cause],
             "deviation": float(np.sqrt(np.max(parts[cause]))), "advice": ADVICE[cause]}
            for cause in order if share[cause] > 0.01]


def cause_of(name: str) -> str:
    """Return the cause to which an unknown of this name belongs."""
    return next(cause for start, cause in _GROUPS if name.startswith(start))


def information_rows(evaluation: Evaluation, objective: Objective, scale: float,
                     ) -> list[InformationRows]:
    """Return rows of all unknowns: free vector, errors, and each pull's course of the force.

    Arguments as for :func:`variance_parts`.
    """
    space, count = objective.space, objective.cell_errors.count
    pieces = objective.raw_slopes(evaluation)
    unknowns = [0 if piece.response is None else piece.response.shape[1] for piece in pieces]
    width = space.size + count + sum(unknowns)
    rows, start = [], space.size + count
    for number, (piece, unknown) in enumerate(zip(pieces, unknowns, strict=True)):
        block = np.zeros((len(piece.free), width))
        block[:, :space.size] = piece.free
        block[:, space.size:space.size + count] = piece.errors
        if unknown:
            block[:, start:start + unknown] = piece.response
        start += unknown
        block /= np.sqrt(scale)
        kinds = np.array(piece.kinds)
        rows += [InformationRows(kind, block[kinds == kind], pull=number)
                 for kind in dict.fromkeys(piece.kinds)]
    for number, nuisance in enumerate(objective.cell_errors.nuisances):
        row = np.zeros((1, width))
        row[0, space.size + number] = 1.0
        rows.append(InformationRows(cause_of(nuisance.name), row, nuisance.name))
    own, _ = space.own_rows()
    names = [name for name, _, _ in space.priors] + [""] * len(space.links)
    for name, row in zip(names, own, strict=True):
        cause = cause_of(name) if name else "moduli that the pulls do not determine"
        rows.append(InformationRows(cause, np.r_[row, np.zeros(width - space.size)][None], name))
    return rows
