"""Branches as likely as the fitted one: what a scan leaves open, and a mesh that follows."""

from dataclasses import replace

import numpy as np
import pytest
from tests.subjects.grown import grown

from limber.geometry.shape_samples import reshaped, sample_skeletons
from limber.geometry.skeleton.radii.axis_fit import fit_axes, fitted_system
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.tets.tetrahedra import MeshSettings, mesh_branch

NOISE = 1e-3


def _tube() -> Skeleton:
    return grown((-1, (0, 0, 0), (0, 0, 0.4), 51, 0.008))


def _scan(rng: np.random.Generator, arc: float = 2 * np.pi) -> np.ndarray:
    """3000 points all around a tube, or on the side that faces x."""
    angle, z = rng.uniform(-arc / 2, arc / 2, 3000), rng.uniform(0, 0.4, 3000)
    on = np.column_stack([0.008 * np.cos(angle), 0.008 * np.sin(angle), z])
    return on + NOISE * rng.standard_normal(on.shape)


def test_drawn_shapes_scatter_as_the_fit_says():
    """Of 300 shapes each radius has the deviation that the precision's inverse gives it."""
    points = _scan(np.random.default_rng(0))
    tube = replace(fit_axes(_tube(), points).skeleton, radius_sigma=np.zeros(51))
    drawn = sample_skeletons(tube, points, 300, np.random.default_rng(1))
    system, noise = fitted_system(tube, points)
    assert noise == pytest.approx(NOISE, rel=0.1)
    exact = noise * np.sqrt(np.diag(np.linalg.inv(system.matrix.toarray())).reshape(-1, 4)[:, 3])
    found = np.std([shape.radius - tube.radius for shape in drawn], axis=0)
    assert found == pytest.approx(exact, rel=0.2)
    moved = np.array([shape.nodes - tube.nodes for shape in drawn])
    assert np.abs(moved[..., 2]).max() < 0.1 * np.abs(moved[..., 0]).max()  # across only


@pytest.mark.parametrize("factor", [0.3, 4.0])
def test_drawn_radii_scatter_as_their_stated_deviation(factor: float) -> None:
    """Less than by the noise alone, or more; then three quarters of it are of the whole run, the
    rest of some radii, and the axis goes with it."""
    points = _scan(np.random.default_rng(0), 0.8 * np.pi)
    tube = fit_axes(_tube(), points).skeleton
    system, noise = fitted_system(tube, points)
    own = noise * np.sqrt(system.inverse_blocks(np.array([3]))[:, 0, 0])
    drawn = sample_skeletons(replace(tube, radius_sigma=factor * own), points, 400,
                             np.random.default_rng(1))
    moved = np.array([shape.radius - tube.radius for shape in drawn])
    assert np.std(moved, axis=0) == pytest.approx(factor * own, rel=0.2)
    axis = np.array([shape.nodes[25, 0] - tube.nodes[25, 0] for shape in drawn])
    if factor > 1:
        far, near = (np.corrcoef(moved[:, 10], moved[:, other])[0, 1] for other in (40, 11))
        assert far == pytest.approx(0.75 * (1 - factor**-2), abs=0.08) and near > 0.9
        assert np.corrcoef(moved[:, 25], axis)[0, 1] < -0.8


def test_twigs_are_missing_as_often_as_they_are_doubted():
    """Of 600 shapes a twig of probability 0.8 is thin in a fifth; one on it, of 0.4, in 0.6, and
    wherever its carrier is. That each fork is there takes off 2 % more."""
    tube, steps = _tube(), 0.01 * np.arange(1, 11)[:, None]
    twig = tube.nodes[25] + steps * [1.0, 0, 0]
    upper = twig[5] + steps * [0, 1.0, 0]
    tree = Skeleton.from_edges(
        np.vstack([tube.nodes, twig, upper]),
        np.concatenate([tube.parent, [25], 51 + np.arange(9), [56], 61 + np.arange(9)]),
        np.concatenate([tube.radius, np.full(20, 0.004)]))
    rng = np.random.default_rng(4)
    points = _scan(rng)
    rings = [axis + side * np.eye(3)[way] for axis, ways in ((twig, (1, 2)), (upper, (0, 2)))
             for way in ways for side in (0.004, -0.004)]
    points = np.vstack([points, *rings])
    told = replace(tree, probability=np.array([1.0, 0.784, 0.384])[tree.branch])
    drawn = sample_skeletons(told, points, 600, rng)
    ends = [members[-1] for members in told.runs()]
    thin = np.array([[np.isclose(shape.radius[end], 0.5 * told.radius[end]) for end in ends]
                     for shape in drawn])
    assert thin.mean(axis=0) == pytest.approx([0.0, 0.2, 0.6], abs=0.06)
    assert thin[thin[:, 1], 2].all()
    sure = sample_skeletons(tree, points, 20, rng)
    assert min((shape.radius / tree.radius)[:51].min() for shape in sure) > 0.6


