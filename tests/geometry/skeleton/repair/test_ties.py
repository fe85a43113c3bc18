"""Ends that a scan's holes tie together sideways are cut apart; twigs and bends stay."""

import numpy as np

from limber.geometry.skeleton.repair import untied


def _chain(points: np.ndarray, first: int = 0) -> np.ndarray:
    index = first + np.arange(len(points))
    return np.stack([index[:-1], index[1:]], axis=1)


def test_two_ends_side_by_side_are_cut_apart() -> None:
    """Up one limb, 12 mm across, and down the other: the long step across goes, nothing else."""
    z = np.linspace(0, 0.06, 13)
    left, right = np.column_stack([0 * z, 0 * z, z]), np.column_stack([0.012 + 0.2 * z, 0 * z, z])
    nodes = np.vstack([left, right])
    edges = np.vstack([_chain(left), _chain(right, 13), [[12, 25]]])
    kept = untied(nodes, edges, np.full(26, 0.005))
    assert len(kept) == 24 and [12, 25] not in kept.tolist()


def test_a_hook_at_an_end_is_cut_off() -> None:
    """Two nodes of a twig, a step of 22 mm aside from the end of a limb of 10 mm."""
    z = np.linspace(0, 0.1, 13)
    limb = np.column_stack([0 * z, 0 * z, z])
    stub = np.array([[0.022, 0, 0.1], [0.026, 0, 0.104]])
    edges = np.vstack([_chain(limb), [[12, 13], [13, 14]]])
    kept = untied(np.vstack([limb, stub]), edges, np.full(15, 0.01))
    assert [12, 13] not in kept.tolist() and len(kept) == 13


def test_twigs_bends_and_ends_stay() -> None:
    """A twig at a right angle, a limb that bends by a right angle, and a small hook."""
    z = np.linspace(0, 0.1, 26)
    limb = np.column_stack([0 * z, 0 * z, z])
    twig = np.array([[0.006 + 0.004 * k, 0, 0.05] for k in range(10)])
    turn = np.linspace(0, np.pi / 2, 12)[1:]
    bend = limb[-1] + 0.03 * np.column_stack([1 - np.cos(turn), 0 * turn, np.sin(turn)])
    hook = bend[-1] + np.array([[0.002, 0.002, 0.0], [0.002, 0.004, 0.0]])
    nodes = np.vstack([limb, bend, hook, twig])
    edges = np.vstack([_chain(nodes[:39]), _chain(twig, 39), [[12, 39]]])
    assert len(untied(nodes, edges, np.full(len(nodes), 0.005))) == len(edges)
