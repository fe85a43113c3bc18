"""Kinks that wood does not make are mended, and bends that it makes stay."""

import itertools

import numpy as np
import pytest

from limber.geometry.skeleton.confidence import KINK, DoubtfulKind, doubtful_parts, turns
from limber.geometry.skeleton.repair import without_kinks
from limber.geometry.skeleton.skeleton import Skeleton


def _run(*corners) -> Skeleton:
    """A run of 5 mm radius and node distance along straight lines between corners [m]."""
    parts = [np.linspace(a, b, int(np.linalg.norm(np.subtract(b, a)) / 0.005), endpoint=False)
             for a, b in itertools.pairwise(corners)]
    nodes = np.vstack([*parts, corners[-1]]).astype(float)
    return Skeleton.from_edges(nodes, np.arange(len(nodes)) - 1, np.full(len(nodes), 0.005))


def test_an_end_that_folds_back_goes() -> None:
    """The run ends where it turned; the rest stays as it was."""
    run = _run((0, 0, 0), (0, 0, 0.3), (0.012, 0, 0.27))
    assert any(part.kind is DoubtfulKind.kink for part in doubtful_parts(run))
    mended, count = without_kinks(run)
    assert count == 1 and mended.nodes[-1, 2] == pytest.approx(0.3, abs=0.006)
    assert (mended.nodes == run.nodes[:mended.node_count]).all()
    assert not any(part.kind is DoubtfulKind.kink for part in doubtful_parts(mended))


def test_an_end_that_folds_twice_goes_whole() -> None:
    """A zigzag at the tip is cut back until nothing folds."""
    run = _run((0, 0, 0), (0, 0, 0.3), (0.012, 0, 0.27), (0.02, 0, 0.3))
    mended, count = without_kinks(run)
    assert count >= 1 and mended.nodes[-1, 2] == pytest.approx(0.3, abs=0.006)
    assert turns(mended, mended.runs()[0]).max() <= KINK


def test_a_kink_inside_is_rounded() -> None:
    """A right angle far from the tip becomes a bend; its ends and what it carries stay."""
    run = _run((0, 0, 0), (0, 0, 0.2), (0.2, 0, 0.18))
    mended, count = without_kinks(run)
    assert count == 1 and mended.node_count == run.node_count
    assert turns(mended, mended.runs()[0]).max() <= KINK
    moved = np.linalg.norm(mended.nodes - run.nodes, axis=1)
    assert 0 < moved.max() < 0.015
    assert (moved[[0, 5, -5, -1]] == 0).all()


def test_a_bend_stays() -> None:
    """Sixty degrees at once are left alone."""
    run = _run((0, 0, 0), (0, 0, 0.2), (0.2 * np.sin(1.0), 0, 0.2 + 0.2 * np.cos(1.0)))
    mended, count = without_kinks(run)
    assert count == 0 and (mended.nodes == run.nodes).all()
