"""Branches seen by one sensor: radii by their width across its sight, if its rays made the scan."""

import numpy as np
import pytest

from benchmarks.scan_cases import one_sided_case
from benchmarks.scan_scores import cylinder_volume, seen_part
from limber.core.errors import InputError
from limber.geometry.cloud.camera import D455, depth_to_cloud
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.cloud.preparation import PreparationSettings, prepare
from limber.geometry.cloud.single_view import View
from limber.geometry.generated import generate_branch
from limber.geometry.skeleton.radii import visible_sides
from limber.geometry.skeleton.radii.axis_fit import AxisFit, fit_axes
from limber.geometry.skeleton.radii.projected_widths import (
    by_projected_widths,
    sight_field,
    without_hidden_twigs,
)
from limber.geometry.skeleton.radii.sampling_evidence import fit_of_rays
from limber.geometry.skeleton.radii.visible_sides import fit_seen_side, side_uncertainty
from limber.geometry.skeleton.skeleton import MEASURED, Skeleton
from limber.geometry.skeleton.skeletonise import skeletonise
from limber.perception.simulated_camera import render_depth
from limber.stages.shape.reconstruct import Reconstruct

_RADIUS, _LENGTH = 0.006, 0.5  # [m]
_EYE = np.array([2.0, 0.4, 0.9])  # [m]
_NOISE = 0.0015  # [m]


def _axes(offset: float) -> Skeleton:
    """A stem and a twig that leaves it sideways, ``offset`` [m] towards the sensor."""
    stem = np.stack([np.full(60, offset), np.zeros(60), np.linspace(0, _LENGTH, 60)], axis=1)
    way = np.linspace(0, 0.2, 31)[1:, None]
    twig = stem[30] + way * np.array([0.0, 0.8, 0.6])
    parent = np.r_[np.arange(-1, 59), 30, np.arange(60, 89)]
    return Skeleton.from_edges(np.vstack([stem, twig]), parent, np.full(90, 0.8 * _RADIUS))


def _rays(rng: np.random.Generator) -> np.ndarray:
    """Evenly spaced across the sight of ``_EYE``, with errors along it."""
    points = []
    for start, end in (([0, 0, 0], [0, 0, _LENGTH]), ([0, 0, 0.2542], [0, 0.16, 0.3742])):
        start, end = np.array(start, float), np.array(end, float)
        length = np.linalg.norm(end - start)
        count = int(2 * _RADIUS * length / 0.0018**2)
        foot = start + rng.uniform(0, 1, count)[:, None] * (end - start)
        axis = (end - start) / length
        sight = _EYE - foot
        side = np.cross(axis, sight)
        side /= np.linalg.norm(side, axis=1)[:, None]
        across = rng.uniform(-1, 1, count)[:, None]
        front = np.cross(side, axis)
        points.append(foot + _RADIUS * (across * side + np.sqrt(1 - across**2) * front))
    points = np.vstack(points)
    sight = _EYE - points
    sight /= np.linalg.norm(sight, axis=1)[:, None]
    return points + rng.normal(0, _NOISE, len(points))[:, None] * sight


def _skin(rng: np.random.Generator, half: float) -> np.ndarray:
    """Evenly over the skin, up to ``half`` [rad] from the sight, with errors in all directions."""
    angle, height = rng.uniform(-half, half, 2000), rng.uniform(0, _LENGTH, 2000)
    points = np.stack([_RADIUS * np.cos(angle), _RADIUS * np.sin(angle), height], axis=1)
    return points + rng.normal(0, _NOISE, points.shape)


@pytest.fixture(scope="module")
def rays() -> tuple[AxisFit, np.ndarray]:
    points = _rays(np.random.default_rng(3))
    return fit_axes(_axes(0.3 * _RADIUS), points), points


def test_rays_show_the_radius_across_their_sight(rays: tuple[AxisFit, np.ndarray]) -> None:
    """A circle by distances is an eighth too thin or more; the widths are right, on their axes."""
    fit, points = rays
    assert np.median(fit.skeleton.radius) < 0.88 * _RADIUS
    found, _ = by_projected_widths(fit.skeleton, points)
    assert np.median(found.radius) == pytest.approx(_RADIUS, rel=0.03)
    off = np.abs(found.radius - _RADIUS) / found.radius_sigma
    assert 0.8 < (off < 1.96).mean()
    stem = found.branch == 0
    assert np.median(np.linalg.norm(found.nodes[stem, :2], axis=1)) < 0.15 * _RADIUS


