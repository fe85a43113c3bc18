"""A skeleton against the image that it came from."""

import numpy as np
import pytest

from limber.core.errors import InputError
from limber.geometry.cloud.camera import D455, depth_to_cloud
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.cloud.preparation import PreparationSettings, prepare
from limber.geometry.cloud.single_view import View
from limber.geometry.generated import generate_branch
from limber.geometry.skeleton.radii.projected_widths import without_hidden_twigs
from limber.geometry.skeleton.skeleton import Skeleton
from limber.perception.simulated_camera import render_depth
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
