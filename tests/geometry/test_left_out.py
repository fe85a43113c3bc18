"""Wood that the mesh leaves out is named and weighed; branches that touch are told."""

import json
import subprocess
import sys
import tracemalloc

import numpy as np
import pytest
from tests.subjects.grown import grown

from limber.core.errors import MeshingError
from limber.core.progress import SILENT
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.cloud.preparation import Prepared, prepare
from limber.geometry.leaf_removal import leaf_mask, without_leaves
from limber.geometry.pruned_twigs import (
    report_pruned_twigs,
    touching_runs,
    touching_texts,
    twig_mass,
)
from limber.geometry.settings import ReconstructSettings
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.skeleton.sweep import frames, tangents
from limber.geometry.surface.tubes import branch_surface


def _tree(aside: float) -> Skeleton:
    """A stem, and two twigs of it whose ends come as near as ``aside`` [m]."""
    return grown((-1, (0, 0, 0), (0, 0, 0.5), 51, 0.008),
                 (10, (0, 0, 0.1), (0.15, 0, 0.1), 21, 0.004),
                 (20, (0, 0, 0.2), (0.15, 0, 0.1 + aside), 21, 0.004))


def test_a_twig_is_a_rod() -> None:
    """Mass, centre and inertia of a straight twig are those of a slender rod."""
    skeleton = _tree(0.05)
    straight = next(run for run, members in enumerate(skeleton.runs())
                    if run and np.ptp(skeleton.nodes[members][:, 2]) < 1e-9)
    rod = twig_mass(skeleton, straight, 900.0)
    mass = 900 * np.pi * 0.004**2 * 0.15
    assert rod["mass_kg"] == pytest.approx(mass) and rod["length_m"] == pytest.approx(0.15)
    np.testing.assert_allclose(rod["centre_m"], [0.075, 0, 0.1], atol=1e-9)
    np.testing.assert_allclose(rod["attached_m"], [0, 0, 0.1], atol=1e-9)
    np.testing.assert_allclose(
        rod["inertia_kg_m2"], np.diag([0, 1, 1]) * mass * 0.15**2 / 12, atol=1e-12)


def test_much_left_out_is_asked_for() -> None:
    """Over 3 % of the mass the stage stops and names the branch, unless it is accepted."""
    masses = [twig_mass(_tree(0.05), 1, 900.0)]
    with pytest.raises(MeshingError, match=r"branch 1 \(1\d\d mm.*--leave-out"):
        report_pruned_twigs(masses, 0.05, ReconstructSettings(), SILENT)
    said: list[str] = []
    report_pruned_twigs(masses, 0.05, ReconstructSettings(leave_out=True), SILENT.keeping(said))
    report_pruned_twigs(masses, 5.0, ReconstructSettings(), SILENT.keeping(said))
    assert len(said) == 2 and all("branch 1" in text for text in said)


def test_touching_branches_are_named() -> None:
    """Two twigs that meet make a handle of the surface, told with its place; apart, none."""
    apart, touching = _tree(0.05), _tree(0.004)
    assert branch_surface(apart).handle_count == 0 and not touching_runs(apart)
    assert branch_surface(touching).handle_count == 1
    found = touching_runs(touching)
    assert found[0]["branches"] == [1, 2] and found[0]["at_m"][0] == pytest.approx(0.15, abs=0.04)
    assert "1 handle:" in touching_texts(1, found)[0]


def test_two_nodes_at_one_place_make_no_nan() -> None:
    """Frames go on over a repeated node, near the origin and far from it."""
    line = np.array([[0, 0, 0], [0, 0, 0.1], [0, 0, 0.1], [0, 0.02, 0.2], [0, 0.05, 0.3]])
    for shift in (0.0, 4e5):
        normals, binormals = frames(line + shift, tangents(line + shift))
        assert np.isfinite(normals).all() and np.isfinite(binormals).all()
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-9)


# A scan far denser than its axes need: time and memory, and what of it stays.

COUNT = 150_000
_RUN = """
import json, resource, sys
from limber.stages.shape.reconstruct import Reconstruct
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
result = Reconstruct(cloud=sys.argv[1], output=sys.argv[2]).run()
after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
print(json.dumps({"taken": (after - before) / 1024, "length": result["length_m"],
                  "count": result["point_count"]}))
"""


def _branch(count, rng):
    """Points of a 1 m branch with a side branch of 0.29 m, in 0.3 mm of noise."""
    along, angle = rng.random(count), 2 * np.pi * rng.random(count)
    radius = 0.01 * (1 - 0.5 * along)
    points = np.stack([0.05 * along**2 + np.cos(angle) * radius, np.sin(angle) * radius, along],
                      axis=1)
    side = points[:count // 4].copy()
    points[:count // 4] = np.stack([0.25 * side[:, 2] + 0.0125, 0.5 * side[:, 1],
                                    0.5 + 0.5 * side[:, 0] + 0.15 * side[:, 2]], axis=1)
    return points + rng.normal(scale=3e-4, size=points.shape)


@pytest.mark.campaign
def test_a_dense_scan_takes_little_memory(tmp_path):
    """The whole stage, as the system counts it; the search for leaves alone: below."""
    Cloud(_branch(COUNT, np.random.default_rng(0))).write_ply(tmp_path / "a.ply")
    run = subprocess.run([sys.executable, "-c", _RUN, tmp_path / "a.ply", tmp_path / "a.branch"],
                         capture_output=True, text=True, check=True, timeout=120)
    told = json.loads(run.stdout.splitlines()[-1])
    assert told["taken"] < 350  # [MB]
    assert abs(told["length"] - 1.29) < 0.02 and told["count"] == COUNT


@pytest.mark.slow
def test_every_point_of_a_dense_leaf_is_cut_off():
    """Leaves are looked for among few points, and all the others go with them. The search once took
    pairs of all points, memory that grew with their density."""
    rng = np.random.default_rng(0)
    stem = _branch(60_000, rng)
    blade = rng.uniform([0.1, -0.1, 0], [0.4, 0.1, 0], (90_000, 3)) + [0, 0, 0.9]
    blade += rng.normal(scale=3e-4, size=blade.shape)
    prepared = Prepared(Cloud(np.vstack([stem, blade])), np.zeros(3))
    tracemalloc.start()
    wood, leaves = without_leaves(prepared)
    assert tracemalloc.get_traced_memory()[1] < 200e6  # [bytes]
    tracemalloc.stop()
    mask = leaf_mask(leaves, 150_000)
    assert mask[:60_000].mean() < 0.02 and mask[60_000:].mean() > 0.98
    assert len(wood.cloud) == (~mask).sum()
    assert sum(leaf.area for leaf in leaves) > 0.8 * 0.06


def test_of_points_at_one_place_the_first_stays():
    """Also where others lie between them in the file."""
    points = _branch(2000, np.random.default_rng(1))
    cloud = Cloud(np.vstack([points, points[::3]]), {"number": np.arange(2667)})
    prepared = prepare(cloud, 1.0)
    assert prepared.counts["duplicates"] == 667
    assert prepared.cloud.attributes["number"].max() < 2000