def test_the_sensor_is_found_from_the_seen_sides(rays: tuple[AxisFit, np.ndarray]) -> None:
    """Towards it within 10 degrees, where two axes of different directions have points."""
    _, points = rays
    places = np.array([[0, 0, 0.1], [0, 0.15, 0.35]])
    true = (_EYE - places) / np.linalg.norm(_EYE - places, axis=1)[:, None]
    cosine = np.einsum("ij,ij->i", sight_field(_axes(0.0), points).at(places), true)
    assert (cosine > np.cos(np.radians(10))).all()


def test_rays_are_taken_for_rays_and_skin_for_skin(rays: tuple[AxisFit, np.ndarray]) -> None:
    """By their likelihood; a camera's are known to be rays."""
    fit, points = rays
    told = fit_of_rays(fit, points, certain=False)
    assert told is not None and told.seen.along_sight
    assert np.median(told.skeleton.radius) == pytest.approx(_RADIUS, rel=0.03)
    straight = Skeleton.from_edges(*(getattr(_axes(0.3 * _RADIUS), name)[:60] for name in (
        "nodes", "parent", "radius")))
    for half in (np.radians(81), np.pi):
        skin = _skin(np.random.default_rng(4), half)
        fit = fit_axes(straight, skin)
        assert fit_of_rays(fit, skin, certain=False) is None
        assert fit_of_rays(fit, skin, certain=True) is not None


def test_a_run_without_points_keeps_its_radius() -> None:
    """Where nothing shows a width, nothing is claimed to be measured by it."""
    points = _rays(np.random.default_rng(5))
    stem = points[np.abs(points[:, 1]) < 2 * _RADIUS]
    start = _axes(0.0)
    bare = np.flatnonzero((start.branch == 1) & (start.nodes[:, 1] > 0.05))
    found, _ = by_projected_widths(start, stem)
    assert np.isfinite(found.nodes).all() and (found.radius > 0).all()
    assert (found.radius_state[found.branch == 0] == MEASURED).mean() > 0.9
    assert found.radius[bare] == pytest.approx(start.radius[bare])


def test_widths_that_show_nothing_change_little() -> None:
    """Points on the axis have no width, and far too few no sensor: no radius vanishes."""
    start = _axes(0.0)
    line = start.nodes[np.repeat(np.arange(40), 20)]
    for points in (line, line[:3] + [0.001, 0, 0]):
        found, _ = by_projected_widths(start, points)
        assert (found.radius >= start.radius / 3.001).all() and np.isfinite(found.nodes).all()


# A skeleton against the image that it came from.

EYE = np.array([1.0, 0.0, 0.3])


def _with_twig(direction: np.ndarray) -> Skeleton:
    """A stem along z, 10 mm thick, with a twig of 80 mm from its middle."""
    stem = np.column_stack([np.zeros((31, 2)), np.linspace(0, 0.6, 31)])
    twig = stem[15] + np.linspace(0.01, 0.08, 8)[:, None] * direction / np.linalg.norm(direction)
    return Skeleton.from_edges(
        np.vstack([stem, twig]), np.concatenate([np.arange(-1, 30), [15], np.arange(31, 38)]),
        np.concatenate([np.full(31, 0.01), np.full(8, 0.003)]))


@pytest.mark.parametrize(("direction", "stays"), [
    ([1.0, 0.05, 0.0], False), ([-1.0, 0.0, 0.1], False), ([1.0, 0.5, 0.0], True),
    ([0.0, 1.0, 0.0], True), ([-1.0, -0.6, 0.4], True)])
def test_a_twig_must_be_seen_beside_its_carrier(direction, stays):
    """Straight towards the camera or away is depth noise; 25 degrees aside is a twig."""
    skeleton = _with_twig(np.array(direction))
    kept, dropped = without_hidden_twigs(skeleton, View(EYE, 1e-3), 1.5)
    assert len(kept.forks()) == int(stays)
    assert len(dropped) == 1 - int(stays)
    if not stays:
        assert dropped[0]["length"] == pytest.approx(0.08, abs=1e-3)
    assert without_hidden_twigs(skeleton, View(EYE, 1e-3), 0.0)[0] is skeleton


def test_a_depth_cameras_place_goes_with_the_cloud():
    """`prepare` hands on where the camera stood, in the cloud's new frame."""
    branch = generate_branch(82, length=0.5)
    middle = branch.skeleton.nodes.mean(axis=0)
    camera = D455.looking(eye=middle + [1.0, 0.0, 0.0], target=middle, up=(0.0, 1.0, 0.0))
    depth = render_depth(camera, branch.surface.vertices, branch.surface.faces)
    points = depth_to_cloud(camera, depth).points
    prepared = prepare(Cloud(points), 1.0, PreparationSettings(camera_at=tuple(camera.origin)))
    np.testing.assert_allclose(prepared.view.eye + prepared.origin, camera.origin, atol=1e-9)
    assert prepared.view.pitch == pytest.approx(1 / camera.fx, rel=0.05)
    assert prepare(branch.cloud, 1.0).view is None


