"""A scan far denser than its axes need: time and memory, and what of it stays."""

import json
import subprocess
import sys

import numpy as np
import pytest

from limber.geometry.cloud.cloud import Cloud
from limber.geometry.cloud.preparation import Prepared, prepare
from limber.geometry.leaf_removal import leaf_mask, without_leaves

COUNT = 150_000
_RUN = """
import json, resource, sys
from limber.geometry.warm_up import warm_up
from limber.stages.shape.reconstruct import reconstruct
warm_up()
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
result = reconstruct(sys.argv[1], sys.argv[2])
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


@pytest.mark.slow
def test_a_dense_scan_takes_little_memory(tmp_path):
    """The leaf search once took pairs of all points, memory that grew with their density."""
    Cloud(_branch(COUNT, np.random.default_rng(0))).write_ply(tmp_path / "a.ply")
    run = subprocess.run([sys.executable, "-c", _RUN, tmp_path / "a.ply", tmp_path / "a.branch"],
                         capture_output=True, text=True, check=True, timeout=120)
    told = json.loads(run.stdout.splitlines()[-1])
    assert told["taken"] < 350  # [MB]
    assert abs(told["length"] - 1.29) < 0.02 and told["count"] == COUNT


@pytest.mark.slow
def test_every_point_of_a_dense_leaf_is_cut_off():
    """Leaves are looked for among few points, and all the others go with them."""
    rng = np.random.default_rng(0)
    stem = _branch(60_000, rng)
    blade = rng.uniform([0.1, -0.1, 0], [0.4, 0.1, 0], (90_000, 3)) + [0, 0, 0.9]
    blade += rng.normal(scale=3e-4, size=blade.shape)
    prepared = Prepared(Cloud(np.vstack([stem, blade])), np.zeros(3))
    wood, leaves = without_leaves(prepared)
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
