"""The score of a tree given points, and the search for the likeliest tree of a thin scan."""

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from benchmarks.worlds.sources import NEW, bare_case, sparse_case
from limber.geometry.skeleton.alternatives import alternatives
from limber.geometry.skeleton.likeliest_tree import State, fitted, grafted, pruned, rival_tree
from limber.geometry.skeleton.likelihood_kernels import densities, falling
from limber.geometry.skeleton.path_tree import path_tree
from limber.geometry.skeleton.repair import PointSpacing
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.skeleton.skeletonise import skeletonise
from limber.geometry.skeleton.tree_likelihood import PointLikelihood


def rod(radius: float = 0.004, length: float = 0.3, nodes: int = 20) -> Skeleton:
    """A straight axis along x [m]."""
    places = np.zeros((nodes, 3))
    places[:, 0] = np.linspace(0, length, nodes)
    return Skeleton.from_edges(places, np.arange(nodes) - 1, np.full(nodes, radius))


def skin(radius: float, noise: float, count: int = 600, half: bool = False) -> np.ndarray:
    """Points on a rod of 0.3 m along x, or on its upper half, seen from above [m]."""
    rng = np.random.default_rng(0)
    angle = rng.uniform(0, 2 * np.pi, count)
    angle = np.arccos(rng.uniform(-1, 1, count)) if half else angle
    points = np.column_stack([rng.uniform(0, 0.3, count), radius * np.cos(angle),
                              radius * np.sin(angle)])
    return points + rng.normal(0, noise, points.shape)


@pytest.mark.parametrize(("facing", "sharp"), [(None, 1.0), (1, 1.0), (1, 0.2)])
@pytest.mark.parametrize(("radius", "noise"), [(0.004, 0.0005), (0.002, 0.004), (1e-6, 0.001)])
def test_the_density_across_an_axis_integrates_to_one(radius, noise, facing, sharp):
    distance, full = np.linspace(1e-6, radius + 8 * noise, 4000), np.ones(4000)
    angle = (np.arange(256 if facing else 1) + 0.5) * 2 * np.pi / 256
    total = np.mean([2 * np.pi * np.diff(distance)[0] * np.sum(distance * densities(
        distance, radius * full, (np.cos(one) if facing else np.nan) * full, full,
        np.array([noise]), 0.0, sharp)[:, 0]) for one in angle])
    assert total == pytest.approx(1.0, abs=2e-3)


@pytest.mark.parametrize("noise", [0.0005, 0.003])
def test_a_cylinder_too_thick_or_too_thin_scores_less(noise):
    scan = PointLikelihood.of(skin(0.004, noise))
    scores = [scan.score(rod(radius)) for radius in (0.002, 0.004, 0.0065)]
    assert scores[1] == max(scores)


def test_the_side_that_was_seen_scores_most():
    upper, round_ = (PointLikelihood.of(skin(0.004, 0.0005, half=half)) for half in (True, False))
    up = np.array([0.0, 0.0, 1.0])
    below = upper.seen_from(-up).score(rod())
    assert upper.seen_from(up).score(rod()) > upper.score(rod()) > below
    assert round_.where_seen(rod()).score(rod()) <= round_.score(rod())


@pytest.mark.slow
def test_the_sensor_is_found_between_the_directions_that_are_tried():
    points = Rotation.from_euler("x", 20, degrees=True).apply(skin(0.004, 0.0005, half=True))
    sight = PointLikelihood.of(points).where_seen(rod()).turned(rod()).sight
    across = sight[:, 1:].mean(axis=0)  # along the rod nothing shows it
    assert np.degrees(np.arctan2(-across[0], across[1])) == pytest.approx(20, abs=6)


def test_radii_fall_away_from_the_root_by_least_squares():
    """The nearest falling values, against a general solver on a small tree."""
    parent = np.array([-1, 0, 1, 1, 3, 4])
    value, weight = np.array([1.0, 0.5, 0.9, 2.0, 0.1, 0.4]), np.array([1.0, 2, 1, 0.5, 3, 1])
    node = np.arange(1, 6)
    known = minimize(lambda x: np.sum(weight * (x - value)**2), np.zeros(6), constraints={
        "type": "ineq", "fun": lambda x: x[parent[node]] - x[node]}).x
    assert falling(value, weight, parent) == pytest.approx(known, abs=1e-5)


