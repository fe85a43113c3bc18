"""Feet of side branches: followed down where the points show two limbs."""

import numpy as np
import pytest

from limber.geometry.skeleton.fused_limbs import separate_fused_forks
from limber.geometry.skeleton.skeleton import Skeleton

_NOISE = 3e-4


def _tube(start: np.ndarray, end: np.ndarray, radius: float, rng: np.random.Generator,
          arc: float = 2 * np.pi) -> np.ndarray:
    """Points on a tube, all around or on the side that faces -y."""
    length = float(np.linalg.norm(end - start))
    way = (end - start) / length
    one = np.cross(way, [0, 1.0, 0])
    one /= np.linalg.norm(one)
    count = int(length * radius * arc / 0.0015**2)
    angle = -np.pi / 2 + rng.uniform(-arc / 2, arc / 2, count)
    around = np.cos(angle)[:, None] * one + np.sin(angle)[:, None] * np.cross(way, one)
    around *= np.sign(np.cross(way, one)[1])
    return start + rng.uniform(0, length, count)[:, None] * way + radius * around


def two_limbs(arc: float = 2 * np.pi, fork: float = 0.1) -> np.ndarray:
    """A stem of 8 mm along z, and a limb of 6 mm that leaves it at 9 degrees at ``fork``."""
    rng = np.random.default_rng(0)
    base, leaning = np.array([0, 0, fork]), np.array([np.sin(0.16), 0, np.cos(0.16)])
    stem = _tube(np.zeros(3), np.array([0, 0, 0.4]), 0.008, rng, arc)
    limb = _tube(base, base + 0.3 * leaning, 0.006, rng, arc)
    inside = np.linalg.norm(limb[:, :2], axis=1) < 0.008
    along = (stem - base) @ leaning
    away = np.linalg.norm(stem - base - along[:, None] * leaning, axis=1)
    points = np.vstack([stem[(away > 0.006) | (along < 0)], limb[~inside]])
    return points + _NOISE * rng.standard_normal(points.shape)


def two_in_one(fork: float, true: float = 0.1) -> Skeleton:
    """The limb leaves at ``fork``: below, one axis is in the middle of both."""
    z = np.arange(0, 0.4, 0.004)
    aside = np.clip(z - true, 0, None) * np.tan(0.16)
    stem = np.column_stack([np.where(z <= fork, aside / 2, 0.0), 0 * z, z])
    above = z[z > fork]
    limb = np.column_stack([(above - true) * np.tan(0.16), 0 * above, above])
    at = int(np.argmin(np.abs(z - fork)))
    parent = np.r_[np.arange(len(z)) - 1, at, len(z) + np.arange(len(limb) - 1)]
    radius = np.r_[np.where(z <= fork, 0.008 + aside / 2, 0.008), np.full(len(limb), 0.006)]
    return Skeleton.from_edges(np.vstack([stem, limb]), parent, radius)


@pytest.mark.parametrize("arc", [2 * np.pi, np.pi])
def test_fused_limbs_get_a_fork_where_they_meet(arc: float) -> None:
    """Found 100 mm too high; no lower than the fork, and both axes within 1.5 mm."""
    skeleton, count = separate_fused_forks(two_in_one(0.2), two_limbs(arc), _NOISE)
    assert count == 1
    fork = float(skeleton.nodes[skeleton.forks()[0], 2])
    assert 0.1 <= fork < 0.165
    stem, limb = sorted((skeleton.nodes[run] for run in skeleton.runs()),
                        key=lambda nodes: nodes[-1, 0])
    stem, limb = (nodes[nodes[:, 2] > fork + 0.005] for nodes in (stem, limb))
    assert np.abs(stem[:, 0]).max() < 0.0015
    assert np.abs(limb[:, 0] - (limb[:, 2] - 0.1) * np.tan(0.16)).max() < 0.0015


def test_a_right_fork_and_an_oval_stem_stay() -> None:
    """One limb below the fork, and a section 1.3 times as wide as deep, show no second limb."""
    assert separate_fused_forks(two_in_one(0.13), two_limbs(), _NOISE)[1] == 0
    rng, z = np.random.default_rng(1), np.arange(0, 0.4, 0.004)
    stem = _tube(np.zeros(3), np.array([0, 0, 0.4]), 0.008, rng) * [1.3, 1, 1]
    twig = _tube(np.array([0, 0, 0.2]), np.array([0.1, 0, 0.2]), 0.003, rng)
    x = np.arange(0.004, 0.1, 0.004)
    nodes = np.vstack([np.outer(z, [0, 0, 1]), np.outer(x, [1, 0, 0]) + [0, 0, 0.2]])
    parent = np.r_[np.arange(len(z)) - 1, 50, len(z) + np.arange(len(x) - 1)]
    plain = Skeleton.from_edges(nodes, parent, np.repeat([0.009, 0.003], [len(z), len(x)]))
    points = np.vstack([stem, twig[twig[:, 0] > 0.01]])
    noisy = points + _NOISE * rng.standard_normal(points.shape)
    assert separate_fused_forks(plain, noisy, _NOISE)[1] == 0
