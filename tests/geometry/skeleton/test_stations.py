"""Stations of a merged scan that are registered a little apart."""

import numpy as np
from tests.subjects.stations import EYES, RADIUS, merged

from limber.geometry.skeleton.radii.axis_fit import fit_axes
from limber.geometry.skeleton.radii.stations import registered, station_sums
from limber.geometry.skeleton.radii.visible_sides import flatness


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


def test_sums_over_points_are_those_of_whole_arrays() -> None:
    """The mixture's plain form: all points, stations and places of a side at once."""
    rng = np.random.default_rng(7)
    count, stations, turn = 40, 3, 2.4 * np.arange(40)  # all 45 degrees or more off a sight
    axis = np.column_stack([np.cos(turn), np.sin(turn), np.ones(count)]) / np.sqrt(2)
    towards = np.array([[1.0, 0.0, 0.0], [-0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    radius, offset = rng.uniform(2e-3, 8e-3, count), 5e-3 * rng.normal(size=(count, 3))
    shift, share = 1e-4 * rng.normal(size=(stations, 3)), np.array([0.5, 0.3, 0.2])
    noise, wider, fit = np.array([5e-4, 9e-4]), 1e-4, 1e-3
    beside = np.arange(-15, 16, 2) / 16
    rise = np.sqrt(1 - beside**2)
    along = towards - (axis @ towards.T)[:, :, None] * axis[:, None]
    along /= np.linalg.norm(along, axis=2)[:, :, None]
    ways = np.stack([np.cross(axis[:, None], along), along])
    miss = np.einsum("dikj,ikj->dik", ways, offset[:, None] - shift)
    places, thick = np.stack([beside, rise]), np.maximum(radius + wider, 0.1 * radius)
    off = miss[..., None] - thick[:, None, None] * places[:, None, None]
    weight = (0.98 * share / (2 * np.pi * noise.prod() * 16))[:, None] * np.sqrt(rise) * np.exp(
        -0.5 * ((off[0] / noise[0])**2 + rise * (off[1] / noise[1])**2))
    total = 0.02 / (np.pi * (radius + 4 * fit)**2) + weight.sum(axis=(1, 2))
    part = weight / total[:, None, None]
    own = part * np.stack([np.ones(16), rise])[:, None, None]
    firm = 1 / (2 * noise**2)
    # The derivative of each miss by the shifts, and by the shared error.
    slopes = np.zeros((*off.shape, 3 * stations + 1))
    for k in range(stations):
        slopes[:, :, k, :, 3 * k:3 * k + 3] = ways[:, :, k, None]
    slopes[..., -1] = places[:, None, None]
    weighed = own * firm[:, None, None, None]
    found = station_sums(offset, radius, axis, towards, shift, share, noise, wider, fit)
    plain = (part.sum(axis=2), part.sum(axis=(0, 2)), np.log(total).sum(),
             np.einsum("dikp,dikpa,dikpb->ab", weighed, slopes, slopes),
             np.einsum("dikp,dikp,dikpa->a", weighed, off, slopes),
             np.einsum("ikp,dp,dikj->kj", part, places, ways), (own * off**2).sum(axis=(1, 2, 3)))
    for one, other in zip(found, plain, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12 * np.abs(other).max())


def test_flatness_is_that_of_whole_arrays() -> None:
    turn = 2.4 * np.arange(30)
    axis = np.column_stack([np.cos(turn), np.sin(turn), np.ones(30)]) / np.sqrt(2)
    views = np.vstack([np.eye(3), [[0.6, 0.8, 0.0], [0.8, -0.6, 0.0], [-0.6, 0.8, 0.0]]])
    offset = np.column_stack([np.sin(3 * turn), np.cos(5 * turn), np.sin(turn + 1)])
    along = views[:, None] - (views @ axis.T)[:, :, None] * axis
    along /= np.linalg.norm(along, axis=2)[:, :, None]
    on = np.einsum("kij,ij->ki", along, offset)**2
    across = np.einsum("kij,ij->ki", np.cross(axis, along), offset)**2
    more = across - on
    for one, other in zip(flatness(axis, offset, views), (
            more.mean(axis=1), more.std(axis=1) / np.sqrt(30),
            more.sum(axis=1) / (across + on).sum(axis=1)), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9)