@pytest.mark.slow
def test_new_scans_scatter_as_the_drawn_shapes_foretell():
    """12 scans with fresh noise, fitted: mean radius and axis scatter as the shapes of one do."""
    def means(shape: Skeleton) -> list[float]:
        return [shape.radius[15:35].mean(), shape.nodes[15:35, 0].mean()]

    rng = np.random.default_rng(2)
    for arc in (2 * np.pi, np.pi):
        fits = [fit_axes(_tube(), _scan(rng, arc)).skeleton for _ in range(12)]
        points = _scan(rng, arc)
        # Without stated deviations, only the noise scatters: these scans share no other error.
        tube = replace(fit_axes(_tube(), points).skeleton, radius_sigma=np.zeros(51))
        drawn = sample_skeletons(tube, points, 200, rng)
        found, foretold = (np.std([means(shape) for shape in shapes], axis=0)
                           for shapes in (fits, drawn))
        assert found == pytest.approx(foretold, rel=0.5)


def test_seen_from_one_side_thick_and_far_go_together():
    """An arc leaves open whether a branch is thick or near: the two errors cancel on its skin."""
    rng = np.random.default_rng(3)
    correlation = []
    for arc in (2 * np.pi, 0.8 * np.pi):
        points = _scan(rng, arc)
        tube = fit_axes(_tube(), points).skeleton
        drawn = sample_skeletons(tube, points, 200, rng)
        radius, axis = (np.array([values(shape) for shape in drawn]) for values in (
            lambda shape: shape.radius[25], lambda shape: shape.nodes[25, 0]))
        correlation.append(np.corrcoef(radius, axis)[0, 1])
    assert abs(correlation[0]) < 0.3 and correlation[1] < -0.7


def test_a_mesh_follows_its_skeleton():
    """Aside by 1 mm and thicker by a tenth: volume grows by 1.21, edges stay straight."""
    tube = _tube()
    mesh = mesh_branch(tube, MeshSettings(mesher="sweep")).mesh
    other = replace(tube, nodes=tube.nodes + [1e-3, 0, 0], radius=1.1 * tube.radius)
    found = reshaped(mesh, tube, other)
    assert found.volumes.sum() == pytest.approx(1.21 * mesh.volumes.sum(), rel=0.01)
    assert found.volumes.min() > 0
    middle = found.nodes[np.abs(found.nodes[:, 2] - 0.2) < 0.05].mean(axis=0)
    assert middle[:2] == pytest.approx([1e-3, 0], abs=1e-4)
    assert found.nodes[found.tets[:, 4]] == pytest.approx(
        found.nodes[found.tets[:, :2]].mean(axis=1))
    assert reshaped(mesh, tube, tube).nodes == pytest.approx(mesh.nodes, abs=1e-12)


def test_a_mesh_that_would_turn_inside_out_goes_less_far():
    """Neighbouring sections pushed through each other: every tetrahedron keeps its side."""
    tube = _tube()
    mesh = mesh_branch(tube, MeshSettings(mesher="sweep", mesh_spacing=1.3)).mesh
    nodes = tube.nodes.copy()
    nodes[24:26, 2] += np.array([0.03, -0.03])
    moved = reshaped(mesh, tube, replace(tube, nodes=nodes))
    assert moved.volumes.min() > 0
    far = np.abs(mesh.nodes[:, 2] - 0.196) > 0.05
    assert moved.nodes[far] == pytest.approx(mesh.nodes[far], abs=1e-12)
