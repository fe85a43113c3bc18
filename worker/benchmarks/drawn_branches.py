"""Branches with a newly drawn truth, what a real cell would record of them, and their estimates.

The truth uses a finer mesh than the fit. Its Young's modulus varies between the control points
differently than the fit assumes; its Poisson's ratio and density are not those given to the fit.
The cell has a sensor with gain, zero and drift, and gripper and camera are slightly off.

The Cramer-Rao bound is that of the trial's own problem: the Fisher information of all measurements,
taken at the truth, in all unknowns (moduli, form of their field, Poisson's ratio, density, every
error of the cell, the course of the force), with the prior knowledge of each.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator
from scipy.spatial import cKDTree

from benchmarks.paper_branches import PaperBranch
from limber.core.json_values import plain
from limber.estimation.estimate_file import details, summary
from limber.estimation.estimated_branch import Subject
from limber.estimation.fit import fit_branch
from limber.estimation.fit_assessment import Estimate, judge_model, require_result
from limber.estimation.fitting.objective import EvaluationLog, Objective, inverse_information
from limber.estimation.forward.observed_path import MotionWanted, moved, seen_at
from limber.estimation.next_pull import Cell, Known, PullChoice, suggest
from limber.estimation.parameters import Values, open_field
from limber.estimation.settings import FitSpec
from limber.estimation.simulated_pull import CellErrors, marked_points
from limber.estimation.uncertainty.model_error import total_interval
from limber.geometry.skeleton.skeleton import control_points
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.materials.materials import young_weights
from limber.mechanics.model import BranchModel
from limber.recordings.recording import (
    CalibrationEntry,
    GraspEntry,
    Observations,
    Pull,
    PullEntry,
    SensorEntry,
    grasp_on,
)
from limber.stages.pulls.suggest_pull import CANDIDATES

FRACTIONS = (0.2, 0.4, 0.6, 0.8)
GRAVITY = (0.0, 0.0, -9.80665)
FORMS = ("straight", "monotone", "wavy")
STATES, FRAMES = 16, 100
"""Solutions along a pull of the truth, and its recorded frames (a spline through the former)."""
LEVELS_OFF = 0.1
"""Fraction of the length over which a monotone modulus continues beyond outer control points."""
POSITION_NOISE_M, FORCE_NOISE = 1e-3, 0.02
POISSON, DENSITY = 0.35, 900.0
"""Inputs given to the fit."""
SETTINGS = FitSpec(hold_out=False)
FIRST_PULL, FIRST_TURN = PullChoice(0.92, 0.0, 0.4), 2.0
"""At the obvious position, near the tip; further pulls where `limber suggest-pull` suggests."""
_MOST_STRAIN = 0.02
"""Largest strain of suggested pulls: the first strains the branches by 1.4 to 1.9 %."""
_FORM_MISFIT = 0.1
"""Remaining difference between the true field and the fit's nearest one, in log E: approximate."""


@dataclass(frozen=True)
class Truth:
    """A drawn branch.

    Attributes:
        branch: Shape, and Young's modulus at the control points.
        form: Form of the modulus between them; one of FORMS.
        poisson, density: True values.
        model: Model on the fine mesh.
    """

    branch: PaperBranch
    form: str
    poisson: float
    density: float
    model: BranchModel

    @property
    def young(self) -> np.ndarray:
        return np.array(self.branch.young)


def drawn_truth(rng: np.random.Generator) -> Truth:
    """Draw a branch of wood, as long and thick as the paper's, and softer outwards like those."""
    length = rng.uniform(0.45, 0.75)
    root = rng.uniform(6e-3, 10e-3)
    ratios = np.clip(rng.normal(-0.9, 0.5, 3), -2.0, 0.0)
    young = np.exp(np.log(rng.uniform(1e9, 5e9)) + np.r_[0.0, np.cumsum(ratios)])
    poisson = float(np.clip(rng.normal(POISSON, 0.05), 0.2, 0.47))
    density = DENSITY * (1 + 0.1 * rng.standard_normal())
    branch = PaperBranch("drawn", tuple(young.tolist()), poisson, length,
                         (root, root * rng.uniform(0.6, 0.85)), rng.uniform(0.1, 0.6))
    form = str(rng.choice(FORMS))
    mesh = branch.mesh(slice_length=1.45, sides=8)
    field = np.exp(log_field(form, mesh, branch, rng))
    return Truth(branch, form, poisson, density, BranchModel(
        mesh, young=field, poisson=poisson, density=density, gravity=GRAVITY))


