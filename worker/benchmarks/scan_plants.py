"""Generated crowns with twigs near the sensor's resolution, and leafy plants, for `scans`."""

from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.geometry_crowns import axis_scores
from benchmarks.scan_cases import branch_of
from benchmarks.scan_scores import Dense
from benchmarks.table import Row
from limber.errors import LimberError
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.generated import generate_branch
from limber.geometry.reconstruct import ReconstructSettings, reconstruct_cloud
from limber.geometry.skeleton.skeleton import MEASURED, Skeleton
from limber.progress import Progress


def small_crown(seed: int) -> tuple[Skeleton, np.ndarray, float]:
    """A branch with twigs on its twigs down to 1.5 mm, 1 to 5 spacings thick: truth, points,
    spacing [m]."""
    rng = np.random.default_rng([seed, 4])
    spacing = float(rng.uniform(0.0009, 0.0022))
    base = branch_of(seed, fork_count=6, gap_count=0, noise=0.0004, point_spacing=spacing,
                     radius_tip=0.003, occlusion=0.05, length=0.8).skeleton
    nodes, parent, radius = [base.nodes], [base.parent], [base.radius]
    count = base.node_count
    for run in base.runs()[1:]:
        for share in (0.4, 0.7):
            at = run[int(share * len(run))]
            thick = max(0.6 * base.radius[at], 0.0015)
            way = base.nodes[run[-1]] - base.nodes[run[1]]
            aside = np.cross(way, rng.normal(size=3))
            direction = way / np.linalg.norm(way) + aside / np.linalg.norm(aside)
            length = float(rng.uniform(0.05, 0.12))
            steps = np.linspace(0, length, 15)[1:, None]
            twig = base.nodes[at] + steps * direction / np.linalg.norm(direction)
            nodes.append(twig)
            parent.append(np.concatenate([[at], count + np.arange(len(twig) - 1)]))
            radius.append(np.linspace(thick, 0.0015, len(twig)))
            count += len(twig)
    truth = Skeleton.from_edges(np.vstack(nodes), np.concatenate(parent), np.concatenate(radius))
    from limber.geometry.generated import BranchSpec, scan

    spec = BranchSpec(length=0.8, noise=0.0004, point_spacing=spacing, occlusion=0.05,
                      unevenness=0.2, radius_root=float(base.radius[0]), radius_tip=0.0015)
    return truth, scan(truth, spec, rng).points, spacing


def crown_rows(count: int, seed: int, progress: Progress, out: Path | None) -> list[Row]:
    """Radius bias where resolved, length recalled and right, wood left out without a word."""
    scores, bias, unsaid, failed = [], [], 0.0, []
    for number in range(count):
        truth, points, spacing = small_crown(seed + number)
        try:
            said: list[str] = []
            made = reconstruct_cloud(Cloud(points), ReconstructSettings(leave_out=True),
                                     progress=progress.part(0, 0).keeping(said))
        except LimberError as error:
            failed.append(str(error))
            continue
        found = made.meshed.skeleton
        found = found.moved(made.alignment.undo(found.nodes))
        scores.append(axis_scores(truth, found, spacing))
        here, there = Dense.of(found), Dense.of(truth)
        away, near = cKDTree(there.points).query(here.points)
        sure = (away < there.radius[near]) & (found.radius_state[here.high] == MEASURED)
        bias.append(float(np.median(here.radius[sure] / there.radius[near][sure] - 1)))
        named = {mass["branch"] for mass in made.meshed.masses}
        unsaid += max(made.numbers["left_out_twigs"] - len(named), 0)
        progress((number + 1) / count, "small crowns", seed=seed + number)
    if not scores:
        return [Row(f"{count} generated crowns", "-", "; ".join(failed), False)]
    recall, right = (float(np.mean([s[key] for s in scores])) for key in ("recall", "precision"))
    return [Row(f"{count} generated crowns, twigs to 1.5 mm: radius bias where resolved; length "
                "recalled / right; left out unsaid", "10 %; 90 / 95 %; 0",
                f"{np.median(bias):+.1%} (worst {np.abs(bias).max():.1%}); "
                f"{recall:.0%} / {right:.0%}; {unsaid:.0f}"
                + (f"; {len(failed)} not reconstructed" if failed else ""),
                bool(abs(np.median(bias)) < 0.10 and recall >= 0.90 and right >= 0.95
                     and unsaid == 0 and not failed))]


def leafy_plant(seed: int) -> tuple[Skeleton, np.ndarray, np.ndarray]:
    """A seedling: its stems, the points, and which points lie on leaves."""
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
    return truth, np.vstack([branch.cloud.points, leaf]), on_leaf


def leafy_rows(count: int, seed: int, progress: Progress, out: Path | None) -> list[Row]:
    """Stems found, or the plant refused; leaf points taken for stems."""
    recall, right, taken, refused = [], [], [], 0
    for number in range(count):
        truth, points, on_leaf = leafy_plant(seed + number)
        try:
            made = reconstruct_cloud(Cloud(points), ReconstructSettings(leave_out=True))
        except LimberError:
            refused += 1
            continue
        found = made.meshed.skeleton
        found = found.moved(made.alignment.undo(found.nodes))
        there, here = Dense.of(truth), Dense.of(found)
        away, near = cKDTree(there.points).query(here.points)
        back, _ = cKDTree(here.points).query(there.points)
        recall.append(float((back < np.maximum(there.radius, 0.001)).mean()))
        right.append(float((away < np.maximum(there.radius[near], 0.001)).mean()))
        leaf = points[on_leaf]
        distance, place = cKDTree(here.points).query(leaf)
        off_truth = cKDTree(there.points).query(leaf)[0] > 0.006
        taken.append(float(((distance < 1.5 * here.radius[place]) & off_truth).mean()))
        progress((number + 1) / count, "leafy plants", seed=seed + number)
    text = (f"{np.mean(recall):.0%} / {np.mean(right):.0%}; {np.mean(taken):.0%}" if recall
            else "none measured")
    good = bool(recall and np.mean(recall) >= 0.9 and np.mean(right) >= 0.9
                and np.mean(taken) < 0.05)
    return [Row(f"{count} leafy plants: stems recalled / right; leaf points on stems",
                "90 / 90 %; under 5 % (or refused)", f"{text}; {refused} of {count} refused",
                good or refused == count)]
