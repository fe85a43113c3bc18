"""Branches with a newly drawn truth, and what a real cell would record of them.

The truth uses a finer mesh than the fit. Its Young's modulus varies between the control points
differently than the fit assumes; its Poisson's ratio and density are not those given to the fit.
The cell has a sensor with gain, zero and drift, and gripper and camera are slightly off.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator

from benchmarks.paper_branches import PaperBranch
from limber.estimation.forward.gripper_path import MotionWanted, moved
from limber.estimation.next_pull import PullChoice
from limber.estimation.simulated_pull import CellErrors, marked_points
from limber.geometry.skeleton.skeleton import control_points
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.model import BranchModel
from limber.mechanics.points import point_operator
from limber.recordings.recorded_grasp import grasp_on
from limber.recordings.recording import (
    GraspEntry,
    Observations,
    Pull,
    PullEntry,
    SensorEntry,
)

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
    operator = point_operator(mesh, points)
    seen = np.array([points + (operator @ each.ravel()).reshape(-1, 3)
                     for each in made.displacements])
    times = np.linspace(0.0, 6.0, FRAMES)
    poses, wrenches, positions = (CubicSpline(states, values)(times)
                                  for values in (made.poses, made.wrenches, seen))
    return Pull(f"pull-{number + 1}", entry, times, poses, wrenches,
                Observations(times, positions))


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
