"""Sparse crowns and leaves: axes from the scan's own connectivity."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from tests.subjects.leafy import curved_leaves

from benchmarks.real_scans import present, raw_scan
from benchmarks.scan_scores import explained, score
from benchmarks.worlds.plants import weber_penn
from limber.geometry.cloud.preparation import prepare
from limber.geometry.generated import BranchSpec, generate_branch, scan
from limber.geometry.skeleton.contraction import contract, is_sparse, level_graph
from limber.geometry.skeleton.radii.axis_fit import NormalEquations
from limber.geometry.skeleton.search_result import SkeletonResult
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.skeleton.skeletonise import skeletonise

_UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def leaves() -> tuple[np.ndarray, np.ndarray]:
    """Points of two leaves on a stem, and places along their midribs; few, but leafy as any."""
    return curved_leaves(2800)


@pytest.fixture(scope="module")
def of_leaves(leaves) -> SkeletonResult:
    return skeletonise(leaves[0], root=np.zeros(3))


@pytest.fixture(scope="module")
def crown() -> tuple[Skeleton, np.ndarray]:
    """True axes of a sparse crown, and its points."""
    rng = np.random.default_rng(31)
    truth = weber_penn(rng).skeleton
    return truth, scan(truth, BranchSpec(noise=0.0015, point_spacing=0.0075), rng).points


def test_levels_keep_near_twigs_apart() -> None:
    """Two lines of points that start at one place and run side by side stay two branches."""
    along = np.linspace(0, 1, 120)
    twig = np.stack([0 * along, 0 * along, along], axis=1)
    aside = np.stack([0.06 * np.minimum(4 * along, 1), 0 * along, along], axis=1)
    points = np.vstack([twig, aside[2:]]) + np.random.default_rng(0).normal(0, 5e-4, (238, 3))
    graph = level_graph(points, np.zeros(3), gap_factor=3.0, bridge_limit=0.1, up=_UP)
    high = graph.nodes[np.abs(graph.nodes[:, 2] - 0.7) < 0.1, 0]
    assert (high < 0.01).any() and (high > 0.05).any()
    assert not ((high > 0.015) & (high < 0.045)).any()
    assert len(graph.edges) == len(graph.nodes) - 1


def test_pieces_are_bridged_to_one_tree() -> None:
    """A twig behind a gap is reached from the nearest place, and the gap is reported."""
    along = np.concatenate([np.arange(0, 0.5, 0.01), np.arange(0.75, 1.2, 0.01)])
    points = np.stack([0 * along, 0 * along, along], axis=1)
    graph = level_graph(points, np.zeros(3), gap_factor=1.5, bridge_limit=0.4, up=_UP)
    assert len(graph.edges) == len(graph.nodes) - 1
    assert len(graph.bridges) == 1 and (graph.owner >= 0).all()


@pytest.mark.slow
def test_sparse_scans_are_told_from_others(crown) -> None:
    """A well scanned branch is contracted as ever; a crown whose twigs are lines is not."""
    branch = generate_branch(31, length=0.4, point_spacing=0.003).cloud.points
    assert not is_sparse(branch, contract(branch).points)
    assert is_sparse(crown[1], contract(crown[1]).points)


@pytest.mark.slow
def test_crown_of_thin_twigs_is_found(crown) -> None:
    """Most of a sparse crown's axes are found, and most of what is found is true."""
    truth, points = crown
    found = skeletonise(points, root=truth.nodes[0]).skeleton
    scored = score(truth, found)
    assert scored["recall"] > 0.75 and scored["right"] > 0.8
    assert explained(points, found) > 0.95


@pytest.mark.slow
def test_axes_follow_curved_leaves(leaves, of_leaves) -> None:
    """A leaf's axis runs along its midrib to its end, and the stem's stays in the stem."""
    ribs, found = leaves[1], of_leaves.skeleton
    distance = cKDTree(np.vstack([found.nodes, _middles(found)])).query(ribs)[0]
    assert distance.mean() < 0.0015 and distance.max() < 0.005
    low = found.nodes[(found.nodes[:, 2] > 0.005) & (found.nodes[:, 2] < 0.05)]
    assert np.hypot(low[:, 0], low[:, 1]).max() < 0.0015
    assert found.radius.max() < 0.004


@pytest.mark.slow
@pytest.mark.skipif(not present(("tree",)), reason="needs the real scans beside the checkout")
def test_a_real_bare_tree_is_not_in_leaf() -> None:
    """Its points are likelier about thin axes than about the cylinders that were fitted, but their
    surroundings are those of wood: 128 of 317 m were found where it was taken for leafy."""
    found = skeletonise(prepare(raw_scan("tree")[0], 1.0).cloud.points)
    assert not found.leafy and 290 < found.skeleton.length < 350


@pytest.mark.slow
def test_last_digits_of_a_solve_do_not_choose_the_skeleton(monkeypatch, leaves, of_leaves) -> None:
    """Errors as large as libraries' rounding, in each round of the fit: the same to the last bit.

    Where leaves lead the fit astray they had grown to other cylinders, and to other branches.
    """
    solve, rng = NormalEquations.solve, np.random.default_rng(0)

    def rounded(system):
        step = solve(system)
        return step + 1e-15 * np.abs(step).max() * rng.standard_normal(step.shape)

    monkeypatch.setattr(NormalEquations, "solve", rounded)
    found = skeletonise(leaves[0], root=np.zeros(3))
    assert found.noise == of_leaves.noise
    assert found.residual.tobytes() == of_leaves.residual.tobytes()
    assert found.skeleton.nodes.tobytes() == of_leaves.skeleton.nodes.tobytes()


@pytest.mark.slow
def test_a_shuffled_leafy_scan_has_the_same_skeleton(leaves, of_leaves) -> None:
    """Points in another order: the same axes to the last bit."""
    points, first = leaves[0], of_leaves.skeleton
    order = np.random.default_rng(5).permutation(len(points))
    again = skeletonise(points[order], root=np.zeros(3)).skeleton
    assert np.array_equal(first.parent, again.parent)
    assert np.abs(first.nodes - again.nodes).max() < 1e-9


def _middles(skeleton) -> np.ndarray:
    return (skeleton.nodes[1:] + skeleton.nodes[skeleton.parent[1:]]) / 2


def test_thin_leaves_are_no_fat_cylinders(tomato_draws) -> None:
    """A seedling whose curated axes are 79 mm long: a fit made cylinders, and a search twigs of it.
    """
    found = skeletonise(1e-3 * tomato_draws[0][:900])
    assert found.leafy and found.skeleton.length == pytest.approx(0.079, rel=0.12)
