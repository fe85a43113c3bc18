"""A twig that starts backwards is led straight back to where its own line meets its carrier."""

import numpy as np
import pytest

from limber.geometry.skeleton.repair.backward_twigs import without_backward_starts
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.skeleton.uncertain_parts import start_angle


def _forked(at: int, hook: bool) -> Skeleton:
    """A stem of 5 mm radius along z, 0.2 m; a twig at 45 degrees whose line leaves it at 0.08 m.

    With a ``hook`` it hangs on the stem's node ``at`` by two nodes aside.
    """
    z = 0.004 * np.arange(51)
    stem = np.column_stack([0 * z, 0 * z, z])
    along = np.arange(0.018, 0.09, 0.003)[:, None]
    twig = [0, 0, 0.08] + along * np.array([1.0, 0, 1.0]) / np.sqrt(2)
    start = 0.5 * (stem[at] + twig[0])[None] if hook else np.empty((0, 3))
    nodes = np.vstack([stem, start, twig])
    parent = np.concatenate([np.arange(51) - 1, [at], 50 + np.arange(1, len(nodes) - 51)])
    return Skeleton.from_edges(nodes, parent, np.where(np.arange(len(nodes)) < 51, 0.005, 0.003))


def test_a_twig_hung_too_far_out_is_led_back() -> None:
    """Hung at 0.1 m by a way that comes back: its fork is at 0.08 m then."""
    wrong = _forked(26, True)
    assert start_angle(wrong, wrong.runs()[1]) > np.deg2rad(80)
    right, count = without_backward_starts(wrong)
    fork = right.forks()
    assert count == 1 and len(fork) == 1
    assert right.nodes[fork[0], 2] == pytest.approx(0.08, abs=0.005)
    assert start_angle(right, right.runs()[1]) < np.deg2rad(60)
    assert right.tips().shape == wrong.tips().shape


def test_twigs_that_start_forwards_or_meet_nothing_stay() -> None:
    """A straight twig is left as it is, and so is one whose own line passes its carrier by."""
    straight = _forked(20, False)
    assert without_backward_starts(straight)[1] == 0
    wrong = _forked(26, True)
    aside = wrong.nodes + np.where((wrong.branch == 1)[:, None], [0, 0.02, 0], 0)
    assert without_backward_starts(wrong.moved(aside))[1] == 0
