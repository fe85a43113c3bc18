"""Analytic energy fields, as if a branch model had been asked, and one small real branch."""

from dataclasses import dataclass

import numpy as np
import pytest
from tests.stages.specified import Planned

from limber.core.progress import Progress
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.tets.tet_mesh import mark
from limber.geometry.tets.tree_sweep import curved_beam
from limber.mechanics import BranchModel
from limber.mechanics.loads.loaded_branch import hang
from limber.planning import make_plan
from limber.planning.certificate import lower_bound
from limber.planning.field.energy_field import fit_field
from limber.planning.field.grasp_model import grasp_model_of
from limber.planning.field.stored_states import States
from limber.stages.paths.energy import SampleEnergy
from limber.store import Branch

STIFFNESS = np.array([8.0, 8.0, 30.0])  # [N/m] soft to the sides, stiff along the branch
SIDE = np.array([0.02, 0.02, 0.0])  # [m] where the ridge stands


@dataclass(frozen=True)
class AnalyticBranch:
    """A quadratic well about the origin, and a Gaussian ridge of ``height`` [J] beside it."""

    height: float
    width: float = 0.05

    def energy(self, points):
        """Energy [J] at ``points`` [n, 3]."""
        return 0.5 * (points**2 @ STIFFNESS) + self._bump(points)

    def force(self, points):
        """Its gradient [N]."""
        bump = self._bump(points)[:, None]
        return points * STIFFNESS - 2 * (points - SIDE) * bump / self.width**2

    def samples(self, *, count=150, radius=0.2, seed=0, rejected=()):
        """Samples in a ball; the tip moves 1.5 times as far as the grasp, from 0.3 m above."""
        generator = np.random.default_rng(seed)
        direction = generator.normal(size=(count, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        points = direction * (radius * generator.uniform(size=(count, 1)) ** (1 / 3))
        points[0] = 0.0
        rotation = np.stack([-points[:, 1], points[:, 0], 0 * points[:, 0]], axis=1)
        energies = self.energy(points)
        return States(
            np.hstack([points, rotation]), energies, self.force(points),
            1.5 * points + [0.0, 0.0, 0.3], np.full(count, 0.95),
            np.asarray(rejected, float).reshape(-1, 6), 0.1 * points[:, 0] + 0.05,
            axial_forces=self.force(points)[:, 2])

    def _bump(self, points):
        return self.height * np.exp(-((points - SIDE) ** 2).sum(axis=1) / self.width**2)


@pytest.fixture(scope="session")
def well():
    return AnalyticBranch(0.0)


@pytest.fixture(scope="session")
def ridge():
    return AnalyticBranch(0.4)


@pytest.fixture(scope="session")
def well_field(well):
    return fit_field(well.samples(count=60))


@pytest.fixture(scope="session")
def ridge_field(ridge):
    return fit_field(ridge.samples())


@pytest.fixture(scope="session")
def small_skeleton():
    """An arc half a metre long that bends by 0.4 rad."""
    s = np.linspace(0.0, 1.0, 41)
    tangent = np.column_stack([np.sin(0.4 * s), 0 * s, np.cos(0.4 * s)])
    steps = (tangent[1:] + tangent[:-1]) / 2 * 0.5 / 40
    nodes = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
    return Skeleton(nodes, np.arange(-1, 40), np.interp(s, [0, 1], [0.008, 0.006]))


@pytest.fixture(scope="session")
def small_mesh(small_skeleton):
    """A coarse mesh of it, with base, grasp and a stiffness that falls towards the tip."""
    mesh = curved_beam(small_skeleton.nodes, small_skeleton.radius, slice_length=5.0, sides=5)
    mesh = mark(mesh, small_skeleton, young=1e8, poisson=0.35, density=900.0)
    young = np.interp(mesh.centroids[:, 2], [0.0, 0.5], [1.5e8, 0.5e8])
    return mesh.with_data(cell_data={"young": young})


@pytest.fixture(scope="session")
def small_model(small_mesh, small_skeleton):
    return small_grasp_model(small_mesh, small_skeleton, None)


def small_grasp_model(mesh, skeleton, gravity):
    """What planning asks of the small branch, under a gravity [m/s^2] or without weight."""
    data = {name: mesh.cell_data[name] for name in ("young", "poisson", "density")}
    return grasp_model_of(hang(BranchModel(mesh, **data, gravity=gravity),
                               progress=Progress(on_warning=pytest.fail)), skeleton)


@pytest.fixture(scope="session")
def planned_branch(tmp_path_factory, small_mesh, small_skeleton):
    """A branch folder with an energy field and a plan, as the commands make them."""
    folder = tmp_path_factory.mktemp("planning") / "small.branch"
    branch = Branch.create(folder)
    with branch.stage("mesh") as stage:
        small_mesh.write(stage.path("mesh.vtu"))
        small_skeleton.write_swc(stage.path("skeleton.swc"))
    SampleEnergy(branch_folder=folder, samples=60).run()
    Planned(branch_folder=folder, iterations=800, start_seed=3, name="there").run()
    return folder


@pytest.fixture
def coarse_bound(monkeypatch):
    """The bound without its last, finest grids, where something else is tested: half a minute."""
    monkeypatch.setattr(lower_bound, "_MOST_CELLS", 15_000)


@pytest.fixture
def rough_plan(monkeypatch):
    """The first plan is passed on, however wrong the field is along it."""
    monkeypatch.setattr(make_plan, "FIELD_ERROR", 20.0)
