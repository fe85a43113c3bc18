"""Generated scans of the project's own generator: truth, points in file form, reader settings.

Seeds are fresh in each run of the bench; the difficulties of a case are drawn from its seed.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.worlds.sensors import Hits, cast
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.generated import GeneratedBranch, generate_branch
from limber.geometry.skeleton.skeleton import Skeleton

_PITCH = 1 / 900  # width of a pixel at a depth of 1


@dataclass(frozen=True)
class ScanCase:
    """One scan with truth.

    Attributes:
        name: Name of its files.
        seed: Seed of the case.
        truth: True axes and radii in the file's frame [m].
        points: Points in the file's frame and unit [m], shape [n, 3].
        volume: Volume of the true branch [m^3]; None if it was not computed.
        settings: Settings that the user would give besides the file's name.
        leaf: Whether each point is on a leaf, shape [n]; None if there are none.
    """

    name: str
    seed: int
    truth: Skeleton
    points: np.ndarray
    volume: float | None = None
    settings: dict[str, Any] = field(default_factory=dict)
    leaf: np.ndarray | None = None

    def write(self, folder: Path) -> Path:
        """Write the scan as a PLY file; returns its path."""
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{self.name}.ply"
        Cloud(self.points).write_ply(path)
        return path


def branch_of(seed: int, **changes: object) -> GeneratedBranch:
    """A generated branch whose sizes, fork count and bend vary with the seed."""
    rng = np.random.default_rng([seed, 1])
    spec = {"length": float(rng.uniform(0.6, 1.2)), "radius_root": float(rng.uniform(0.007, 0.013)),
            "radius_tip": float(rng.uniform(0.003, 0.005)), "bend": float(rng.uniform(0.2, 1.0)),
            "fork_count": int(rng.integers(0, 6)), "noise": 0.001,
            "gap_count": int(rng.integers(0, 3) == 2)}
    return generate_branch(seed, **(spec | changes))


def round_case(seed: int) -> ScanCase:
    """Scanned from all around, noise 1 mm."""
    return _case(branch_of(seed), f"round_{seed}")


def one_sided_case(seed: int, noise: float = 0.001) -> ScanCase:
    """Scanned from one side."""
    return _case(branch_of(seed, view="one-sided", noise=noise),
                 f"one_sided_{1000 * noise:.0f}mm_{seed}")


def gap_case(seed: int) -> ScanCase:
    """A gap of 20 to 80 mm without points on the main axis; for odd seeds around a fork."""
    rng = np.random.default_rng([seed, 2])
    branch = branch_of(seed, gap_count=0, fork_count=int(rng.integers(1, 6)),
                       view=("round", "one-sided")[int(rng.integers(2))])
    truth = branch.skeleton
    main = truth.runs()[0]
    if seed % 2:
        forks = np.intersect1d(truth.forks(), main)
        at = truth.nodes[rng.choice(forks)]
    else:
        at = truth.point_at(rng.uniform(0.15, 0.85))
    size = rng.uniform(0.02, 0.08)
    points = branch.cloud.points
    points = points[np.linalg.norm(points - at, axis=1) > size / 2]
    place = "fork" if seed % 2 else "axis"
    return ScanCase(f"gap_{1000 * size:.0f}mm_{place}_{seed}", seed, truth, points,
                    branch.surface.volume)


def single_view_case(seed: int) -> ScanCase:
    """View of a depth camera 0.7 to 1.2 m away: one reading per pixel, noise growing with depth.

    The file is in the camera's frame (x right, y down, z forward). Pixels at edges fly: some of
    their readings are between the branch and a background behind it.
    """
    rng = np.random.default_rng([seed, 3])
    branch = branch_of(seed, gap_count=0)
    centre = branch.skeleton.nodes.mean(axis=0)
    turn = rng.uniform(0, 2 * np.pi)
    forward = np.array([np.cos(turn), np.sin(turn), rng.uniform(-0.2, 0.2)])
    forward /= np.linalg.norm(forward)
    eye = centre - forward * rng.uniform(0.7, 1.2)
    # A camera has a depth for a pixel that the branch covers by half or more: that of its middle.
    hits = cast(branch.surface.vertices[branch.surface.faces], eye, centre, _PITCH)
    truth = branch.skeleton.moved((branch.skeleton.nodes - eye) @ hits.axes.T)
    return ScanCase(f"single_view_{seed}", seed, truth, _depth_image(hits, rng),
                    branch.surface.volume, {"up": tuple((hits.axes @ [0.0, 0.0, 1.0]).tolist())})


def _depth_image(hits: Hits, rng: np.random.Generator) -> np.ndarray:
    """Readings [m] in the camera's frame, with noise and flying pixels."""
    rays = hits.way @ hits.axes.T
    depth, flat = hits.distance * rays[:, 2], rays[:, :2] / rays[:, 2:]
    # As with a stereo camera: errors grow with the square of the depth, jointly over patches.
    patch = rng.normal(size=(40, 3)) * 60.0
    waves = np.sin(np.column_stack([flat, depth]) @ patch.T
                   + rng.uniform(0, 2 * np.pi, 40)).mean(axis=1) * np.sqrt(2 * 40)
    depth = depth + depth**2 * (0.001 * rng.normal(size=len(depth)) + 0.0007 * waves)
    flying = hits.edge & (rng.uniform(size=len(depth)) < 0.08)
    depth = np.where(flying, depth + rng.exponential(0.03, len(depth)), depth)
    return np.column_stack([flat, np.ones(len(depth))]) * depth[:, None]


def _case(branch: GeneratedBranch, name: str) -> ScanCase:
    return ScanCase(name, branch.seed, branch.skeleton, branch.cloud.points, branch.surface.volume)


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


KINDS: dict[str, Callable[[int], ScanCase]] = {
    "one-sided": one_sided_case, "2-mm": partial(one_sided_case, noise=0.002),
    "3-mm": partial(one_sided_case, noise=0.003), "round": round_case, "gaps": gap_case,
    "single-view": single_view_case, "leafy": leafy_case}
"""Cases by kind, from a seed."""
