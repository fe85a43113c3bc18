"""Stage ``plan``: RRT* and D-RRT* on the energy field, then both on the full model.

The field serves to search. Every energy, force and strain that is reported comes from the finite
elements along the found paths; how far the field was off is reported beside them.
"""

import csv
import io
import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from limber.errors import BranchFolderError, InputError
from limber.planning.compare import (
    PathPair,
    PlanSettings,
    chosen_engine,
    plan_pair,
    random_start,
)
from limber.planning.field import EnergyField
from limber.planning.goals import Goal, GraspGoal, TipGoal, default_goal
from limber.planning.grasp_model import GraspModel, read_grasp_model
from limber.planning.resolve import ResolvedPath, resolve_side_by_side
from limber.planning.sampling import energy_inputs
from limber.progress import SILENT, Progress
from limber.store import Branch, Stage, plain

_FRAME_RATE = 24.0  # frames a second when the motion is played; a pose is a frame
_COLUMNS = ("s_m", "x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad", "energy_j", "force_n",
            "strain")


def plan_branch_motion(folder: Path, settings: PlanSettings, *, name: str = "path",
                       workers: int = 2, force: bool = False, progress: Progress = SILENT,
                       warn: Callable[[str], None] = lambda _message: None) -> dict[str, Any]:
    """Stage ``plan:NAME``; writes ``plans/NAME.json``, two csv files and the frames.

    Raises:
        BranchFolderError: no energy field, or one of another geometry or material.
        InputError: the start is not allowed, or two goals are given.
        NoPathError: no path; the message says why.
    """
    branch = Branch.open(folder)
    field_path = branch.require("energy.npz", "energy")
    energy_stage = branch.manifest.stages["energy"]
    grasp_model = read_grasp_model(branch, gravity=bool(energy_stage.settings["gravity"]))
    digests = energy_inputs(grasp_model)
    if energy_stage.reads != digests:
        raise BranchFolderError(
            "The energy field is of another mesh or another Young's modulus.",
            "The branch was reconstructed or estimated anew since `limber energy` ran.",
            "Run `limber energy` again.")
    key = f"plan:{name}"
    inputs = {"reads": ["energy.npz"], "digests": digests}
    if not force and branch.is_current(key, settings, **inputs):
        return branch.manifest.stages[key].result
    with branch.stage(key, settings, **inputs) as stage:
        field = EnergyField.read(field_path)
        goal = _goal(field, settings)
        start = _start(field, goal, settings)
        pair = plan_pair(field, start, goal, settings, progress=progress.part(0.0, 0.3))
        progress(0.3, "both paths on the full model")
        baseline, plan = resolve_side_by_side(
            grasp_model, [pair.baseline.points, pair.plan.points], pair.approach, workers,
            progress.part(0.3, 0.95))
        progress(0.95, "writing")
        summary = _summary(field, goal, start, pair, baseline, plan, settings)
        for message in _doubts(summary, baseline, plan):
            warn(message)
        _write(stage, name, grasp_model, summary, field, baseline, plan)
        stage.result.update(summary)
    progress(1.0, "planned")
    return branch.manifest.stages[key].result


def _goal(field: EnergyField, settings: PlanSettings) -> Goal:
    if settings.goal is not None and settings.tip_goal is not None:
        raise InputError("Both --goal and --tip-goal are given.",
                         "A path ends with the grasp or with the tip in a place, not both.",
                         "Give one of them.")
    if settings.tip_goal is not None:
        return TipGoal(settings.tip_goal, settings.goal_tolerance)
    if settings.goal is not None:
        return GraspGoal(settings.goal, settings.goal_tolerance)
    return default_goal(field, settings.goal_tolerance)


def _start(field: EnergyField, goal: Goal, settings: PlanSettings) -> np.ndarray:
    if settings.start is not None and settings.start_seed is not None:
        raise InputError("Both --start and --start-seed are given.",
                         "A path starts in one place.", "Give one of them.")
    if settings.start is not None:
        return np.array(settings.start, float)
    if settings.start_seed is not None:
        return random_start(field, goal, settings, settings.start_seed)
    return field.rest.copy()


