"""Statics against the elastica, work and energy, path independence, bad input."""

import csv
from pathlib import Path

import numpy as np
import pytest
from tests.subjects.meshes import box_mesh, round_mesh

from limber.core.errors import ConvergenceError, InputError
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics import (
    BranchModel,
    Grasp,
    PointMass,
    StaticSettings,
    follow_poses,
    solve_static,
    young_weights,
)
from limber.mechanics.statics.rest_shape import unloaded_rest_shape

ELASTICA = Path(__file__).parents[2] / "data" / "elastica"
LENGTH, SIDE, YOUNG = 0.6, 0.008, 5e7


def reference(name):
    """Rows of a reference table, as floats."""
    with (ELASTICA / name).open() as stream:
        return [{k: float(v) for k, v in row.items()} for row in csv.DictReader(stream)]


@pytest.fixture(scope="module")
def beam(slender_beam):
    return BranchModel(slender_beam, young=YOUNG, poisson=0.35, density=900, gravity=None)


@pytest.fixture(scope="module")
def tip(slender_beam):
    return Grasp.of_nodes(slender_beam, np.flatnonzero(slender_beam.nodes[:, 2] > LENGTH - 1e-9),
                          "point")


@pytest.mark.parametrize("alpha", [1.0, 2.0, 5.0, 10.0])
def test_elastica_tip_load(beam, tip, alpha):
    """A dead tip load bends the beam as the elastica does, within 0.7 %."""
    row = next(r for r in reference("elastica_tip_load.csv") if r["alpha_PL2_over_EI"] == alpha)
    force = alpha * YOUNG * SIDE**4 / 12 / LENGTH**2
    result = solve_static(beam, grasp=tip, grasp_force=[force, 0, 0]).require()
    moved = tip.weights @ result.displacement[tip.nodes] / LENGTH
    assert moved[0] == pytest.approx(row["delta_v_over_L"], rel=0.007)
    assert -moved[2] == pytest.approx(row["delta_h_over_L"], rel=0.007)
    assert result.base_force == pytest.approx([-force, 0, 0], abs=1e-6 * force)
    assert result.iterations <= 20


@pytest.mark.parametrize("beta", [1.0, 5.0, 10.0])
def test_elastica_own_weight(slender_beam, beta):
    """A horizontal beam sags under its own weight as the elastica does, within 0.7 %."""
    row = next(r for r in reference("elastica_self_weight.csv") if r["beta_qL3_over_EI"] == beta)
    gravity = beta * YOUNG * SIDE**4 / 12 / LENGTH**3 / (900 * SIDE**2)
    model = BranchModel(slender_beam, young=YOUNG, poisson=0.35, density=900,
                        gravity=(gravity, 0, 0))
    result = solve_static(model).require()
    moved = result.displacement[slender_beam.nodes[:, 2] > LENGTH - 1e-9].mean(axis=0) / LENGTH
    assert moved[0] == pytest.approx(row["delta_v_over_L"], rel=0.007)
    assert -moved[2] == pytest.approx(row["delta_h_over_L"], rel=0.007)


def test_tapered_beam(short_box):
    """A round taper bends by the factor r0 / r1 of beam theory, within 1 %."""
    for row in reference("tapered_circular_small_deflection.csv"):
        ratio = row["r_tip_over_r_base"]
        if ratio not in (1.0, 0.5):
            continue
        mesh = round_mesh(0.006, 0.006 * ratio, 0.5, 2, 60)
        model = BranchModel(mesh, young=YOUNG, poisson=0.3, density=900, gravity=None)
        tip = Grasp.of_nodes(mesh, np.flatnonzero(mesh.nodes[:, 2] > 0.5 - 1e-9), "point")
        force = 1e-4
        result = solve_static(model, grasp=tip, grasp_force=[force, 0, 0]).require()
        moved = (tip.weights @ result.displacement[tip.nodes])[0]
        # The section is the octagon of the mesh: its own moment of inertia.
        inertia = polygon_inertia(mesh)
        wanted = row["closed_form_r0_over_3r1"] * force * 0.5**3 / (YOUNG * inertia)
        assert moved == pytest.approx(wanted, rel=0.01)


