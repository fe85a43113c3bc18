"""Generated crowns with twigs near the sensor's resolution, and leafy plants, for `scans`."""

import numpy as np

from benchmarks.scan_cases import ScanCase, branch_of
from limber.geometry.generated import BranchSpec, generate_branch, scan
from limber.geometry.skeleton.skeleton import Skeleton

_THINNEST = 0.0015  # [m] radius of twigs at their tips


def crown_case(seed: int) -> ScanCase:
    """A branch with twigs on its twigs down to 1.5 mm radius, 1 to 5 spacings thick."""
    rng = np.random.default_rng([seed, 4])
    spacing = float(rng.uniform(0.0012, 0.003))
    base = branch_of(seed, fork_count=int(rng.integers(4, 11)), gap_count=0, radius_tip=0.003,
                     length=0.8).skeleton
    nodes, parent, radius = [base.nodes], [base.parent], [base.radius]
    count = base.node_count
    for run in base.runs()[1:]:
        places = np.linspace(0.3, 0.8, int(rng.integers(2, 5)))
        for share in places:
            at = run[int(share * len(run))]
            thick = max(0.6 * base.radius[at], _THINNEST)
            way = base.nodes[run[-1]] - base.nodes[run[1]]
            aside = np.cross(way, rng.normal(size=3))
            direction = way / np.linalg.norm(way) + aside / np.linalg.norm(aside)
            length = float(rng.uniform(0.05, 0.12))
            steps = np.linspace(0, length, 15)[1:, None]
            twig = base.nodes[at] + steps * direction / np.linalg.norm(direction)
            nodes.append(twig)
            parent.append(np.concatenate([[at], count + np.arange(len(twig) - 1)]))
            radius.append(np.linspace(thick, _THINNEST, len(twig)))
            count += len(twig)
    truth = Skeleton.from_edges(np.vstack(nodes), np.concatenate(parent), np.concatenate(radius))
    spec = BranchSpec(length=0.8, noise=0.0004, point_spacing=spacing, occlusion=0.05,
                      unevenness=0.2, radius_root=float(base.radius[0]), radius_tip=_THINNEST)
    return ScanCase(f"crown_{seed}", seed, truth, scan(truth, spec, rng).points,
                    settings={"leave_out": True})


def leafy_case(seed: int) -> ScanCase:
    """A seedling: stems, and a leaf at each tip."""
    rng = np.random.default_rng([seed, 5])
    branch = generate_branch(seed, length=0.35, radius_root=0.004, radius_tip=0.0018, bend=0.4,
                             fork_count=4, noise=0.0003, point_spacing=0.001, occlusion=0.05)
    truth, leaves = branch.skeleton, []
    for tip in truth.tips():
        way = truth.nodes[tip] - truth.nodes[truth.parent[tip]]
        way /= np.linalg.norm(way)
        across = np.cross(way, rng.normal(size=3))
        across /= np.linalg.norm(across)
        long, wide = rng.uniform(0.05, 0.09), rng.uniform(0.02, 0.035)
        u, v = rng.uniform(0, 1, 6000), rng.uniform(-1, 1, 6000)
        inside = np.abs(v) < np.sin(np.pi * u)
        u, v = u[inside], v[inside]
        droop = -0.4 * long * u**2
        leaf = (truth.nodes[tip] + long * u[:, None] * way + wide * v[:, None] * across
                + (droop + 0.15 * wide * v**2)[:, None] * np.cross(way, across))
        leaves.append(leaf[::max(int(len(leaf) * 1e-6 / (1.2 * long * wide)), 1)])
    leaf = np.vstack(leaves)
    leaf = leaf + rng.normal(0, 0.0003, leaf.shape)
    on_leaf = np.repeat([False, True], [len(branch.cloud.points), len(leaf)])
    return ScanCase(f"leafy_{seed}", seed, truth, np.vstack([branch.cloud.points, leaf]),
                    settings={"leave_out": True, "leaves": "cut"}, leaf=on_leaf)
