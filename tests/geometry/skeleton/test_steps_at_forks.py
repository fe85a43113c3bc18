"""A carrier's radius falls in a step at a fork; a fit that smooths it is corrected."""

import numpy as np

from limber.geometry.skeleton.radii.axis_fit import fit_axes, fit_with_steps
from limber.geometry.skeleton.skeleton import Skeleton

_BELOW, _ABOVE, _TWIG, _NOISE = 0.008, 0.006, 0.0055, 0.0003


def _tube(start: np.ndarray, end: np.ndarray, radius: float, rng: np.random.Generator,
          ) -> np.ndarray:
    axis = (end - start) / np.linalg.norm(end - start)
    side = np.cross(axis, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    count = int(np.linalg.norm(end - start) * 2 * np.pi * radius / 0.0012**2)
    angle, along = rng.uniform(0, 2 * np.pi, count), rng.uniform(0, 1, count)
    return (start + along[:, None] * (end - start) + radius * (
        np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * np.cross(axis, side))
        + rng.normal(0, _NOISE, (count, 3)))


def _forked() -> tuple[Skeleton, np.ndarray]:
    """A stem of 0.3 m with a step of its radius at a twig in its middle, and points on both."""
    rng, top = np.random.default_rng(0), np.array([0.0, 0.0, 0.15])
    tip = top + [0.1, 0.0, 0.05]
    points = np.vstack([_tube(np.zeros(3), top, _BELOW, rng),
                        _tube(top, 2 * top, _ABOVE, rng), _tube(top, tip, _TWIG, rng)])
    points = points[~((np.hypot(*points[:, :2].T) < _BELOW - 0.001) & (points[:, 2] < 0.15))]
    stem, twig = np.linspace(0, 0.3, 41), np.linspace(0, 1, 16)[1:, None]
    nodes = np.vstack([np.stack([0 * stem, 0 * stem, stem], axis=1), top + twig * (tip - top)])
    parent = np.r_[np.arange(41) - 1, 20, 41 + np.arange(14)]
    radius = np.r_[np.full(41, 0.007), np.full(15, _TWIG)]
    return Skeleton.from_edges(nodes, parent, radius), points


def test_a_radius_beside_a_fork_is_right_after_steps() -> None:
    """Within two radii beyond the fork, where a smooth fit is too thick."""
    start, points = _forked()
    smooth = fit_axes(start, points, rounds=20).skeleton
    stepped, covariance = fit_with_steps(smooth, points)
    beyond = (smooth.branch == 0) & (smooth.nodes[:, 2] > 0.152) & (smooth.nodes[:, 2] < 0.164)
    before, after = (np.abs(fit.radius[beyond] - _ABOVE).max() for fit in (smooth, stepped))
    assert before > 0.0004
    assert after < 0.5 * before
    far = (smooth.nodes[:, 2] < 0.1) | (smooth.nodes[:, 2] > 0.22)
    assert np.abs(stepped.radius - smooth.radius)[far].max() < 1e-4
    assert (np.linalg.eigvalsh(covariance) > 0).all()