def log_field(form: str, mesh: TetMesh, branch: PaperBranch, rng: np.random.Generator,
              ) -> np.ndarray:
    """Log E of the tetrahedra: through the moduli at the control points, different from a fit's.
    """
    nodes = branch.skeleton.nodes
    along = np.linalg.norm(mesh.centroids[:, None] - nodes[None], axis=2).argmin(axis=1) / (
        len(nodes) - 1)
    places, values = np.array(FRACTIONS), np.log(branch.young)
    straight = np.interp(along, places, values)
    if form == "straight":
        return straight
    if form == "wavy":
        return straight + 0.12 * rng.standard_normal() * np.sin(np.pi * along / 0.2)
    inside = PchipInterpolator(places, values)
    slopes = inside.derivative()(places[[0, -1]])
    before, after = np.maximum(places[0] - along, 0), np.maximum(along - places[-1], 0)
    # It continues its slope and levels off: continued linearly, a base reached 50 GPa.
    beyond = LEVELS_OFF * (slopes[1] * (1 - np.exp(-after / LEVELS_OFF))
                           - slopes[0] * (1 - np.exp(-before / LEVELS_OFF)))
    return inside(np.clip(along, places[0], places[-1])) + beyond


def exact_pull(truth: Truth, number: int, choice: PullChoice, turn: float = 0.0, *,
               shifts: np.ndarray | float = 0.0) -> Pull:
    """One pull without measurement errors; its force is rotated by ``turn``.

    ``shifts``: distances of the observed points along the branch from the control points [m].
    """
    branch = truth.branch
    skeleton, mesh = branch.skeleton, truth.model.mesh
    point = skeleton.point_at(choice.fraction)
    radius = float(skeleton.radius_at(choice.fraction))
    points = control_points(skeleton, FRACTIONS)
    entry = PullEntry(
        gravity_m_s2=GRAVITY, source="truth", rest_points_m=tuple(map(tuple, points.tolist())),
        grasp=GraspEntry(point_m=tuple(point.tolist()), radius_m=1.3 * radius, mode="point"))
    grasp = grasp_on(mesh, entry.grasp)
    states = np.linspace(0.0, 6.0, STATES)
    made = moved(truth.model, grasp, MotionWanted(
        kind="pull", point=point, axis=point - skeleton.nodes[0],
        travel=choice.reach * choice.fraction * branch.length, turn=turn, phase=choice.phase,
        times=states, weight=np.zeros(3)))
    points = marked_points(skeleton, FRACTIONS, shifts)
    seen = seen_at(points, mesh, made.displacements)
    times = np.linspace(0.0, 6.0, FRAMES)
    poses, wrenches, positions = (CubicSpline(states, values)(times)
                                  for values in (made.poses, made.wrenches, seen))
    return Pull(f"pull-{number + 1}", entry, times, poses, wrenches, Observations(times, positions))


def recorded(pull: Pull, cell: CellErrors, rng: np.random.Generator) -> Pull:
    """The cell's recording of a pull: its own errors, the sensor's drifting zero, and noise."""
    seen = cell.recorded(pull, rng)
    peak = float(np.linalg.norm(pull.wrenches[:, :3], axis=1).max())
    wrenches, positions = seen.wrenches.copy(), seen.observations.positions
    wrenches[:, :3] += FORCE_NOISE * peak * rng.standard_normal((len(wrenches), 3))
    sensor = SensorEntry(position_sigma_m=POSITION_NOISE_M, force_sigma_n=FORCE_NOISE * peak)
    return replace(
        seen, entry=seen.entry.model_copy(update={"sensor": sensor}), wrenches=wrenches,
        observations=Observations(pull.times, positions + POSITION_NOISE_M * rng.standard_normal(
            positions.shape)))


