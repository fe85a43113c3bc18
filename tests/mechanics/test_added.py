"""Twigs that the mesh leaves out: exact in rigid motion, and as heavy and slow as meshed ones."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from limber.geometry.pruned_twigs import twig_mass
from limber.geometry.reconstruction import mesh_skeleton
from limber.geometry.settings import ReconstructSettings
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.tets.tree_sweep import straight_beam
from limber.mechanics import BranchModel, HungTwig, PointMass, solve_static

MATERIAL = {"young": 1e9, "poisson": 0.35, "density": 900.0}
INERTIA = ((3e-5, 1e-6, 0.0), (1e-6, 4e-5, 2e-6), (0.0, 2e-6, 5e-5))


@pytest.fixture(scope="module")
def beam():
    return straight_beam(0.3, 0.006, 0.004)


def test_rigid_motion_moves_a_twig_as_a_body(beam) -> None:
    """Work of its weight over a turn of 70 degrees, and kinetic energy, to rounding."""
    twig = HungTwig((0.12, 0.03, 0.25), 0.02, (0.0, 0.0, 0.2), INERTIA)
    model = BranchModel(beam, **MATERIAL, point_masses=[twig])
    bare = model.without_point_masses()
    assert model.total_mass - bare.total_mass == pytest.approx(0.02, rel=1e-12)
    turn = Rotation.from_rotvec(np.deg2rad(70) * np.array([0.48, 0.6, 0.64])).as_matrix()
    moved = beam.nodes @ turn.T + [0.01, -0.02, 0.03] - beam.nodes
    centre = np.array(twig.position)
    fallen = turn @ centre + [0.01, -0.02, 0.03] - centre
    work = ((model.weight_force - bare.weight_force) * moved).sum()
    assert work == pytest.approx(0.02 * -9.80665 * fallen[2], rel=1e-9)
    spin, speed = np.array([0.3, -0.5, 0.8]), np.array([0.1, 0.2, -0.3])
    velocity = speed + np.cross(spin, beam.nodes)
    energy = 0.5 * (velocity * (model.mass_times(velocity) - bare.mass_times(velocity))).sum()
    own = 0.5 * (0.02 * np.sum((speed + np.cross(spin, centre))**2)
                 + spin @ np.array(INERTIA) @ spin)
    assert energy == pytest.approx(own, rel=1e-9)
    placed = model.with_rest_nodes(beam.nodes + moved).point_masses[0]
    np.testing.assert_allclose(placed.position, centre + fallen, atol=1e-12)
    np.testing.assert_allclose(placed.attached, turn @ np.array([0, 0, 0.2]) + [0.01, -0.02, 0.03],
                               atol=1e-12)
    np.testing.assert_allclose(placed.inertia, turn @ np.array(INERTIA) @ turn.T, atol=1e-15)


def _slowest(model: BranchModel) -> float:
    """Lowest natural frequency [Hz], by inverse iteration."""
    tangent = model.equations().tangent(model, np.zeros_like(model.mesh.nodes))
    shape = np.random.default_rng(0).standard_normal(model.mesh.nodes.shape)
    for _ in range(60):
        shape = tangent.solve(model.mass_times(shape))
        shape /= np.sqrt((shape * model.mass_times(shape)).sum())
    stiff = (shape * model.tangent_times(np.zeros_like(shape), shape)).sum()
    return float(np.sqrt(stiff) / (2 * np.pi))


def test_a_left_out_twig_acts_as_a_meshed_one() -> None:
    """An upright stem with a level twig: how far it leans, and its slowest swing.

    As a point mass at its foot the twig would not make the stem lean at all.
    """
    z, x = np.linspace(0, 0.5, 26), np.linspace(0.02, 0.24, 12)
    nodes = np.vstack([np.stack([0 * z, 0 * z, z], 1), np.stack([x, 0 * x, 0 * x + 0.24], 1)])
    skeleton = Skeleton.from_edges(
        nodes, np.concatenate([np.arange(26) - 1, [12], 26 + np.arange(11)]),
        np.repeat([0.008, 0.007], [26, 12]))
    settings = ReconstructSettings(density=900.0, mesh_spacing=1.5)
    whole = BranchModel(mesh_skeleton(skeleton, settings).mesh, **MATERIAL)
    bare = mesh_skeleton(skeleton.subset(skeleton.branch == 0), settings).mesh
    told = twig_mass(skeleton, 1, 900.0)
    twig = HungTwig(tuple(told["centre_m"]), told["mass_kg"], tuple(told["attached_m"]),
                    tuple(map(tuple, told["inertia_kg_m2"])))
    rods = BranchModel(bare, **MATERIAL, point_masses=[twig])
    points = BranchModel(bare, **MATERIAL, point_masses=[PointMass(twig.attached, twig.mass)])

    def lean(model: BranchModel) -> float:
        top = np.linalg.norm(model.mesh.nodes - [0, 0, 0.5], axis=1).argmin()
        return float(solve_static(model).require().displacement[top, 0])
    assert lean(rods) == pytest.approx(lean(whole), rel=0.06)
    assert abs(lean(points)) < 0.02 * lean(whole)
    assert _slowest(rods) == pytest.approx(_slowest(whole), rel=0.03)
    assert abs(_slowest(points) / _slowest(whole) - 1) > 0.05