@pytest.mark.parametrize("noise", [0.0004, 0.004])
def test_a_fit_finds_axis_and_radius_from_one_side(noise):
    """It starts from the middle of the points, which err along the sight, as contraction does."""
    points = skin(0.004, 0.0, half=True)
    points[:, 2] += np.random.default_rng(1).normal(0, noise, len(points))
    first = rod(0.0015).moved(rod().nodes + [0, 0, 0.0025])
    scan = PointLikelihood.of(points).seen_from(np.array([0.0, 0.0, 1.0]), sharp=0.1)
    found = fitted(first, scan, 25)
    assert np.median(found.radius) == pytest.approx(0.004, rel=0.1)
    assert np.median(found.nodes[:, 2]) == pytest.approx(0.0, abs=0.0006)


def along(skeleton: Skeleton) -> np.ndarray:
    """Places on all axes [m], 20 between two nodes."""
    share = (np.arange(20) + 0.5)[:, None, None] / 20
    return (skeleton.nodes[1:] * share + skeleton.nodes[skeleton.parent[1:]] * (1 - share)
            ).reshape(-1, 3)


@pytest.mark.slow
def test_a_thin_scan_shows_its_axes_and_hardly_changes_without_two_points():
    """700 points of a plant with 2 mm of noise and some far off. No other tree is likelier."""
    case, rng = bare_case(9102, "monopodial", "round"), np.random.default_rng(3)
    points = rng.choice(case.points, 700, replace=False) + rng.normal(0, 0.002, (700, 3))
    points[:15] += rng.normal(0, 0.02, (15, 3))
    truth = case.truth
    results = [skeletonise(some, root=truth.nodes[0]) for some in (
        points, np.delete(points, [40, 300], axis=0))]
    for one, doubts in ((result.skeleton, result.doubts) for result in results):
        used, *others = alternatives(one, doubts)
        assert others and all(0 < other.probability <= used.probability for other in others)
        assert (cKDTree(along(one)).query(along(truth))[0] < 0.01).mean() > 0.85
        assert (cKDTree(along(truth)).query(along(one))[0] < 0.01).mean() > 0.95
    assert results[0].skeleton.length == pytest.approx(results[1].skeleton.length, rel=0.05)


def test_a_twig_that_no_point_shows_is_left_out():
    seen = skin(0.004, 0.0005)
    nodes = np.vstack([rod().nodes, [[0.15, 0.0, 0.02], [0.15, 0.0, 0.05]]])
    first = Skeleton.from_edges(nodes, [*rod().parent, 10, 20], np.full(22, 0.004))
    assert pruned(State.of(first, PointLikelihood.of(seen))).skeleton.branch_count == 1


@pytest.mark.slow
@pytest.mark.parametrize(("count", "noise", "is_sure"), [(60, 0.001, True), (30, 0.003, False)])
def test_points_that_nothing_explains_become_a_twig(count, noise, is_sure):
    """Whether a faint one is a twig hangs on what a twig must explain: the length is less sure."""
    rng = np.random.default_rng(1)
    twig = np.column_stack([np.full(count, 0.15), np.zeros(count), rng.uniform(0.005, 0.08, count)])
    points = np.vstack([skin(0.004, 0.0005), twig + rng.normal(0, noise, twig.shape)])
    found, _, _, spread = rival_tree(rod(), points)
    assert found.branch_count == 1 + is_sure and (spread < 0.09) is is_sure
    assert found.length == pytest.approx(0.38 if is_sure else 0.3, rel=0.05)


def test_paths_lead_along_twigs_that_are_added():
    """To the ends of two twigs side by side, 20 mm apart, from one stem."""
    rng, across = np.random.default_rng(4), np.repeat([0.15, 0.17], 80)
    twigs = np.column_stack([across, rng.uniform(0.005, 0.12, 160), 0 * across])
    points = np.vstack([skin(0.003, 0.0005, 300), twigs + rng.normal(0, 0.001, (160, 3))])
    paths = path_tree(points, np.zeros(3), PointSpacing.of(points))
    for tree in (paths, grafted(State.of(rod(), PointLikelihood.of(points)), paths).skeleton):
        ends = cKDTree(tree.nodes[tree.tips()])
        assert ends.query([[0.15, 0.12, 0.0], [0.17, 0.12, 0.0]])[0].max() < 0.01


@pytest.mark.slow
def test_a_thin_scan_of_many_twigs_is_not_taken_for_leaves():
    """Half of its axes were missing: leaves were likelier than the fit, not than the search."""
    case = sparse_case(7309002, NEW, "round")
    assert not skeletonise(case.points[~case.leaf], up=np.array(case.settings["up"])).leafy