def polygon_inertia(mesh):
    """Second moment of the base section's boundary polygon about y [m^4]."""
    corners = np.unique(mesh.tets[:, :4])
    base = mesh.nodes[corners][np.abs(mesh.nodes[corners][:, 2]) < 1e-12][:, :2]
    radius = np.linalg.norm(base, axis=1)
    ring = base[radius > radius.max() - 1e-9]
    ring = ring[np.argsort(np.arctan2(ring[:, 1], ring[:, 0]))]
    after = np.roll(ring, -1, axis=0)
    cross = ring[:, 0] * after[:, 1] - after[:, 0] * ring[:, 1]
    return (cross * (ring[:, 0]**2 + ring[:, 0] * after[:, 0] + after[:, 0]**2)).sum() / 12


@pytest.mark.slow
def test_work_of_the_gripper_is_the_energy(beam, slender_beam):
    """The clamped gripper's force and torque, summed along its path, give the strain energy."""
    grasp = Grasp.at(slender_beam, [0, 0, 0.5], 0.01, "rigid")
    parts = np.linspace(0, 1, 41)
    rate = np.array([0.15, 0.04, 0.0, 0.0, 0.4, 0.3])
    # Along the axis as much as sideways motion takes: neither stretched nor buckled.
    fall = np.array([0, 0, -0.03, 0, 0, 0])
    poses = grasp.rest_pose + parts[:, None] * rate + parts[:, None]**2 * fall
    results = follow_poses(beam, grasp, poses)
    assert all(r.converged for r in results)
    wrench = np.array([np.concatenate([r.reaction_force, r.reaction_torque]) for r in results])
    # The path's rotation vector keeps its axis, so its rate is the angular velocity.
    power = (wrench * (rate + 2 * parts[:, None] * fall)).sum(axis=1)
    step = parts[1]
    simpson = step / 3 * (power[0] + power[-1] + 4 * power[1:-1:2].sum() + 2 * power[2:-1:2].sum())
    assert simpson == pytest.approx(results[-1].strain_energy, rel=1e-4)


@pytest.mark.slow
def test_force_and_pose_are_dual(column):
    """The reaction at a pinned pose, applied as a force, gives the same shape."""
    mesh, _ = column
    beam = BranchModel(mesh, young=YOUNG, poisson=0.35, density=900, gravity=None)
    grasp = Grasp.at(mesh, [0, 0, 0.45], 0.012, "point")
    pose = grasp.rest_pose + np.array([0.15, 0.05, -0.033, 0, 0, 0])
    held = solve_static(beam, grasp=grasp, pose=pose).require()
    pulled = solve_static(beam, grasp=grasp, grasp_force=held.reaction_force).require()
    assert pulled.displacement == pytest.approx(held.displacement, abs=1e-6)
    assert held.pose[:3] == pytest.approx(pose[:3], abs=1e-9)
    assert held.reaction_torque == pytest.approx(np.zeros(3), abs=1e-6)


def test_result_does_not_depend_on_the_path():
    """A far pose reached at once, in small steps, or with plain Newton has one energy."""
    mesh = box_mesh((0.012, 0.012, 0.6), (1, 1, 40))
    beam = BranchModel(mesh, young=YOUNG, poisson=0.35, density=900, gravity=None)
    grasp = Grasp.at(mesh, [0, 0, 0.4], 0.01, "point")
    # Farther than the axis falls when bent so far: no straight column has to buckle first.
    pose = grasp.rest_pose + np.array([0.15, 0.05, -0.035, 0, 0, 0])
    once = solve_static(beam, grasp=grasp, pose=pose,
                        settings=StaticSettings(verify=True)).require()
    small = follow_poses(beam, grasp, np.linspace(grasp.rest_pose, pose, 12))[-1].require()
    plain = solve_static(beam, grasp=grasp, pose=pose,
                         settings=StaticSettings(mixed=False, max_step=0.05, max_iterations=60)
                         ).require()
    for other in (small, plain):
        assert other.strain_energy == pytest.approx(once.strain_energy, rel=1e-6)
        assert other.displacement == pytest.approx(once.displacement, abs=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["point", "rigid"])
