"""Sparse crowns and leaves: axes from the scan's own connectivity."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from benchmarks.geometry_crowns import axis_scores, explained, generated_crown
from limber.geometry.generated import generate_branch
from limber.geometry.skeleton.contraction.laplacian_contraction import contract
from limber.geometry.skeleton.contraction.level_sets import is_sparse, level_graph
from limber.geometry.skeleton.skeletonise import skeletonise

_UP = np.array([0.0, 0.0, 1.0])


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


def test_sparse_scans_are_told_from_others() -> None:
    """A well scanned branch is contracted as ever; a crown whose twigs are lines is not."""
    branch = generate_branch(31).cloud.points
    _, crown = generated_crown(31, 4.0, 0.05, 0.02, 0.003)
    assert not is_sparse(branch, contract(branch).drawn)
    assert is_sparse(crown, contract(crown).drawn)


@pytest.mark.slow
def test_crown_of_thin_twigs_is_found() -> None:
    """Most of a sparse crown's axes are found, and most of what is found is true."""
    truth, points = generated_crown(31, 4.0, 0.05, 0.02, 0.003)
    found = skeletonise(points, root=truth.nodes[0]).skeleton
    score = axis_scores(truth, found, 0.02)
    assert score["recall"] > 0.75 and score["precision"] > 0.8
    assert explained(points, found) > 0.95


def test_axes_follow_curved_leaves() -> None:
    """A leaf's axis runs along its midrib to its end, and the stem's stays in the stem."""
    rng = np.random.default_rng(3)
    turn, height = rng.uniform(0, 2 * np.pi, 3000), rng.uniform(0, 0.06, 3000)
    stem = np.stack([0.0015 * np.cos(turn), 0.0015 * np.sin(turn), height], axis=1)
    parts, ribs = [stem], []
    for side in (-1.0, 1.0):
        share, across = rng.uniform(0, 1, 9000), rng.uniform(-1, 1, 9000)
        width = 0.001 + 0.009 * np.sin(np.pi * share)**0.7
        rib = _rib(side, np.linspace(0, 1, 50))
        ribs.append(rib)
        leaf = _rib(side, share)
        leaf[:, 1] += across * width
        parts.append(leaf)
    points = np.vstack(parts) + rng.normal(0, 1e-4, (21_000, 3))
    found = skeletonise(points, root=np.zeros(3)).skeleton
    distance = cKDTree(np.vstack([found.nodes, _middles(found)])).query(np.vstack(ribs))[0]
    assert distance.mean() < 0.0015 and distance.max() < 0.005
    low = found.nodes[(found.nodes[:, 2] > 0.005) & (found.nodes[:, 2] < 0.05)]
    assert np.hypot(low[:, 0], low[:, 1]).max() < 0.0015
    assert found.radius.max() < 0.004


def _rib(side: float, share: np.ndarray) -> np.ndarray:
    angle = 2.2 * share
    return np.stack([side * 0.03 * np.sin(angle / 1.2), 0 * share,
                     0.06 + 0.02 * np.sin(1.3 * angle)], axis=1)


def _middles(skeleton) -> np.ndarray:
    return (skeleton.nodes[1:] + skeleton.nodes[skeleton.parent[1:]]) / 2