def test_a_skeleton_without_thickness_or_of_another_unit_is_refused(tmp_path):
    """Radius 0 made an internal error, a skeleton in millimetres a branch of 700 m."""
    branch = generate_branch(83, length=0.5)
    branch.cloud.write_ply(tmp_path / "cloud.ply")
    truth = branch.skeleton
    for name, scale, thick, complaint in (("thin", 1.0, 0.0, "radius 0"),
                                          ("large", 1000.0, 1.0, "different units")):
        path = tmp_path / f"{name}.swc"
        Skeleton.from_edges(scale * truth.nodes, truth.parent,
                            scale * thick * truth.radius).write_swc(path)
        with pytest.raises(InputError, match=complaint):
            Reconstruct(cloud=tmp_path / "cloud.ply", output=tmp_path / "a.branch",
                        skeleton=path).run()


# From where one side was seen, and how far around: told by the points' angles.


def _two_branches(limit: float, noise: float, seed: int = 0):
    """Unit vectors to points of an upright branch and one that leans by 45 degrees across the
    sight, along x, and their axes and sharpness."""
    rng = np.random.default_rng(seed)
    upright = rng.uniform(size=12_000) < 0.5
    axis = np.where(upright[:, None], [0.0, 0.0, 1.0], np.array([0.0, 1.0, 1.0]) / np.sqrt(2))
    cross = np.cross(axis, [1.0, 0.0, 0.0])
    angle = rng.uniform(-limit, limit, len(axis))
    place = np.column_stack([np.cos(angle), np.sin(angle)]) + rng.normal(0, noise, (len(angle), 2))
    distance = np.linalg.norm(place, axis=1)
    out = (place[:, :1] * [1.0, 0.0, 0.0] + place[:, 1:] * cross) / distance[:, None]
    return out, axis, distance / noise**2


@pytest.mark.parametrize("limit", [74, 84])
@pytest.mark.parametrize("noise", [0.05, 0.17])
def test_view_and_limit_are_told_to_a_degree_or_two(limit: float, noise: float) -> None:
    """From a view that is 17 degrees off and a limit that is another sensor's."""
    out, axis, sharpness = _two_branches(np.deg2rad(limit), noise)
    mean = np.array([1.0, -0.25, 0.15]) / np.linalg.norm([1.0, -0.25, 0.15])
    told = visible_sides._one_side(mean)
    for _ in range(8):
        told = fit_seen_side(out, axis, sharpness, np.ones(len(out)), mean, told)
    assert np.degrees(np.arccos(told.view[0])) < 2.5
    assert np.degrees(told.limit) == pytest.approx(limit, abs=1.0)
    # What is told is less in doubt than what is not.
    assert told.limit_sigma < 0.5 * visible_sides._GRAZING_SIGMA
    doubts = [side_uncertainty(seen, np.array([0.005]), 0.001)[0] for seen in (
        told, visible_sides._one_side(mean))]
    assert doubts[0] < 0.5 * doubts[1]


def test_where_all_axes_are_parallel_the_view_does_not_turn_along_them() -> None:
    """Angles around them say nothing of that: steps of pure chance took it 68 degrees along."""
    rng = np.random.default_rng(0)
    angle = rng.uniform(-1.47, 1.47, 6000)
    points = np.stack([0.006 * np.cos(angle), 0.006 * np.sin(angle), rng.uniform(0, 0.5, 6000)],
                      axis=1) + rng.normal(0, 0.0012, (6000, 3))
    z = np.linspace(0, 0.5, 40)
    axis = Skeleton.from_edges(np.stack([0 * z, 0 * z, z], axis=1), np.arange(40) - 1,
                               np.full(40, 0.006))
    seen = fit_axes(axis, points, uncertainty=False).seen
    assert seen.view[0] > 0.98
    assert np.degrees(seen.limit) == pytest.approx(np.degrees(1.47), abs=2.0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [901100, 901103])
def test_radii_of_one_side_are_not_too_thick(seed: int) -> None:
    """Two of the bench's development cases, whose volume came out 4 to 6 % too large with the
    mean normal for the sight and another sensor's limit."""
    case = one_sided_case(seed)
    volume = cylinder_volume(seen_part(case.truth, case.points))
    assert cylinder_volume(skeletonise(case.points).skeleton) == pytest.approx(volume, rel=0.03)
