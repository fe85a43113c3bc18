"""The paper's three branches: its table of E and nu as truth, on geometry of that size."""

import time
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from limber.core.progress import Progress
from limber.estimation.fit import fit_pulls
from limber.estimation.fit_assessment import Estimate
from limber.estimation.fitting.objective import Objective
from limber.estimation.forward.solved_pull import QuasiStaticForward
from limber.estimation.parameters import BULK, ParameterSpace, Values
from limber.estimation.settings import FitSpec
from limber.estimation.simulated_pull import PullSpec, TrueBranch, simulate_pull
from limber.geometry.reconstruction import mesh_skeleton
from limber.geometry.settings import ReconstructSettings
from limber.geometry.skeleton.skeleton import Skeleton, control_points
from limber.geometry.tets.tet_mesh import TetMesh, base_nodes
from limber.geometry.tets.tree_sweep import curved_beam
from limber.mechanics.materials.materials import young_weights
from limber.mechanics.model import BranchModel
from limber.recordings.recording import Observations, Pull
from limber.recordings.synchronisation import frames_of

FRACTIONS = (0.2, 0.4, 0.6, 0.8)


class Fitted(NamedTuple):
    """What a method finds of a branch: moduli [Pa] at 4 control points, Poisson's ratio, the sum of
    squared distances of the points [m^2], simulations and seconds, and whether it converged."""

    young: np.ndarray
    poisson: float
    loss: float
    count: int
    seconds: float
    converged: bool


@dataclass(frozen=True)
class PaperBranch:
    """A row of the paper's table of estimated parameters, and a matching shape.

    Attributes:
        name: Name in the paper.
        young: Young's moduli at K control points at equal distances [Pa], shape [K].
        poisson: Poisson's ratio.
        length: Length [m].
        radius: Radii at base and tip [m].
        bend: Rotation of the axis from base to tip [rad].
        fork: Position of a side branch on the axis as a fraction, and its length [m]; None: there
            is none.
    """

    name: str
    young: tuple[float, ...]
    poisson: float
    length: float
    radius: tuple[float, float]
    bend: float
    fork: tuple[float, float] | None = None

    @property
    def fractions(self) -> tuple[float, ...]:
        """Positions of the control points as fractions of the axis."""
        count = len(self.young)
        return tuple((k + 1) / (count + 1) for k in range(count))

    @property
    def skeleton(self) -> Skeleton:
        """An arc that leaves its plane a little, as in a real branch."""
        s = np.linspace(0.0, 1.0, 81)
        angle = self.bend * s
        tangent = np.column_stack([np.sin(angle), 0.3 * np.sin(angle) * s, np.cos(angle)])
        tangent /= np.linalg.norm(tangent, axis=1)[:, None]
        steps = (tangent[1:] + tangent[:-1]) / 2 * self.length / 80
        nodes = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
        radii, parents = np.interp(s, [0, 1], self.radius), np.arange(-1, 80)
        if self.fork is not None:
            start, count = round(80 * self.fork[0]), 20
            outward = tangent[start] + np.cross(tangent[start], [0.0, 1.0, 0.0])
            outward *= self.fork[1] / count / np.linalg.norm(outward)
            nodes = np.vstack([nodes, nodes[start] + np.arange(1, count + 1)[:, None] * outward])
            radii = np.r_[radii, np.linspace(0.7, 0.5, count) * radii[start]]
            parents = np.r_[parents, start, 81 + np.arange(count - 1)]
        return Skeleton.from_edges(nodes, parents, radii)

    def mesh(self, *, slice_length: float, sides: int) -> TetMesh:
        """Swept tetrahedra with the base marked; with a fork as reconstruct meshes it."""
        skeleton = self.skeleton
        if self.fork is not None:
            return mesh_skeleton(skeleton, ReconstructSettings()).mesh
        mesh = curved_beam(skeleton.nodes, skeleton.radius, slice_length=slice_length, sides=sides)
        return mesh.with_data(point_data={"fixed": base_nodes(mesh, skeleton)})

    def truth(self) -> TrueBranch:
        """The branch on its fine mesh, weightless: such moduli could not carry its weight."""
        skeleton = self.skeleton
        return TrueBranch(self.mesh(slice_length=1.3, sides=10), skeleton,
                          control_points(skeleton, self.fractions), self.fractions,
                          np.array(self.young),
                          is_weightless=True)

    def fitted(self, method: str, seed: int) -> Fitted:
        """Fit one noisy pull by ``nelder-mead`` or ``gauss-newton``, as the paper does: the
        measured force drives, E is interpolated by inverse distances, nu is one of the unknowns."""
        bench = Bench(self, slice_length=2.4, sides=6)
        pull = measured(exact_pull(self, 0, frames=30), seed)
        pull = replace(pull, entry=pull.entry.model_copy(update={"drive": "force"}))
        began = time.process_time()
        found = bench.fit([pull], FitSpec(hold_out=False, method=method, also=("poisson",),
                                          key_frames=6))
        fit = found.fit
        return Fitted(found.values.young, found.values.poisson, fit.evaluation.loss,
                      found.objective.forward_count, time.process_time() - began, fit.converged)