def cell_trial(task: tuple[int, int, int], calibration: CalibrationEntry, pull_count: int,
               ) -> dict[str, Any]:
    """Draw a branch and a cell, pull, fit, and compare with the truth; refusals pass.

    Returns:
        Relative errors of the moduli, whether intervals contain the truth, their half widths in
        log E, each of shape [4]; covariances of log E by the bound, see :func:`bounds`.
    """
    rng = np.random.default_rng(task)
    truth = drawn_truth(rng)
    cell = CellErrors.drawn(calibration, rng)
    first = replace(FIRST_PULL, phase=rng.uniform(0, 2 * np.pi))

    def off() -> np.ndarray:
        return calibration.point_sigma_m * rng.standard_normal(len(FRACTIONS))

    pulls = [recorded(exact_pull(truth, 0, first, FIRST_TURN, shifts=off()), cell, rng)]
    subject = fitting_subject(truth)
    found = _estimated(pulls, subject)
    while len(pulls) < pull_count:
        choice = _suggested(found, pulls, subject)
        pulls.append(recorded(exact_pull(truth, len(pulls), choice, shifts=off()), cell, rng))
        found = _estimated(pulls, subject)
    log_truth = np.log(truth.young)
    low, high = np.log(total_interval(found.values.young, found.uncertainty.young_interval,
                                      found.model_error)).T
    as_fitted, of_known_form = bounds(truth, found.objective, subject)
    return {"errors": found.young / truth.young - 1, "covered": (low <= log_truth) & (
        log_truth <= high), "widths": (high - low) / 2, "bound": as_fitted,
        "bound_of_known_form": of_known_form}


def _estimated(pulls: list[Pull], subject: Subject) -> Estimate:
    """Result of `limber estimate`, its mesh's stiffness corrected, or its refusal."""
    found = fit_branch(pulls, subject, SETTINGS, log=EvaluationLog(None, ""))
    require_result(found, subject.skeleton)
    judge_model(found, subject, pulls[0].entry.grasp, SETTINGS, axes=None, cloud=None)
    return found


def _suggested(found: Estimate, pulls: list[Pull], subject: Subject) -> PullChoice:
    """The most informative pull that `limber suggest-pull` finds after an estimate."""
    written = summary(found, SETTINGS) | details(found, subject, pulls)
    offered = suggest(subject, found.values, Known.estimated(plain(written)),
                      Cell.of(pulls[-1]), CANDIDATES,
                      max_strain=_MOST_STRAIN, workers=1)
    return max(offered.pulls, key=lambda pull: pull.bits).choice


def fitting_subject(truth: Truth) -> Subject:
    """The user's branch: a coarser mesh, textbook density and Poisson's ratio."""
    skeleton = truth.branch.skeleton
    mesh = truth.branch.mesh(slice_length=3.0, sides=8)
    points = control_points(skeleton, FRACTIONS)
    weights = young_weights(mesh, points)
    model = BranchModel(mesh, young=1e9, poisson=POISSON, density=DENSITY, gravity=None)
    return Subject(mesh, skeleton, points, weights, model, Values(np.full(4, 1e9), POISSON,
                   DENSITY), open_field(mesh, skeleton, weights, FRACTIONS))


def bounds(truth: Truth, objective: Objective, subject: Subject) -> tuple[np.ndarray, np.ndarray]:
    """Covariances of log E by the Cramer-Rao bound, each of shape [4, 4]; no link helps them.

    With the form of the field as little known as the fit assumes, and with it known: no fit that
    knows as little of the cell beats the latter, however forms are drawn.
    """
    objective = objective.with_space(objective.space.linked(()))
    evaluation = objective.evaluate(objective.space.pack(true_values(truth, subject)),
                                    jacobian=True)
    count = len(truth.young)
    if evaluation is None:
        return (np.full((count, count), np.nan),) * 2
    known = [name not in subject.field.names for name in objective.space.names]
    return tuple(inverse_information(slopes)[:count, :count] for slopes in (
        evaluation.jacobian, evaluation.jacobian[:, known]))


def true_values(truth: Truth, subject: Subject) -> Values:
    """The truth in a fit's terms: the information about moduli depends on the form of the field
    too, which is taken as near to the true one as the fit's field comes.
    """
    values = Values(truth.young, truth.poisson, truth.density)
    nearest = cKDTree(truth.model.mesh.centroids).query(subject.mesh.centroids)[1]
    missing = np.log(truth.model.young[nearest]) - np.log(subject.young(values))
    slopes = subject.field.shares(values, subject.field.names)[len(truth.young):]
    rows = np.vstack([slopes.T / _FORM_MISFIT, np.eye(len(slopes))])
    wanted = np.r_[missing / _FORM_MISFIT, np.zeros(len(slopes))]
    form = np.linalg.lstsq(rows, wanted, rcond=None)[0]
    return replace(values, form=tuple(form.tolist()))
