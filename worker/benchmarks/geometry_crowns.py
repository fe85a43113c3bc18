"""Dense crowns with known truth, and the fraction of a scan that its skeleton explains."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.scan_scores import Dense
from benchmarks.table import Asked, Row, Setting
from benchmarks.trial_log import Numbers, numbers_of, source_digest
from limber.geometry.generated import BranchSpec, scan
from limber.geometry.skeleton.radii.fit_kernels import nearest_cylinders
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.skeleton.skeletonise import skeletonise
from limber.geometry.skeleton.sweep import frames, tangents

CROWNS = ((8.0, 0.12, 0.035, 0.004), (12.0, 0.2, 0.05, 0.008), (6.0, 0.08, 0.025, 0.004),
          (8.0, 0.12, 0.05, 0.004))
"""Height [m], root radius [m], point spacing [m], noise [m]; seeds take turns."""
CROWN_ROWS = (Asked("generated crowns: axis length recalled / right", "report"),
              Asked("generated crowns: radius where the axis is right", "report"))

_TWIGS = (9, 6, 4)  # on each axis of order 0, 1, 2
_THINNEST = 0.006  # [m]


@dataclass
class _Growing:
    nodes: list[np.ndarray]
    parent: list[np.ndarray]
    radius: list[np.ndarray]

    @property
    def count(self) -> int:
        return sum(len(nodes) for nodes in self.nodes)


def generated_crown(seed: int, height: float, radius: float, spacing: float, noise: float,
                    ) -> tuple[Skeleton, np.ndarray]:
    """Make a tree of four orders and its scan: true skeleton, and points [m], shape [n, 3]."""
    rng = np.random.default_rng(9000 + seed)
    growing = _Growing([], [], [])
    _grow(rng, growing, np.zeros(3), np.array([0.0, 0.0, 1.0]), height, radius, 0, -1)
    skeleton = Skeleton.from_edges(np.vstack(growing.nodes), np.concatenate(growing.parent),
                                   np.concatenate(growing.radius))
    spec = BranchSpec(length=height, radius_root=radius, radius_tip=_THINNEST, noise=noise,
                      point_spacing=spacing, occlusion=0.05)
    return skeleton, scan(skeleton, spec, rng).points


def axis_scores(truth: Skeleton, found: Skeleton, spacing: float, step: float = 0.02,
                ) -> dict[str, float]:
    """Recall and precision of axis length, compared every ``step`` [m], and radii.

    An axis is correct if it is within the true radius, or the points' spacing, of a true one.
    ``thin``: recall where the true radius is under 20 mm.
    """
    there, here = Dense.of(truth, step=step), Dense.of(found, step=step)
    missed = cKDTree(here.points).query(there.points)[0] > np.maximum(there.radius, spacing)
    distance, near = cKDTree(there.points).query(here.points)
    right = distance <= np.maximum(there.radius[near], spacing)
    ratio = here.radius[right] / there.radius[near][right] - 1
    return {"length": found.length / truth.length, "recall": float(1 - missed.mean()),
            "thin": float(1 - missed[there.radius < 0.02].mean()),
            "precision": float(right.mean()), "radius_bias": float(np.median(ratio)),
            "radius_error": float(np.median(np.abs(ratio)))}


def crown_rows(setting: Setting) -> list[Row]:
    """Skeletonise generated crowns and score their axes."""
    source = source_digest(("geometry",), __file__)
    trials = numbers_of("crowns", setting.seeds(len(CROWNS), 1), partial(
        _crown_trial, source=source), source, setting.kept / "geometry.jsonl", setting.budget,
        progress=setting.progress)
    scores = [trial.values for trial in trials]
    mean = {key: float(np.mean([score[key] for score in scores])) for key in scores[0]}
    worst = min(score["recall"] for score in scores), min(s["precision"] for s in scores)
    return [Row(*CROWN_ROWS[0],
                f"{mean['recall']:.0%} (worst {worst[0]:.0%}; under 20 mm radius "
                f"{mean['thin']:.0%}) / {mean['precision']:.0%} (worst {worst[1]:.0%}), length "
                f"{mean['length']:.2f} of the truth", None, len(scores)),
            Row(*CROWN_ROWS[1],
                f"median {mean['radius_bias']:+.0%}, median |difference| "
                f"{mean['radius_error']:.0%}", None, len(scores))]


def _crown_trial(seed: int, source: str) -> Numbers:
    kind = CROWNS[seed % len(CROWNS)]
    truth, points = generated_crown(seed, *kind)
    found = skeletonise(points, root=truth.nodes[0]).skeleton
    return Numbers("crowns", seed, source, axis_scores(truth, found, spacing=kind[2]))


def explained(points: np.ndarray, skeleton: Skeleton) -> float:
    """Fraction of points no farther outside a branch than twice their own spacing."""
    _, residual = nearest_cylinders(skeleton, points)
    own = np.median(cKDTree(points).query(points, k=min(5, len(points)))[0][:, 1:], axis=1)
    return float((residual <= 2 * own).mean())


def against_graph(path: Path, nodes: np.ndarray, parent: np.ndarray) -> str:
    """Mean distances between our axes and those of a graph file in millimetres, in both directions.

    Args:
        path: Lines ``v x y z`` and ``e i j``.
        nodes: Our nodes in the file's frame [mm], shape [n, 3].
        parent: Parents of our nodes, shape [n].
    """
    lines = [line.split() for line in path.read_text(encoding="utf-8").splitlines()]
    corner = np.array([row[1:4] for row in lines if row and row[0] == "v"], float)
    edges = np.array([row[1:3] for row in lines if row and row[0] == "e"], int)
    share = np.linspace(0, 1, 20)[:, None, None]
    theirs = (corner[edges[:, 0]] + share * (corner[edges[:, 1]] - corner[edges[:, 0]]))
    ours = nodes[parent[1:]] + share * (nodes[1:] - nodes[parent[1:]])
    theirs, ours = theirs.reshape(-1, 3), ours.reshape(-1, 3)
    there, back = cKDTree(theirs).query(ours)[0].mean(), cKDTree(ours).query(theirs)[0].mean()
    return f"{there:.2f} mm to theirs, {back:.2f} mm back (mean)"


def _grow(rng: np.random.Generator, growing: _Growing, start: np.ndarray, direction: np.ndarray,
          length: float, radius: float, order: int, hang: int) -> None:
    axis = _axis(rng, start, direction, length, (0.25, 0.6, 0.8, 0.8)[order])
    thick = radius + (max(0.25 * radius, _THINNEST) - radius) * np.linspace(0, 1, len(axis))**1.1
    first = 0 if hang < 0 else 1
    index = growing.count + np.arange(len(axis) - first)
    if hang >= 0:
        index = np.concatenate([[hang], index])
    growing.nodes.append(axis[first:])
    growing.radius.append(thick[first:])
    growing.parent.append(np.concatenate([[-1], index[:-1]]) if hang < 0 else index[:-1])
    if order == len(_TWIGS):
        return
    tangent = tangents(axis)
    normals, binormals = frames(axis, tangent)
    turn = rng.uniform(0, 2 * np.pi)
    for place in np.linspace(0.2, 0.95, _TWIGS[order]) + rng.uniform(-0.03, 0.03, _TWIGS[order]):
        at = int(np.clip(place * len(axis), 1, len(axis) - 2))
        turn += 2.4 + rng.uniform(-0.4, 0.4)
        angle = rng.uniform(0.5, 1.0)
        aside = np.cos(turn) * normals[at] + np.sin(turn) * binormals[at]
        twig = length * rng.uniform(0.35, 0.6) * (1 - 0.6 * place)
        if twig > max(8 * thick[at], 0.25):
            _grow(rng, growing, axis[at], np.cos(angle) * tangent[at] + np.sin(angle) * aside,
                  twig, max(rng.uniform(0.4, 0.7) * thick[at], _THINNEST), order + 1,
                  int(index[at]))


def _axis(rng: np.random.Generator, start: np.ndarray, direction: np.ndarray, length: float,
          bend: float) -> np.ndarray:
    """A curve that turns by about ``bend`` [rad] to one side, with nodes 5 cm apart."""
    count = max(round(length / 0.05), 4)
    share = (np.arange(count) + 0.5) / count
    side = rng.normal(size=3)
    side -= (side @ direction) * direction
    side /= np.linalg.norm(side)
    turn = bend * share + 0.25 * bend * np.sin(2 * np.pi * share + rng.uniform(0, 2 * np.pi))
    steps = np.cos(turn)[:, None] * direction + np.sin(turn)[:, None] * side
    return np.vstack([start, start + np.cumsum(steps, axis=0) * length / count])
