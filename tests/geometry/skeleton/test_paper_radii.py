"""The paper's radii, against a direct computation."""

import json

import numpy as np
import pytest

from limber.cli.main import call
from limber.core.errors import InputError
from limber.core.settings import checked_settings
from limber.geometry.generated import generate_branch
from limber.geometry.io.clouds import read_points
from limber.geometry.io.skeletons import read_swc
from limber.geometry.settings import ReconstructSettings, SkeletonSettings
from limber.geometry.skeleton.contraction import contract
from limber.geometry.skeleton.radii.nearest_points import nearest_point_radii
from limber.geometry.skeleton.skeleton import LIMITED, MEASURED, Skeleton
from limber.geometry.skeleton.skeletonise import skeletonise
from limber.store import Branch


def _directly(node: np.ndarray, points: np.ndarray, k: int) -> float:
    """Sorts all distances by hand and takes the middle of the k smallest."""
    distances = sorted(float(((point - node) ** 2).sum() ** 0.5) for point in points)[:k]
    middle = k // 2
    return distances[middle] if k % 2 else (distances[middle - 1] + distances[middle]) / 2


@pytest.mark.parametrize("k", [1, 4, 7, 60])
def test_they_are_the_papers_medians_within_its_limits(k):
    rng = np.random.default_rng(3)
    points = rng.uniform(0, 0.1, (60, 3))
    nodes = np.array([[0.05, 0.05, 0.0], [0.05, 0.05, 0.05], [0.05, 0.05, 0.1]])
    skeleton = Skeleton(nodes, np.array([-1, 0, 1]), np.full(3, 0.02), np.full(3, 0.001))
    settings = SkeletonSettings(radius_neighbours=k, radius_range=(0.1, 0.3))
    found = nearest_point_radii(skeleton, points, settings)
    extent = points.max(axis=0) - points.min(axis=0)
    scale = float((extent @ extent) ** 0.5)
    for node, radius, state in zip(nodes, found.radius, found.radius_state, strict=True):
        plain = _directly(node, points, k)
        assert radius == pytest.approx(min(max(plain, 0.1 * scale), 0.3 * scale), rel=1e-12)
        assert state == (MEASURED if 0.1 * scale <= plain <= 0.3 * scale else LIMITED)
    assert (found.radius_sigma >= skeleton.radius_sigma).all()


def test_limits_that_exclude_each_other_are_refused():
    with pytest.raises(InputError, match=r"--radius-range.*below the largest"):
        checked_settings(ReconstructSettings, {"radius_range": (0.2, 0.1)})


@pytest.mark.slow
def test_reconstruct_takes_them(tmp_path, capsys):
    """Mesh, skeleton and record have the radii of the aligned cloud's nearest points."""
    folder, scan = tmp_path / "a.branch", tmp_path / "cloud.ply"
    generate_branch(2, length=0.3, fork_count=1, point_spacing=0.004).cloud.write_ply(scan)
    assert call(["reconstruct", str(scan), "-o", str(folder), "--radii", "paper",
                 "--radius-neighbours", "30", "--json"]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    branch = Branch.open(folder)
    skeleton = read_swc(branch.path("skeleton.swc"))
    points = read_points(branch.path("cloud.ply")).points
    for node in range(0, skeleton.node_count, 7):
        assert skeleton.radius[node] == pytest.approx(
            _directly(skeleton.nodes[node], points, 30), rel=1e-3)
    assert told["watertight"] and told["mesh_volume_m3"] > 0
    assert branch.manifest.stages["reconstruct"].settings["radius_neighbours"] == 30


@pytest.mark.slow
def test_gamma_and_the_weights_of_contraction_change_the_skeleton():
    points = generate_branch(2, length=0.3, fork_count=1, point_spacing=0.002).cloud.points
    near = contract(points, weight=0.05).history[0]["moved"]
    assert contract(points).history[0]["moved"] > 2 * near
    bridges = [len(skeletonise(points, SkeletonSettings(gap_factor=gamma)).bridges)
               for gamma in (1.1, 50.0)]
    assert bridges[0] > bridges[1]