def test_a_guess_of_the_end_saves_the_way(column, mode):
    """Near the end, or far off it: the state is the one that the way leads to, its pose the asked
    one to the last digit; from the end itself there is nothing to do."""
    mesh, _ = column
    beam = BranchModel(mesh, young=YOUNG, poisson=0.35, density=900, gravity=None)
    grasp = Grasp.at(mesh, [0, 0, 0.45], 0.012, mode)
    pose = grasp.rest_pose + np.array([0.12, 0.05, -0.03, 0, 0, 0])
    near = pose + np.array([0.01, 0.0, 0.0, 0, 0, 0])
    start = solve_static(beam, grasp=grasp, pose=near).require()
    plain, = follow_poses(beam, grasp, pose[None], start=start)
    other = solve_static(beam, grasp=grasp, pose=pose - [0.0, 0.005, 0.0, 0, 0, 0]).require()
    close = 2.0 * other.displacement - solve_static(
        beam, grasp=grasp, pose=pose - [0.0, 0.01, 0.0, 0, 0, 0]).require().displacement
    for guess in (close, -3.0 * close):
        led, = follow_poses(beam, grasp, pose[None], start=start, guess=guess)
        assert led.converged and led.reached == 1.0
        assert led.displacement == pytest.approx(plain.displacement, abs=1e-6)
        assert led.reaction_force == pytest.approx(plain.reaction_force, rel=1e-5)
        assert led.pose[:3] == pytest.approx(pose[:3], abs=1e-12)
    assert follow_poses(beam, grasp, pose[None], start=start,
                        guess=plain.displacement)[0].iterations == 0 < plain.iterations


def test_two_grasps_balance(beam, slender_beam):
    """Two grasps held at poses: each has its reaction; with the base they balance."""
    grasps = [Grasp.at(slender_beam, [0, 0, z], 0.01, mode)
              for z, mode in ((0.3, "point"), (0.55, "rigid"))]
    poses = np.array([g.rest_pose for g in grasps])
    poses[0, 0] += 0.05
    poses[1, 1] += 0.05
    result = solve_static(beam, grasp=grasps, pose=poses).require()
    assert result.reaction_force.shape == (2, 3)
    balance = result.reaction_force.sum(axis=0) + result.base_force
    assert np.abs(balance).max() < 1e-6 * np.abs(result.base_force).max()


def test_added_mass_weighs(slender_beam):
    """An added mass shows in the base's force; total weight is carried by the base."""
    model = BranchModel(slender_beam, young=5e9, poisson=0.35, density=900,
                        point_masses=[PointMass((0, 0, LENGTH), 0.02)])
    result = solve_static(model).require()
    weight = (900 * SIDE**2 * LENGTH + 0.02) * 9.80665
    assert result.base_force == pytest.approx([0, 0, weight], abs=1e-6 * weight)


def test_neo_hooke_and_stvk_agree_at_small_strain(slender_beam, tip):
    """At small strain the materials bend alike."""
    moved = []
    for material in ("st_venant_kirchhoff", "stable_neo_hookean"):
        mesh = box_mesh((0.02, 0.02, 0.2), (1, 1, 8))
        patch = Grasp.of_nodes(mesh, np.flatnonzero(mesh.nodes[:, 2] > 0.2 - 1e-9), "point")
        model = BranchModel(mesh, young=1e8, poisson=0.3, density=900, gravity=None,
                            material=material)
        result = solve_static(model, grasp=patch, grasp_force=[1.0, 0, 0]).require()
        moved.append((patch.weights @ result.displacement[patch.nodes])[0])
    assert moved[1] == pytest.approx(moved[0], rel=1e-3)


def test_neo_hooke_bears_strong_compression():
    """A block pressed to half its height: stable neo-Hooke gets there, with det F > 0."""
    mesh = box_mesh((0.02, 0.02, 0.02), (2, 2, 2))
    top = Grasp.of_nodes(mesh, np.flatnonzero(mesh.nodes[:, 2] > 0.02 - 1e-9))
    model = BranchModel(mesh, young=1e6, poisson=0.3, density=900, gravity=None,
                        material="stable_neo_hookean")
    pose = top.rest_pose + np.array([0, 0, -0.01, 0, 0, 0])
    result = solve_static(model, grasp=top, pose=pose).require()
    assert 0 < result.min_det_f < 1
    assert result.reaction_force[2] < 0


def test_torn_branch_ends_with_the_last_good_state(beam, slender_beam):
    """A pose ten branch lengths away: not converged, place and reason, a good last state."""
    grasp = Grasp.at(slender_beam, [0, 0, 0.5], 0.01)
    pose = grasp.rest_pose + np.array([0, 0, 6.0, 0, 0, 0])
    result = solve_static(beam, grasp=grasp, pose=pose)
    assert not result.converged
    assert result.status in ("torn", "inverted")
    assert "at (" in result.message
    assert 0 < result.reached < 1
    assert result.min_det_f > 0
    with pytest.raises(ConvergenceError, match="last valid state"):
        result.require()


