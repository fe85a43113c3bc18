"""A clamping gripper holds a piece as long as it is, whatever the mesh."""

import numpy as np
import pytest
from tests.subjects.meshes import box_mesh

from limber.core.numerics.rigid import rotation_matrix
from limber.estimation.forward.forward_model import nodal_loads
from limber.geometry.tets.tree_sweep import straight_beam
from limber.mechanics import BranchModel, Grasp, solve_static
from limber.mechanics.sensitivities import grasp_slopes
from limber.recordings.recording import GraspEntry

LENGTH, RADIUS, YOUNG = 0.4, 0.004, 1e9
PLACE, HALF = 0.3, 0.012


def beam(slices: int) -> BranchModel:
    mesh = straight_beam(LENGTH, RADIUS, slice_count=slices)
    return BranchModel(mesh, young=YOUNG, poisson=0.35, density=900.0, gravity=None)


def free_length(slices: int, place: float, half: float) -> float:
    """Length [m] that bends when the gripper turns a straight beam, in lengths of that mesh's.

    What a mesh is too stiff by at its ends and in its section, where one ring is held, is left out.
    """
    model = beam(slices)
    mesh, rest = model.mesh, np.zeros_like(model.mesh.nodes)

    def turned(held: BranchModel, grasp: Grasp) -> float:
        return float(np.linalg.inv(grasp_slopes(held, grasp, rest).wrench)[4, 4])

    rings = np.unique(mesh.nodes[mesh.tets[:, :4], 2].round(9))
    near, far = rings[np.searchsorted(rings, [place / 2, place])]
    at_near, at_far = (turned(model, Grasp.of_nodes(mesh, np.flatnonzero(
        np.abs(mesh.nodes[:, 2] - ring) < 1e-8))) for ring in (near, far))
    grasp = Grasp.gripping(mesh, [0, 0, place], half, least=6)
    gripped = turned(model.gripped(grasp), grasp)
    return near + (far - near) * (gripped - at_near) / (at_far - at_near)


@pytest.mark.parametrize("slices", [29, 37, 80])
@pytest.mark.parametrize("place", [0.300, 0.304, 0.308])
def test_what_bends_ends_where_the_gripper_begins(slices, place):
    """Slices of 5 to 14 mm, a gripper of 24 mm in the middle of one or between two: within 0.6 mm.
    """
    assert free_length(slices, place, HALF) == pytest.approx(place - HALF, abs=6e-4)


def test_a_gripper_shorter_than_a_slice_is_told_too():
    """Which holds no ring of corners at all, or one, of slices of 16 mm: within 1 mm."""
    off = [free_length(25, place, 0.005) - (place - 0.005) for place in (0.296, 0.300, 0.304)]
    assert np.abs(off).max() < 1e-3


@pytest.mark.parametrize("slices", [29, 80])
def test_a_force_and_a_torque_move_it_as_its_pose_does(slices):
    """The piece is as firm where the gripper's wrench leads and no node is held."""
    model = beam(slices)
    grasp = Grasp.gripping(model.mesh, [0, 0, PLACE], HALF)
    held = model.gripped(grasp)
    wrench = np.array([2.0, 0.0, 0.0, 0.0, -0.1, 0.02])
    loads = nodal_loads(grasp, GraspEntry(point_m=(0.0, 0.0, PLACE), radius_m=HALF),
                        np.zeros(6), model.mesh.nodes, 6)
    pushed = solve_static(held, nodal_forces=np.tensordot(wrench, loads, axes=1)).require()
    pose = grasp.pose_of(model.mesh.nodes, pushed.displacement)
    led = solve_static(held, grasp=grasp, pose=pose, start=pushed.displacement).require()
    assert led.reaction_force == pytest.approx(wrench[:3], abs=0.03)
    off = np.linalg.norm(pushed.displacement - led.displacement, axis=1).max()
    assert off < 0.002 * np.linalg.norm(led.displacement, axis=1).max()


def test_how_the_place_changes_with_the_nodes():
    """Of a gripper whose middle lies beside the ring that it holds, against differences."""
    model = beam(29)
    mesh = model.mesh
    grasp = Grasp.gripping(mesh, [0, 0, PLACE], 0.008)
    assert abs((grasp.weights @ mesh.nodes[grasp.nodes])[2] - PLACE) > 1e-3
    rng = np.random.default_rng(0)
    arms = mesh.nodes - [0.01, 0.02, 0.1]

    def moved(vector: np.ndarray) -> np.ndarray:
        return arms @ rotation_matrix(vector[3:]).T + vector[:3] - arms

    start = rng.normal(size=6) * 0.3
    steps = [1e-6 * unit for unit in np.eye(6)]
    changes = np.stack([(moved(start + step) - moved(start - step)) / 2e-6 for step in steps], -1)
    slopes = grasp.position_slopes(mesh.nodes, moved(start), changes)
    wanted = np.stack([(grasp.pose_of(mesh.nodes, moved(start + step))[:3]
                        - grasp.pose_of(mesh.nodes, moved(start - step))[:3]) / 2e-6
                       for step in steps], -1)
    assert slopes == pytest.approx(wanted, abs=1e-6)


def test_only_what_is_in_the_gripper_is_stiffer():
    """A pinned grasp, and one of which only the nodes are known, change nothing."""
    model = beam(37)
    grasp = Grasp.gripping(model.mesh, [0, 0, PLACE], HALF)
    held = model.gripped(grasp)
    along = np.abs(model.mesh.nodes[model.mesh.tets[:, :4], 2] - PLACE).min(axis=1)
    assert np.all((held.stiffening > 1) == (along < HALF - 1e-12))
    assert np.array_equal(held.young, model.young)
    assert held.with_young(2 * YOUNG).lame_mu == pytest.approx(2 * held.lame_mu)
    assert held.gripped().lame_mu == pytest.approx(model.lame_mu)
    assert model.gripped(Grasp.at(model.mesh, [0, 0, PLACE], HALF, "point")) is model


@pytest.mark.parametrize("radius", [0.003, 0.006, 0.01, 0.012, 0.02])
def test_a_load_on_an_edge_acts_there(radius):
    """However wide the patch: nodes off the edge would give it another lever."""
    mesh = box_mesh((0.03, 0.03, 0.1), (6, 6, 20))
    grasp = Grasp.at(mesh, [0.0, 0.015, 0.1], radius, "point")
    assert grasp.weights @ mesh.nodes[grasp.nodes] == pytest.approx([0.0, 0.015, 0.1], abs=1e-9)
