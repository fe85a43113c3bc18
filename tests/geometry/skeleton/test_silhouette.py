"""A skeleton against the image that it came from."""

from dataclasses import replace

import numpy as np
import pytest

from limber.core.errors import InputError
from limber.geometry.cloud.camera import D455, depth_to_cloud
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.cloud.preparation import PreparationSettings, prepare
from limber.geometry.cloud.single_view import View
from limber.geometry.generated import generate_branch
from limber.geometry.skeleton.radii.silhouette import (
    within_silhouette,
    without_edges,
    without_hidden_twigs,
)
from limber.geometry.skeleton.skeleton import (
    INTERPOLATED,
    LIMITED,
    MEASURED,
    UNRESOLVED,
    Skeleton,
)
from limber.perception.simulated_camera import render_depth, with_noise
from limber.stages.shape.reconstruct import reconstruct

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


def test_no_branch_is_thicker_than_its_silhouette():
    """Radii twice too large come down to the truth, a quarter and a pixel; true ones stay."""
    branch = generate_branch(81, length=0.6, fork_count=2)
    truth = branch.skeleton
    middle = (truth.nodes.min(axis=0) + truth.nodes.max(axis=0)) / 2
    camera = D455.looking(eye=middle + [0.9, 0.1, 0.0], target=middle, up=(0.0, 1.0, 0.0))
    depth = with_noise(camera, render_depth(camera, branch.surface.vertices, branch.surface.faces),
                       np.random.default_rng(81), flying_share=0.0)
    points = depth_to_cloud(camera, depth).points
    view = View(camera.origin, 1 / camera.fx)
    same, _ = within_silhouette(truth, points, view)
    assert np.mean(same.radius < 0.97 * truth.radius) < 0.03
    fat = Skeleton.from_edges(truth.nodes, truth.parent, 2 * truth.radius)
    thinner, count = within_silhouette(fat, points, view)
    pixel = 1.1 / camera.fx
    assert np.mean(thinner.radius <= 1.25 * truth.radius + pixel) > 0.8
    assert np.all(thinner.radius > 0.9 * truth.radius)
    assert count == (thinner.radius_state == LIMITED).sum() > 0.8 * truth.node_count
    # A fit that depth noise made collapse is not believed: the silhouette tells the radius.
    hidden = Skeleton.from_edges(truth.nodes, truth.parent, 0.2 * truth.radius, radius_state=(
        np.full(truth.node_count, UNRESOLVED, np.int8)))
    told, _ = within_silhouette(hidden, points, view)
    assert abs(np.median(told.radius / truth.radius) - 1) < 0.15
    assert np.mean(np.abs(told.radius - truth.radius) < 1.96 * told.radius_sigma) > 0.8
    # Of half of the pixels too: there are as many places for them.
    few = points[np.random.default_rng(3).uniform(size=len(points)) < 0.5]
    thin, _ = within_silhouette(hidden, few, View(camera.origin, 1 / camera.fx, 0.5))
    assert abs(np.median(thin.radius / told.radius) - 1) < 0.03
    assert (told.radius_state == UNRESOLVED).all()


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
            reconstruct(tmp_path / "cloud.ply", tmp_path / "a.branch", skeleton_path=path)


def test_edges_take_a_quarter_pixel_from_measured_radii():
    """A radius from elsewhere stays; none is more than halved."""
    truth = generate_branch(81, length=0.6, fork_count=1).skeleton
    state = np.where(truth.branch == 0, MEASURED, INTERPOLATED).astype(np.int8)
    truth = replace(truth, radius_state=state)
    view = View(np.array([1.0, 0.0, 0.3]), 0.002)
    less = without_edges(truth, view)
    pixel = 0.002 * np.linalg.norm(truth.nodes - view.eye, axis=1)
    measured = state == MEASURED
    assert less.radius[measured] == pytest.approx((truth.radius - 0.25 * pixel)[measured])
    assert (less.radius == truth.radius)[~measured].all()
    coarse = without_edges(truth, View(view.eye, 1.0))
    assert (coarse.radius[measured] == truth.radius[measured] / 2).all()