def test_pushing_through_the_base_is_never_converged():
    """Pressing a stub down through its own base: no inverted state is called converged."""
    mesh = box_mesh((0.01, 0.01, 0.04), (1, 1, 6))
    grasp = Grasp.of_nodes(mesh, np.flatnonzero(mesh.nodes[:, 2] > 0.04 - 1e-9))
    pose = grasp.rest_pose + np.array([0, 0, -0.045, 0, 0, 0])
    model = BranchModel(mesh, young=YOUNG, poisson=0.35, density=900, gravity=None)
    result = solve_static(model, grasp=grasp, pose=pose)
    assert not result.converged
    assert result.min_det_f > 0


def test_wrong_units_warn(beam, tip):
    """A load as if in the wrong unit stretches far beyond wood, and is said to."""
    result = solve_static(beam, grasp=tip, grasp_force=[0, 0, 3000.0])
    assert result.warnings
    assert "units" in result.warnings[0]


BAD = {
    "young": ({"young": -1e6}, "must be positive"),
    "poisson": ({"poisson": 0.5}, "0.5"),
    "density": ({"density": 0.0}, "positive"),
    "shape": ({"young": np.ones(3)}, "tetrahedra"),
    "nan": ({"young": np.nan}, "finite"),
    "fixed": ({"fixed": np.array([0])}, "fixed"),
    "material": ({"material": "rubber"}, "material"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_material_is_refused(short_box, name):
    """Each value out of range is refused with what to do."""
    options, message = BAD[name]
    values = {"young": 1e7, "poisson": 0.3, "density": 900} | options
    with pytest.raises(InputError, match=message):
        BranchModel(short_box, **values)


def test_pieces_and_loose_nodes_are_refused(short_box):
    """A mesh in two pieces, and one with a node of no tetrahedron."""
    count = short_box.node_count
    two = TetMesh(np.vstack([short_box.nodes, short_box.nodes + [0.1, 0, 0]]),
                  np.vstack([short_box.tets, short_box.tets + count]),
                  point_data={"fixed": np.tile(short_box.point_data["fixed"], 2)})
    with pytest.raises(InputError, match="2 separate pieces"):
        BranchModel(two, young=1e7, poisson=0.3, density=900)
    loose = TetMesh(np.vstack([short_box.nodes, [[1.0, 1, 1]]]), short_box.tets,
                    point_data={"fixed": np.append(short_box.point_data["fixed"], 0)})
    with pytest.raises(InputError, match="not belong to any tetrahedron"):
        BranchModel(loose, young=1e7, poisson=0.3, density=900)


def test_grasp_in_the_base_and_beside_the_branch(short_box):
    """A grasp of fixed nodes, of none, and of a mode that is not known."""
    with pytest.raises(InputError, match="fixed base"):
        Grasp.at(short_box, [0, 0, 0], 0.004)
    with pytest.raises(InputError, match="nearest is"):
        Grasp.at(short_box, [1.0, 0, 0], 0.004)
    with pytest.raises(InputError, match="mode"):
        Grasp.at(short_box, [0, 0, 0.03], 0.004, "glued")
    with pytest.raises(InputError, match="does not mark a grasp"):
        Grasp.from_mesh(short_box)


def test_young_weights_are_shepards(short_box):
    """Rows sum to 1, the nearest point weighs most, two points weigh by squared distance."""
    points = np.array([[0, 0, 0.0], [0, 0, 0.03]])
    weights = young_weights(short_box, points)
    distance = np.linalg.norm(short_box.centroids[:, None] - points, axis=2)
    inverse = distance**-2.0
    assert weights == pytest.approx(inverse / inverse.sum(axis=1, keepdims=True))
    on_point = young_weights(short_box, short_box.centroids[:1])
    assert on_point == pytest.approx(np.ones((short_box.tet_count, 1)))


def test_a_column_that_must_buckle_first():
    """A straight bar pressed and drawn aside: no small step leads on, it snaps, and stays."""
    mesh = box_mesh((0.008, 0.008, 0.6), (1, 1, 60))
    model = BranchModel(mesh, young=YOUNG, poisson=0.35, density=900, gravity=None)
    grasp = Grasp.at(mesh, [0, 0, 0.4], 0.008, "point")
    pose = grasp.rest_pose + np.array([0.15, 0.05, -0.05, 0, 0, 0])
    result = solve_static(model, grasp=grasp, pose=pose).require()
    assert result.min_det_f > 0.9
    rng = np.random.default_rng(0)
    pushed = result.displacement + 1e-5 * rng.standard_normal(mesh.nodes.shape)
    again = solve_static(model, grasp=grasp, pose=pose, start=pushed).require()
    assert again.strain_energy == pytest.approx(result.strain_energy, rel=1e-6)


@pytest.fixture(scope="module")
def column():
    """A straight bar of 0.6 m, 12 mm square; its top face."""
    mesh = box_mesh((0.012, 0.012, 0.6), (1, 1, 40))
    return mesh, np.flatnonzero(mesh.nodes[:, 2] > 0.6 - 1e-9)


@pytest.mark.parametrize(("mode", "factor"), [("point", 20.19), ("rigid", 4 * np.pi**2)])
def test_pressed_column_buckles(column, mode, factor):
    """A straight bar pressed on its axis buckles at Euler's load, within 4 %, and bends on."""
    mesh, top = column
    model = BranchModel(mesh, young=YOUNG, poisson=0.35, density=900, gravity=None)
    grasp = Grasp.of_nodes(mesh, top, mode)
    result = solve_static(model, grasp=grasp, pose=grasp.rest_pose - [0, 0, 0.005, 0, 0, 0])
    assert result.converged and result.status == "converged", result.message
    assert np.abs(result.displacement[:, :2]).max() > 0.02
    euler = factor * YOUNG * 0.012**4 / 12 / 0.6**2
    assert -result.reaction_force[2] == pytest.approx(euler, rel=0.04)


def test_symmetric_column_says_that_its_side_is_chance(column):
    """Clamped at both ends nothing tells the sides apart: it warns and says where it snapped."""
    mesh, top = column
    model = BranchModel(mesh, young=YOUNG, poisson=0.35, density=900, gravity=None)
    grasp = Grasp.of_nodes(mesh, top, "rigid")
    result = solve_static(model, grasp=grasp, pose=grasp.rest_pose - [0, 0, 0.01, 0, 0, 0])
    assert result.converged
    assert result.snapped_at and any("buckled" in warning for warning in result.warnings)


def test_a_saddle_is_not_passed_off_as_an_equilibrium(column):
    """Started straight under more than Euler's load, where all forces balance: it does not stay."""
    mesh, top = column
    model = BranchModel(mesh, young=YOUNG, poisson=0.0, density=900, gravity=None)
    euler = np.pi**2 * YOUNG * 0.012**4 / 12 / 4 / 0.6**2
    load = np.zeros_like(mesh.nodes)
    grasp = Grasp.of_nodes(mesh, top, "point")
    load[top, 2] = -1.3 * euler * grasp.weights
    straight = np.zeros_like(mesh.nodes)
    straight[:, 2] = -1.3 * euler / (YOUNG * 0.012**2) * mesh.nodes[:, 2]
    result = solve_static(model, nodal_forces=load, start=straight)
    assert not result.converged or np.abs(result.displacement[:, :2]).max() > 0.1


@pytest.mark.slow
def test_a_bow_that_turned_over_is_said_to_have_another_state(column):
    """A bow pushed through by a force stays so when let go; a column that buckled comes back."""
    mesh, top = column
    model = BranchModel(mesh, young=YOUNG, poisson=0.35, density=900, gravity=None)
    end = Grasp.of_nodes(mesh, top, "rigid")
    pressed = end.rest_pose - [0, 0, 0.012, 0, 0, 0]
    middle = np.abs(mesh.nodes[:, 2] - 0.3) < 0.02
    push = np.where(middle[:, None], [1.0 / middle.sum(), 0.0, 0.0], 0.0)
    aside = solve_static(model, grasp=end, pose=pressed, nodal_forces=0.3 * push).require()
    bow = solve_static(model, grasp=end, pose=pressed, start=aside).require()
    assert bow.displacement[middle, 0].mean() > 0.02 and not bow.uncertainty
    over = solve_static(model, grasp=end, pose=pressed, nodal_forces=-2 * push, start=bow).require()
    assert over.displacement[middle, 0].mean() < -0.02
    assert "another stable state" in over.uncertainty and over.uncertainty[1:] in "".join(
        over.warnings
    )
    unasked = solve_static(model, grasp=end, pose=pressed, nodal_forces=-2 * push, start=bow,
                           settings=StaticSettings(way_back=False)).require()
    assert not unasked.uncertainty and np.array_equal(unasked.displacement, over.displacement)
    buckled = solve_static(model, grasp=end, pose=end.rest_pose - [0, 0, 0.01, 0, 0, 0])
    assert buckled.snapped_at and not buckled.uncertainty


def test_dead_load_beyond_buckling(column):
    """1.1 times Euler's load bends a cantilever sideways as the elastica of that load does."""
    mesh, top = column
    model = BranchModel(mesh, young=YOUNG, poisson=0.0, density=900, gravity=None)
    grasp = Grasp.of_nodes(mesh, top, "point")
    euler = np.pi**2 * YOUNG * 0.012**4 / 12 / 4 / 0.6**2
    result = solve_static(model, grasp=grasp, grasp_force=[0, 0, -1.1 * euler])
    assert result.converged, result.message
    moved = grasp.weights @ result.displacement[grasp.nodes] / 0.6
    # P / P_Euler = (2 K(k) / pi)^2 with k = sin(alpha / 2); sideways 2 k / (pi/2 sqrt(P/PE)).
    from scipy.optimize import brentq
    from scipy.special import ellipk
    k = brentq(lambda k: (2 * ellipk(k * k) / np.pi) ** 2 - 1.1, 1e-3, 0.99)
    assert np.linalg.norm(moved[:2]) == pytest.approx(2 * k / (np.pi / 2 * np.sqrt(1.1)), rel=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("move", [[0, 0, -0.015], [0, 0, -0.021], [0.01, 0.01, -0.015]])
def test_neo_hookean_bears_strong_compression(move):
    """A block pressed to 30 % of its height, or aslant to half of it, finds a stable balance."""
    mesh = box_mesh((0.01, 0.01, 0.03), (2, 2, 6))
    model = BranchModel(mesh, young=YOUNG, poisson=0.35, density=900, gravity=None,
                        material="stable_neo_hookean")
    grasp = Grasp.of_nodes(mesh, np.flatnonzero(mesh.nodes[:, 2] > 0.03 - 1e-9), "rigid")
    result = solve_static(model, grasp=grasp, pose=grasp.rest_pose + [*move, 0, 0, 0])
    assert result.converged, result.message
    assert result.min_det_f > 0
    assert result.residual_history[-1] < 1e-6


@pytest.mark.slow
def test_soft_stvk_points_to_the_other_material():
    """Where St. Venant-Kirchhoff gives way the message says so, and what bears it."""
    mesh = box_mesh((0.01, 0.01, 0.03), (2, 2, 6))
    model = BranchModel(mesh, young=YOUNG, poisson=0.35, density=900, gravity=None)
    grasp = Grasp.of_nodes(mesh, np.flatnonzero(mesh.nodes[:, 2] > 0.03 - 1e-9), "rigid")
    result = solve_static(model, grasp=grasp, pose=grasp.rest_pose - [0, 0, 0.015, 0, 0, 0])
    assert not result.converged
    assert "stable_neo_hookean" in result.message


@pytest.mark.parametrize(("gravity", "young"), [((9.81, 0, 0), 2e7), ((6.9, 0, -6.9), 2e7)])
def test_rest_shape_of_a_branch_that_sags_by_most_of_its_length(column, gravity, young):
    """Rest shapes farther off than 60 % of the length: their load gives the scan to 0.1 mm."""
    mesh, _ = column
    model = BranchModel(mesh, young=young, poisson=0.35, density=900, gravity=gravity)
    shape = unloaded_rest_shape(model)
    assert np.linalg.norm(shape.nodes - mesh.nodes, axis=1).max() > 0.6 * 0.6
    loaded = solve_static(model.with_rest_nodes(shape.nodes),
                          start=mesh.nodes - shape.nodes).require()
    corners = np.unique(mesh.tets[:, :4])
    miss = np.linalg.norm(shape.nodes + loaded.displacement - mesh.nodes, axis=1)
    assert miss[corners].max() < 1e-4


def test_too_soft_to_stand():
    """A column beyond self-buckling has no stable rest shape: it says so, and what to check."""
    mesh = box_mesh((0.012, 0.012, 0.6), (1, 1, 30))
    model = BranchModel(mesh, young=1e7, poisson=0.35, density=900, gravity=(0, 0, -9.81))
    with pytest.raises(ConvergenceError, match="is not stable") as caught:
        unloaded_rest_shape(model)
    assert "Young" in str(vars(caught.value)) or "Young" in str(caught.value)