BRANCHES = (
    PaperBranch("young", (8.21e6, 3.35e6, 1.82e6, 0.29e6), 0.382, 0.50, (0.008, 0.006), 0.3),
    PaperBranch("mature", (26.1e6, 9.13e6, 7.58e6, 1.04e6), 0.351, 0.60, (0.009, 0.007), 0.5),
    PaperBranch("artificial", (122e6, 86e6, 44e6, 16e6), 0.336, 0.70, (0.008, 0.006), 0.2),
)
"""The paper's table, in pascals."""


def exact_pull(branch: PaperBranch, number: int, frames: int = 100) -> Pull:
    """One pull of the true branch without noise; ``number`` selects its direction."""
    settings = PullSpec(
        young=branch.young, poisson=branch.poisson, frames=frames, position_noise=0.0,
        force_noise=0.0, reach=0.4, phase=2.1 * number + 0.3, seed=number)
    return simulate_pull(branch.truth(), f"pull-{number + 1}", settings)[0]


def measured(pull: Pull, seed: int, *, points: float = 1e-3, force: float = 0.02) -> Pull:
    """Add noise: [m] to points, a fraction of its largest size to the force.

    The noise that the recording states stays 1 mm and 2 %: an estimator does not know that its data
    are exact.
    """
    rng = np.random.default_rng([seed, int(pull.name.rsplit("-", 1)[1])])
    peak = float(np.linalg.norm(pull.wrenches[:, :3], axis=1).max())
    wrenches = pull.wrenches.copy()
    wrenches[:, :3] += force * peak * rng.standard_normal((len(wrenches), 3))
    seen = pull.observations
    positions = seen.positions + points * rng.standard_normal(seen.positions.shape)
    sensor = pull.entry.sensor.model_copy(update={
        "position_sigma_m": max(points, 1e-3), "force_sigma_n": max(force, 0.02) * peak})
    return replace(pull, entry=pull.entry.model_copy(update={"sensor": sensor}),
                   wrenches=wrenches, observations=Observations(seen.times, positions))


class Bench:
    """Fitting mesh of one branch; fits pulls of it."""

    def __init__(self, branch: PaperBranch, *, slice_length: float = 1.7, sides: int = 8):
        self.branch = branch
        self.mesh = branch.mesh(slice_length=slice_length, sides=sides)
        self.points = control_points(branch.skeleton, branch.fractions)
        self.weights = young_weights(self.mesh, self.points)
        self.model = BranchModel(self.mesh, young=1e7, poisson=0.35, density=900.0, gravity=None)

    def objective(self, pulls: list[Pull], settings: FitSpec) -> Objective:
        """The objective of ``limber estimate``."""
        forwards = [QuasiStaticForward(pull.name, self.model, self.weights, pull.entry,
                                       frames_of(pull), np.array(pull.entry.rest_points_m
                                                                 or self.points),
                                       key_count=settings.key_frames) for pull in pulls]
        for forward in forwards:
            forward.skeleton = self.branch.skeleton
        poisson = 0.35 if settings.poisson is None else settings.poisson
        extra = (BULK,) if "poisson" in settings.also else ()
        start = Values(np.full(len(self.points), 1e7), poisson, 900.0)
        return Objective(forwards, ParameterSpace.separate(start, extra),
                         force_sigma=[pull.entry.sensor.force_sigma_n for pull in pulls])

    def fit(self, pulls: list[Pull], settings: FitSpec) -> Estimate:
        """Fit as ``limber estimate`` does; warnings are in the result."""
        objective = self.objective(pulls, settings)
        messages: list[str] = []
        found = fit_pulls(objective, objective.space.base, settings,
                          Progress(on_warning=messages.append))
        found.warnings = messages
        return found

    def errors(self, found: Estimate) -> np.ndarray:
        """Relative errors of the moduli, shape [4]."""
        return found.values.young / np.array(self.branch.young) - 1
