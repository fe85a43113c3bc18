"""Generated branches: true axes, radii and Young's modulus, and a scan of them with defects."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from scipy.spatial import cKDTree

from limber.core.files.reading import checked_as, read_json
from limber.core.settings import checked_settings
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.settings import BranchSpec
from limber.geometry.skeleton.skeleton import FRACTIONS, Skeleton, control_points
from limber.geometry.skeleton.sweep import arc_lengths, frames, tangents
from limber.geometry.surface.surface import Surface

_Positive = Annotated[float, Field(gt=0)]
_GAP_M = 0.02  # length of a stretch without points
_STEP = 0.004  # [m] between nodes of the true axes


@dataclass(frozen=True)
class GeneratedBranch:
    """A branch of known truth and its scan in one frame (root at the origin, z up): ``young`` [K]
    [Pa] at ``control_points`` [K, 3] [m]. The scan has the true outward normals."""

    seed: int
    spec: BranchSpec
    skeleton: Skeleton
    surface: Surface
    young: np.ndarray
    control_points: np.ndarray
    fractions: tuple[float, ...]
    cloud: Cloud


def generate_branch(seed: int, **spec: object) -> GeneratedBranch:
    """Make a branch with known truth; the same seed and spec give the same branch.

    Args:
        seed: Seed of all random numbers.
        spec: Fields of :class:`BranchSpec`.
    """
    from limber.geometry.surface.tubes import branch_surface

    settings = checked_settings(BranchSpec, spec)
    rng = np.random.default_rng(seed)
    skeleton = _true_skeleton(rng, settings)
    count = len(FRACTIONS)
    young = settings.young_mean * np.exp(np.linspace(0.4, -0.4, count)
                                         + rng.uniform(-0.5, 0.5, count))
    return GeneratedBranch(
        seed, settings, skeleton, branch_surface(skeleton, sides=20, spacing=1.0), young,
        control_points(skeleton), FRACTIONS, scan(skeleton, settings, rng))


def scan(skeleton: Skeleton, spec: BranchSpec, rng: np.random.Generator) -> Cloud:
    """Sample the surface of a skeleton's round cylinders as a scanner would."""
    points, normals, run, along = _surface_points(skeleton, spec, rng)
    keep = _outside_others(skeleton, points, run)
    keep &= _uneven(points, spec.unevenness, rng)
    keep &= _unoccluded(points, spec, rng)
    keep &= _outside_gaps(skeleton, run, along, spec, rng)
    if spec.view == "one-sided":
        keep &= _seen_from_one_side(points, normals, spec, rng)
    points, normals = points[keep], normals[keep]
    points = points + rng.normal(0, spec.noise, points.shape)
    return Cloud(points, {"normal": normals.astype(np.float32)})


def _true_skeleton(rng: np.random.Generator, spec: BranchSpec) -> Skeleton:
    main = _axis(rng, np.zeros(3), np.array([0.0, 0.0, 1.0]), spec.length, spec.bend)
    nodes, parent = [main], [np.arange(len(main)) - 1]
    # Branches taper more towards the tip than at the base.
    share = np.linspace(0, 1, len(main))
    radius = [spec.radius_root + (spec.radius_tip - spec.radius_root) * share**1.2]
    turn = rng.uniform(0, 2 * np.pi)
    positions = np.linspace(0.18, 0.78, spec.fork_count + 2)[1:-1]
    count = len(main)
    for position in positions:
        at = int(np.clip((position + rng.uniform(-0.03, 0.03)) * len(main), 2, len(main) - 3))
        turn += 2.4 + rng.uniform(-0.4, 0.4)  # about the golden angle, as in buds
        twig, thick = _twig(rng, spec, main, radius[0], at, turn)
        nodes.append(twig[1:])
        parent.append(np.concatenate([[at], count + np.arange(len(twig) - 2)]))
        radius.append(thick[1:])
        count += len(twig) - 1
    return Skeleton.from_edges(np.vstack(nodes), np.concatenate(parent), np.concatenate(radius))


def _twig(rng: np.random.Generator, spec: BranchSpec, main: np.ndarray, radius: np.ndarray,
          at: int, turn: float) -> tuple[np.ndarray, np.ndarray]:
    tangent = tangents(main)
    normals, binormals = frames(main, tangent)
    aside = np.cos(turn) * normals[at] + np.sin(turn) * binormals[at]
    angle = rng.uniform(0.6, 1.1)
    direction = np.cos(angle) * tangent[at] + np.sin(angle) * aside
    length = rng.uniform(0.35, 0.6) * (1 - at / len(main)) * spec.length + 6 * radius[at]
    axis = _axis(rng, main[at], direction, length, 0.5 * spec.bend)
    root = rng.uniform(0.55, 0.8) * radius[at]
    tip = max(0.6 * root, 0.6 * spec.radius_tip)
    return axis, np.linspace(root, min(tip, root), len(axis))


def _axis(rng: np.random.Generator, start: np.ndarray, direction: np.ndarray, length: float,
          bend: float) -> np.ndarray:
    """A smooth curve that turns by about ``bend`` in a random direction, with a slow wobble."""
    count = max(round(length / _STEP), 4)
    share = (np.arange(count) + 0.5) / count
    side = rng.normal(size=3)
    side -= (side @ direction) * direction
    side /= np.linalg.norm(side)
    other = np.cross(direction, side)
    turn = bend * share + 0.25 * bend * np.sin(2 * np.pi * share + rng.uniform(0, 2 * np.pi))
    swing = 0.3 * bend * np.sin(np.pi * share * rng.uniform(1, 2.5))
    steps = (np.cos(turn)[:, None] * direction + np.sin(turn)[:, None] * side
             + np.sin(swing)[:, None] * other)
    steps *= (length / count) / np.linalg.norm(steps, axis=1)[:, None]
    return np.vstack([start, start + np.cumsum(steps, axis=0)])


