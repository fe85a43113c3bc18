"""Stations of a merged scan that are registered a little apart."""

import numpy as np

from limber.geometry.skeleton.radii.axis_fit import fit_axes
from limber.geometry.skeleton.radii.stations import registered
from limber.geometry.skeleton.skeleton import Skeleton

_EYES = np.array([[1.0, 0.2, 0.3], [-0.6, 0.9, 0.0], [-0.4, -0.8, -0.2]])
_SHIFTS = np.array([[-1e-3, 0.3e-3, 0.2e-3], [0.8e-3, -0.9e-3, 0.5e-3], [0.5e-3, 1e-3, -0.8e-3]])
_RADIUS = 0.004


def _merged(shifts: np.ndarray, eyes: np.ndarray) -> tuple[Skeleton, np.ndarray]:
    """A stem with a side branch, of one radius, and points [m] of rays that are evenly spaced."""
    rng = np.random.default_rng(5)
    stem = np.column_stack([np.zeros((76, 2)), np.linspace(0, 0.3, 76)])
    side = stem[40] + np.linspace(0.004, 0.15, 38)[:, None] * np.array([0.8, 0.1, 0.6])
    tree = Skeleton.from_edges(np.vstack([stem, side]), np.r_[-1:75, 40, 76:113],
                               np.full(114, _RADIUS))
    points = []
    for eye, shift in zip(eyes, shifts, strict=True):
        node = rng.integers(1, tree.node_count, 1300)
        start = tree.nodes[tree.parent[node]]
        axis = tree.axes()[node]
        foot = start + rng.uniform(size=(1300, 1)) * (tree.nodes[node] - start)
        sight = eye / np.linalg.norm(eye)
        along = sight - (axis @ sight)[:, None] * axis
        along /= np.linalg.norm(along, axis=1)[:, None]
        beside = rng.uniform(-1, 1, 1300)
        skin = foot + _RADIUS * (beside[:, None] * np.cross(axis, along)
                                 + np.sqrt(1 - beside**2)[:, None] * along)
        points.append(skin + rng.normal(0, 4e-4, (1300, 1)) * sight + shift)
    return tree, np.vstack(points)


def test_radii_are_right_where_stations_are_a_millimetre_apart() -> None:
    tree, points = _merged(_SHIFTS, _EYES)
    first = fit_axes(tree, points)
    bias = np.median(first.skeleton.radius) / _RADIUS - 1
    found = registered(first.skeleton, points, first.noise)
    assert abs(bias) > 0.08 and found is not None
    after = fit_axes(first.skeleton, found[0], settled=True)
    off = float(np.median(after.skeleton.radius)) - _RADIUS
    assert abs(off) < 0.04 * _RADIUS and abs(off) < 2 * found[1] < 0.15 * _RADIUS
    assert after.noise < 0.7 * first.noise


def test_points_without_a_shift_stay() -> None:
    tree, points = _merged(np.zeros((3, 3)), _EYES)
    fit = fit_axes(tree, points)
    assert registered(fit.skeleton, points, fit.noise) is None


def test_intervals_hold_where_two_stations_face_each_other() -> None:
    """Shifted inwards they show what an oval section does, and points do not tell which."""
    eyes = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    tree, points = _merged(-8e-4 * eyes, eyes)
    first = fit_axes(tree, points)
    found = registered(first.skeleton, points, first.noise)
    assert found is not None
    after = fit_axes(first.skeleton, found[0], settled=True).skeleton.radius
    assert abs(np.median(after) - _RADIUS) < 2 * found[1]
