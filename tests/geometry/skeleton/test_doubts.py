"""Doubtful parts: each kind is found where it was made, and a sound skeleton has none."""

from dataclasses import replace

import numpy as np
import pytest

from limber.geometry.skeleton.confidence import DoubtfulKind, doubtful_parts
from limber.geometry.skeleton.skeleton import BRIDGED, LIMITED, UNRESOLVED, Skeleton


def test_a_sound_skeleton_has_no_doubtful_parts(y_skeleton) -> None:
    """A fork of 37 degrees is no kink."""
    assert doubtful_parts(y_skeleton) == []


def test_each_doubt_is_found_with_its_place(y_skeleton) -> None:
    """An unlikely twig, an unresolved and a limited stretch, a gap: length, radius and value."""
    state = y_skeleton.radius_state.copy()
    state[1:3], state[3:6], state[8:10] = LIMITED, BRIDGED, UNRESOLVED
    sigma = np.where(state == UNRESOLVED, 0.4 * y_skeleton.radius, 0.0)
    told = doubtful_parts(replace(
        y_skeleton, radius_state=state, radius_sigma=sigma,
        probability=np.where(y_skeleton.branch == 1, 0.3, 1.0)))
    assert [uncertainty.kind for uncertainty in told] == [
        DoubtfulKind.unlikely, DoubtfulKind.unresolved, DoubtfulKind.limited,
        DoubtfulKind.bridged]
    unlikely, unresolved, limited, bridged = told
    assert unlikely.branch == 1 and unlikely.value == pytest.approx(0.3)
    assert unresolved.length == pytest.approx(0.1) and unresolved.value == pytest.approx(0.4)
    assert limited.length == pytest.approx(0.1) and limited.branch == 0
    assert bridged.length == pytest.approx(0.15)
    np.testing.assert_allclose(bridged.at, y_skeleton.nodes[4])


def test_a_radius_jump_is_found_where_no_fork_explains_it() -> None:
    """Half as thick within four radii; the same beside a fork with a twig is no jump."""
    z = np.arange(0, 0.4, 0.004)
    nodes = np.outer(z, [0, 0, 1.0])
    radius = np.where(z < 0.2, 0.01, 0.0055)
    told = doubtful_parts(Skeleton.from_edges(nodes, np.arange(-1, 99), radius))
    assert [part.kind for part in told] == [DoubtfulKind.jump]
    assert told[0].value == pytest.approx(0.55) and abs(told[0].at[2] - 0.2) < 0.01
    twig = np.outer(np.arange(0.004, 0.1, 0.004), [1.0, 0, 0]) + [0, 0, 0.2]
    forked = Skeleton.from_edges(np.vstack([nodes, twig]), np.r_[
        np.arange(-1, 99), 50, 100 + np.arange(len(twig) - 1)], np.r_[
            radius, np.full(len(twig), 0.004)])
    assert doubtful_parts(forked) == []


def test_kinks_and_backward_starts_are_found() -> None:
    """A stem that turns by 90 degrees, and a twig that starts down along it."""
    z, x = np.linspace(0, 0.2, 21), np.linspace(0.01, 0.2, 20)
    stem = np.vstack([np.stack([0 * z, 0 * z, z], axis=1), np.stack([x, 0 * x, 0 * x + 0.2], 1)])
    down = np.stack([0 * z[1:6], 0.004 + 0 * z[1:6], 0.1 - z[1:6]], axis=1)
    skeleton = Skeleton.from_edges(
        np.vstack([stem, down]), np.concatenate([np.arange(41) - 1, [10], 41 + np.arange(4)]),
        np.full(46, 0.006))
    told = {uncertainty.kind: uncertainty for uncertainty in doubtful_parts(skeleton)}
    assert set(told) == {DoubtfulKind.kink, DoubtfulKind.backwards}
    np.testing.assert_allclose(told[DoubtfulKind.kink].at, [0, 0, 0.2], atol=1e-9)
    assert told[DoubtfulKind.kink].value == pytest.approx(np.pi / 2, abs=0.01)
    assert told[DoubtfulKind.backwards].value > np.deg2rad(150)