def _surface_points(skeleton: Skeleton, spec: BranchSpec, rng: np.random.Generator,
                    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Points spread evenly over the cylinders' sides and tips, with normals, run, arc length."""
    # Thinned afterwards for unevenness, so more points are drawn.
    density = 1.0 / spec.point_spacing**2 / (1 - 0.5 * spec.unevenness)
    parts = []
    for run in range(skeleton.branch_count):
        centres, radius = skeleton.curve(run)
        tangent = tangents(centres)
        normals, binormals = frames(centres, tangent)
        along = arc_lengths(centres)
        area = np.concatenate([[0], np.cumsum(
            np.pi * (radius[1:] + radius[:-1]) * np.diff(along))])
        side_count = rng.poisson(area[-1] * density)
        at = np.interp(rng.uniform(0, area[-1], side_count), area, along)
        angle = rng.uniform(0, 2 * np.pi, side_count)
        def interpolated(values: np.ndarray, at: np.ndarray = at,
                         along: np.ndarray = along) -> np.ndarray:
            return np.stack([np.interp(at, along, v) for v in values.T], axis=1)
        out = (np.cos(angle)[:, None] * interpolated(normals)
               + np.sin(angle)[:, None] * interpolated(binormals))
        out /= np.linalg.norm(out, axis=1)[:, None]
        side = interpolated(centres) + np.interp(at, along, radius)[:, None] * out
        tip_count = rng.poisson(2 * np.pi * radius[-1]**2 * density)
        round_tip = rng.normal(size=(tip_count, 3))
        round_tip /= np.linalg.norm(round_tip, axis=1)[:, None]
        round_tip *= np.where(round_tip @ tangent[-1] < 0, -1, 1)[:, None]
        parts.append((np.vstack([side, centres[-1] + radius[-1] * round_tip]),
                      np.vstack([out, round_tip]), np.full(side_count + tip_count, run),
                      np.concatenate([at, np.full(tip_count, along[-1])])))
    return tuple(np.concatenate(columns) for columns in zip(*parts, strict=True))


def _outside_others(skeleton: Skeleton, points: np.ndarray, run: np.ndarray) -> np.ndarray:
    """Whether each point is outside the cylinders of the other runs."""
    keep = np.ones(len(points), bool)
    for other in range(skeleton.branch_count):
        fine, radius = (np.repeat(values, 4, axis=0) for values in skeleton.curve(other))
        fine[1:] = (fine[1:] + fine[:-1]) / 2
        distance, nearest = cKDTree(fine).query(points)
        keep &= (distance > 0.97 * radius[nearest]) | (run == other)
    return keep


def _uneven(points: np.ndarray, amount: float, rng: np.random.Generator) -> np.ndarray:
    waves = rng.normal(0, 15.0, (4, 3))
    wave = np.sin(points @ waves.T + rng.uniform(0, 2 * np.pi, 4)).mean(axis=1)
    return rng.uniform(size=len(points)) < 1 - amount * (0.5 + 0.5 * np.clip(2 * wave, -1, 1))


def _unoccluded(points: np.ndarray, spec: BranchSpec, rng: np.random.Generator) -> np.ndarray:
    keep = np.ones(len(points), bool)
    hole = 1.8 * spec.radius_root
    tree = cKDTree(points)
    while keep.mean() > 1 - spec.occlusion:
        keep[tree.query_ball_point(points[rng.integers(len(points))], hole)] = False
        hole = max(0.97 * hole, 0.8 * spec.radius_root)
    return keep


def _outside_gaps(skeleton: Skeleton, run: np.ndarray, along: np.ndarray, spec: BranchSpec,
                  rng: np.random.Generator) -> np.ndarray:
    keep = np.ones(len(run), bool)
    for middle in (np.arange(spec.gap_count) + 0.5) / max(spec.gap_count, 1):
        start = (0.15 + 0.75 * middle + rng.uniform(-0.03, 0.03)) * spec.length
        keep &= (run != 0) | (np.abs(along - start) > _GAP_M / 2)
    return keep


def _seen_from_one_side(points: np.ndarray, normals: np.ndarray, spec: BranchSpec,
                        rng: np.random.Generator) -> np.ndarray:
    """Whether a camera far away on one side sees each point, by a coarse depth image."""
    angle = rng.uniform(0, 2 * np.pi)
    view = np.array([np.cos(angle), np.sin(angle), 0.0])
    across = np.array([-np.sin(angle), np.cos(angle), 0.0])
    pixel = np.floor(np.stack([points @ across, points[:, 2]], axis=1) / (2 * spec.point_spacing))
    depth = points @ view
    _, which = np.unique(pixel, axis=0, return_inverse=True)
    nearest = np.full(which.max() + 1, -np.inf)
    np.maximum.at(nearest, which.ravel(), depth)
    return (normals @ view > 0.1) & (depth > nearest[which.ravel()] - spec.radius_root)


class _Truth(BaseModel):
    model_config = ConfigDict(extra="allow", allow_inf_nan=False)

    young_pa: list[_Positive]
    fractions: list[Annotated[float, Field(ge=0, le=1)]]
    control_points_m: list[tuple[float, float, float]]


def read_truth(path: Path) -> dict[str, Any]:
    """Return the content of ``truth.json``, which describes a generated branch; InputError if it is
    no such file."""
    content = read_json(path, "a description of a generated branch")
    checked_as(path, _Truth, content, "a description of a generated branch")
    return content