def _summary(field: EnergyField, goal: Goal, start: np.ndarray, pair: PathPair,
             baseline: ResolvedPath, plan: ResolvedPath, settings: PlanSettings,
             ) -> dict[str, Any]:
    before, after = baseline.measures, plan.measures
    return {
        "goal": goal.describe() | {"chosen": settings.goal is None and settings.tip_goal is None},
        "start_m": start, "seed": settings.seed, "engine": chosen_engine(settings.engine),
        "weights": {"deformation": settings.deformation_weight,
                    "distance": settings.distance_weight,
                    "energy_scale_j": pair.objective.energy_scale,
                    "length_scale_m": pair.objective.length_scale},
        "zero_of_energy": "the rest state: the branch as scanned, the gripper open",
        "baseline": asdict(before) | _checked(field, baseline),
        "plan": asdict(after) | _checked(field, plan),
        "energy_saved_percent": _change(before.energy_integral_jm, after.energy_integral_jm, -1),
        "peak_energy_saved_percent": _change(before.peak_energy_j, after.peak_energy_j, -1),
        "length_added_percent": _change(before.length_m, after.length_m, 1),
        "convergence": {"baseline": pair.baseline.history, "plan": pair.plan.history},
    }


def _checked(field: EnergyField, path: ResolvedPath) -> dict[str, Any]:
    """Return the peak strain, and how far the field was from the full model along the path."""
    points = path.poses[:, :3]
    off = field.energy(points) - np.maximum(path.energies, 0.0)
    size = float(np.sqrt(np.mean(path.energies**2)))
    return {"peak_strain": float(path.strains.max()),
            "tip_end_m": path.tips[-1],
            "field_energy_error": float(np.sqrt(np.mean(off**2))) / size if size else 0.0,
            "field_energy_error_max_j": float(np.abs(off).max()),
            "unsolved_count": path.unsolved_count}


def _doubts(summary: dict[str, Any], *paths: ResolvedPath) -> list[str]:
    doubts = []
    for key, label in (("baseline", "RRT*"), ("plan", "D-RRT*")):
        error = summary[key]["field_energy_error"]
        if error > 0.15:
            doubts.append(f"Along the {label} path the energy field was off by {100 * error:.0f} % "
                          "of the full model's energy; more samples would help.")
    unsolved = sum(path.unsolved_count for path in paths)
    if unsolved:
        doubts.append(f"{unsolved} poses along the paths had no acceptable solution and are left "
                      "out of the measures.")
    return doubts


def _change(before: float, after: float, sign: int) -> float | None:
    return 100.0 * sign * (after / before - 1.0) if before > 0.0 else None


def _write(stage: Stage, name: str, grasp_model: GraspModel, summary: dict[str, Any],
           field: EnergyField, baseline: ResolvedPath, plan: ResolvedPath) -> None:
    from limber.mechanics.frames import write_pc2
    from limber.scene.data import at_nodes

    detailed = dict(summary)
    for key, path in (("baseline", baseline), ("plan", plan)):
        detailed[key] = summary[key] | {
            "poses": path.poses, "energies_j": path.energies, "forces_n": path.forces,
            "strains": path.strains, "tips_m": path.tips,
            "field_energies_j": field.energy(path.poses[:, :3])}
    stage.path(f"plans/{name}.json").write_text(
        json.dumps(plain(detailed), allow_nan=False, indent=1) + "\n", encoding="utf-8")
    stage.path(f"plans/{name}.csv").write_text(_table(plan), encoding="utf-8")
    stage.path(f"plans/{name}-baseline.csv").write_text(_table(baseline), encoding="utf-8")
    vertices = np.unique(grasp_model.mesh.surface_faces())
    frames = grasp_model.mesh.nodes[vertices] + plan.displacements[:, vertices]
    write_pc2(stage.path(f"frames/{name}.pc2"), frames, 0.0, 1.0)
    stage.path(f"frames/{name}.json").write_text(json.dumps(plain({
        "frame_count": len(frames), "rate": _FRAME_RATE, "vertex_count": len(vertices),
        "energies_j": plan.energies, "forces_n": plan.forces, "path": name})) + "\n",
        encoding="utf-8")
    # What the scene can colour the surface by, at the vertices and in the order of the frames.
    model, mesh = grasp_model.model, grasp_model.mesh
    densities = [at_nodes(mesh, model.internal(u).tet_energy / mesh.volumes)[vertices]
                 for u in plan.displacements]
    np.savez_compressed(stage.path(f"frames/{name}.npz"),
                        strain_energy_density_j_m3=np.array(densities, np.float32))


def _table(path: ResolvedPath) -> str:
    from limber.planning.objective import arc_lengths

    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_COLUMNS)
    along = arc_lengths(path.poses[:, :3])
    rows = np.column_stack([along, path.poses, path.energies, path.forces, path.strains])
    writer.writerows([f"{value:.9g}" for value in row] for row in rows)
    return text.getvalue()
