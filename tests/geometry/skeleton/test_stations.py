"""Stations of a merged scan that are registered a little apart."""

import numpy as np
from tests.subjects.stations import EYES, RADIUS, merged

from limber.geometry.skeleton.radii.axis_fit import fit_axes
from limber.geometry.skeleton.radii.stations import registered


def test_points_without_a_shift_stay() -> None:
    tree, points = merged(np.zeros((3, 3)), EYES)
    fit = fit_axes(tree, points)
    assert registered(fit.skeleton, points, fit.noise) is None


def test_intervals_hold_where_two_stations_face_each_other() -> None:
    """Shifted inwards they show what an oval section does, and points do not tell which."""
    eyes = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    tree, points = merged(-8e-4 * eyes, eyes)
    first = fit_axes(tree, points)
    found = registered(first.skeleton, points, first.noise)
    assert found is not None
    after = fit_axes(first.skeleton, found[0], settled=True).skeleton.radius
    assert abs(np.median(after) - RADIUS) < 2 * found[1]
