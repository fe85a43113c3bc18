"""The loaded branch: targets, the common fallback, grasps that stay where they are meant."""

import pickle

import numpy as np
import pytest
from tests.subjects.meshes import box_mesh

from limber.core.errors import InputError
from limber.core.numerics.rigid import rotation_matrix
from limber.core.progress import Progress
from limber.geometry.tets.tree_sweep import straight_beam
from limber.mechanics.added_masses import PointMass
from limber.mechanics.grasp import Grasp
from limber.mechanics.loads.loaded_branch import NamedTarget, hang, target_masses
from limber.mechanics.model import BranchModel

GRAVITY = (0.0, -9.81, 0.0)


def refuse(message: str) -> None:
    raise AssertionError(message)


@pytest.fixture(scope="module")
def mesh():
    return straight_beam(0.3, 0.006, 0.005, slice_count=12, grasp_fraction=0.6)


@pytest.fixture(scope="module")
def loaded(mesh):
    targets = (NamedTarget("flower", (0.0, 0.0, 0.29), 0.004),
               NamedTarget("leaf", (0.012, 0.0, 0.15)))
    model = BranchModel(mesh, young=2e8, poisson=0.35, density=900.0, gravity=GRAVITY,
                        point_masses=target_masses(targets))
    return hang(model, targets, progress=Progress(on_warning=refuse))


def test_targets_are_where_they_were_put_and_follow(loaded):
    """At rest they are at their places; a turned pose turns what hangs beside the branch."""
    still = np.zeros_like(loaded.mesh.nodes)
    places = np.array([target.position for target in loaded.targets])
    np.testing.assert_allclose(loaded.target_positions(still), places, atol=1e-15)
    turn = np.array([0.0, 0.0, 0.4])
    turned = loaded.mesh.nodes @ rotation_matrix(turn).T - loaded.mesh.nodes
    np.testing.assert_allclose(loaded.target_positions(turned),
                               places @ rotation_matrix(turn).T, atol=1e-3)


def test_masses_of_targets_are_carried(loaded):
    """The flower hung there when the branch was scanned: nothing sags, the base bears it."""
    state = loaded.equilibrium(None, None).require()
    assert np.abs(state.displacement).max() == 0.0
    assert state.base_force[1] == pytest.approx(9.81 * loaded.model.total_mass, rel=1e-6)
    own = loaded.model.without_point_masses().total_mass
    assert loaded.model.total_mass == pytest.approx(own + 0.004)


def test_what_cannot_carry_itself_is_told_and_has_no_weight():
    """A column beyond self-buckling: one warning, and the branch without weight."""
    mesh = box_mesh((0.012, 0.012, 0.6), (1, 1, 30))
    told = []
    model = BranchModel(mesh, young=1e7, poisson=0.35, density=900, gravity=(0, 0, -9.81))
    branch = hang(model, progress=Progress(on_warning=told.append))
    assert len(told) == 1
    assert "too soft to carry" in told[0]
    assert branch.model.weight_stiffness is None
    assert not branch.model.weight_force.any()


def test_a_target_too_heavy_for_the_branch_is_named(mesh):
    """Its weight was neglected with that of the branch, and a further fruit weighed nothing."""
    model = BranchModel(box_mesh((0.012, 0.012, 0.6), (1, 1, 30)), young=4e7, poisson=0.35,
                        density=900, gravity=(0, 0, -9.81))
    assert hang(model, loaded=True).model.gravity.any()
    apple = NamedTarget("apple", (0.006, 0.006, 0.6), 0.5)
    heavy = model.with_point_masses([PointMass(apple.position, apple.mass)])
    with pytest.raises(InputError, match=r"apple \(0.5 kg\).*own wood.*--fruit"):
        hang(heavy, (apple,), loaded=True)
    told = []
    assert not hang(heavy, (apple,), progress=Progress(on_warning=told.append)).model.gravity.any()
    assert "apple (0.5 kg)" in told[0]


def test_goes_to_another_process(loaded):
    """What a pickle brings back gives the same state."""
    again = pickle.loads(pickle.dumps(loaded))
    grasp = Grasp.from_mesh(loaded.mesh, "point")
    pose = grasp.rest_pose + [0.03, 0.02, -0.01, 0, 0, 0]
    one, other = (branch.equilibrium(grasp, pose).require() for branch in (loaded, again))
    np.testing.assert_array_equal(one.displacement, other.displacement)
    assert one.energy == other.energy


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["point", "rigid"])
def test_a_grasp_is_a_place_whatever_the_mesh(mode):
    """Centres are the place asked for, and energies of unlike meshes agree where patches differ."""
    point, energies = np.array([0.0, 0.0, 0.205]), []
    for slices in (24, 31, 37):
        mesh = straight_beam(0.3, 0.006, 0.005, slice_count=slices)
        branch = hang(BranchModel(mesh, young=2e8, poisson=0.35, density=900.0, gravity=GRAVITY),
                      progress=Progress(on_warning=refuse))
        grasp = Grasp.at(mesh, point, 0.012, mode)
        np.testing.assert_allclose(grasp.centre, point, atol=1e-12)
        pose = grasp.rest_pose + [0.03, 0.02, -0.01, 0, 0, 0]
        state = branch.equilibrium(grasp, pose).require()
        np.testing.assert_allclose(state.pose[:3], pose[:3], atol=1e-9)
        energies.append(state.energy)
    if mode == "point":
        assert np.ptp(energies) < 0.01 * np.mean(energies)
