"""The file ``plans/NAME.json``: the motion of gripper and branch, pose by pose.

Format 2. Beside the summary (goal, scores of both paths, seeds) it has three paths: ``baseline``
and ``plan`` between start and goal, and ``motion``, the whole motion of a gripper, from the hanging
branch to the start (``approach``), along the plan (``path``) and back along the same path
(``return``). Each is a table of columns of equal length:

from limber.core.errors import Command, Option, Text
``times_s``, ``poses`` [m, rad] [n][6], ``energies_j``, ``forces_n`` and ``torques_nm`` [n][3] (of
the gripper on the branch, the torque about the pose's position), ``axial_forces_n`` (along the
branch, outward), ``strains`` and ``stresses_pa`` (largest in the branch), ``tips_m`` [n][3],
``targets_m`` {name: [n][3]}, ``field_energies_j`` (predicted by the field), ``joints_rad`` [n][6]
if a robot is given; ``motion`` also ``phases``.

``timing`` has the limits of speed and acceleration that the times keep; a motion is at standstill
at rest, at the path's end, and at rest again. ``in_motion``, if limits were requested, states that
they hold at this pace with the branch's inertia, and the peaks in motion and at standstill.
``legs`` lists what is executed, in order: of a plan in a robot's cell ``approach`` (of the empty
gripper), ``grasp``, ``path`` (from the hanging branch to the goal), ``hold``, ``return``,
``release`` and ``leaving``, each with its start and duration [s], length [m], speeds, largest force
and torque, and least distances of arm and gripper from obstacles and themselves, and of the arm's
links from the branch [m]; without a cell ``path``, ``hold`` and ``return`` alone.
``turning``, if the arm cannot let the gripper turn with the branch, has the rotations beyond the
branch's own: ``along_m`` [n] of approach and path, ``offsets_rad`` [n][3] in the branch's frame,
and the energy and torque that they cost.
``limits`` has for each requested limit its value, the peak of the motion at standstill at each
pose, and the margin. ``robot`` is null for plans that were not made in a robot's cell.
"""

from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from limber.core.errors import Command, InputError, Option, Text
from limber.core.files.reading import checked_as, read_json
from limber.core.json_values import number_array, plain
from limber.core.not_none import present
from limber.planning.baseline_and_plan import PathPair
from limber.planning.certificate.lower_bound import COST
from limber.planning.constraints.limits import Limits, with_unit
from limber.planning.constraints.motion_check import field_error
from limber.planning.cost import STEP, PathMeasures, measure_path, resample
from limber.planning.field.energy_field import EnergyField
from limber.planning.field.stored_states import States
from limber.planning.goals.goal import Goal
from limber.planning.goals.goal_kinds import asked_kinds
from limber.planning.path_on_full_model import ResolvedPath
from limber.planning.planners.trees import chosen_engine
from limber.planning.settings import PlanSettings
from limber.planning.timing import DEFAULT_PACE, Pace, times_along

FORMAT = 2
_WAYS = ("baseline", "plan")
_COLUMNS = {"poses": "poses", "energies": "energies_j", "strains": "strains", "tips": "tips_m",
            "torques": "torques_nm", "times": "times_s", "field_energies": "field_energies_j",
            "joints": "joints_rad", "stresses": "stresses_pa",
            "axial_forces": "axial_forces_n"}


@dataclass(frozen=True)
class PlanPath:
    """States along a path, None if a file does not have them: poses [n, 6] [m, rad], energies above
    hanging [J], the largest strain and stress [Pa], forces and torques on the branch [n, 3], joints
    [n, joints] [rad]. ``phases`` are ``approach``, ``path`` or ``return``."""

    poses: np.ndarray
    energies: np.ndarray
    strains: np.ndarray
    forces: np.ndarray
    torques: np.ndarray | None = None
    times: np.ndarray | None = None
    tips: np.ndarray | None = None
    targets: dict[str, np.ndarray] = field(default_factory=dict)
    field_energies: np.ndarray | None = None
    joints: np.ndarray | None = None
    phases: tuple[str, ...] | None = None
    stresses: np.ndarray | None = None
    axial_forces: np.ndarray | None = None

    @property
    def force_sizes(self) -> np.ndarray:
        """Magnitude of the gripper's force [N], shape [n]."""
        return np.linalg.norm(self.forces, axis=1)


class _Told(BaseModel):
    model_config = ConfigDict(extra="allow", allow_inf_nan=False)


class PathScores(_Told):
    """Summary of one of the two paths, on the full model."""

    length_m: float | None = None
    energy_integral_jm: float | None = None
    energy_sum_nmm: float | None = None
    peak_energy_j: float | None = None
    peak_force_n: float | None = None


class PlanGoal(_Told):
    """The goal: its kind, and a ball in it."""

    kind: str = "grasp"
    position_m: tuple[float, float, float] | None = None
    tolerance_m: float | None = Field(None, gt=0)


class PlanBranchBound(_Told):
    """The bound for the full model."""

    field_error_j: float | None = None
    gap_percent: float | None = None


class PlanLevel(_Told):
    """The bounds of one grid."""

    spacing_m: float = Field(gt=0)
    lower: float | None
    upper: float | None


class PlanCertificate(_Told):
    """The largest possible gap between the path and the best one."""

    gap_percent: float | None = None
    levels: list[PlanLevel] = []
    full_model: PlanBranchBound | None = None


class PlanTrade(_Told):
    """The gentlest path found at one weight of its length."""

    length_m: float
    energy_integral_jm: float
    lower_bound_jm: float | None
    metre_jm: float


class PlanDetour(_Told):
    """The trade-off between energy and length of the gentlest paths."""

    shortest_m: float
    longest_m: float
    curve: list[PlanTrade] = Field(min_length=1)


class PlanInMotion(_Told):
    """The pace at which a plan keeps its limits with the branch's inertia."""

    speed_m_s: float = Field(gt=0)
    acceleration_m_s2: float = Field(gt=0)


class PlanRobot(_Told):
    """The arm that a plan is for."""

    model: str | None = None


class PlanTiming(_Told):
    """The pace of a plan's motion."""

    speed_m_s: float = Field(gt=0)


class PlanLeg(_Told):
    """One leg of the whole motion, from the gripper's approach to its leaving."""

    name: str
    start_s: float = Field(ge=0)
    duration_s: float = Field(ge=0, le=1e5)
    length_m: float = Field(ge=0)
    peak_speed_m_s: float = Field(ge=0)
    peak_force_n: float = Field(ge=0)
    peak_torque_nm: float = Field(ge=0)
    obstacle_distance_m: float | None = None
    branch_distance_m: float | None = None


class PlanTurning(_Told):
    """Rotations of the gripper beyond the branch's own along the path."""

    along_m: list[float] = Field(min_length=2)
    offsets_rad: list[tuple[float, float, float]]

    @model_validator(mode="after")
    def _fits(self) -> "PlanTurning":
        if len(self.along_m) != len(self.offsets_rad) or any(
                b < a for a, b in pairwise(self.along_m)):
            raise ValueError("offsets_rad needs a row for each of the ascending along_m")
        return self


class PlanStep(_Told):
    """One entry of a planner's history."""

    iteration: int
    cost: float | None


class PlanSummary(_Told):
    """The parts of a plan's file that others read beside its columns."""

    goal: PlanGoal = PlanGoal()
    planner: str | None = None
    seed: int | None = None
    baseline: PathScores = PathScores()
    plan: PathScores = PathScores()
    certificate: PlanCertificate | None = None
    in_motion: PlanInMotion | None = None
    robot: PlanRobot | None = None
    detour: PlanDetour | None = None
    paths_on_field: dict[str, Any] | None = None
    limits: dict[str, dict[str, float]] | None = None
    clearance_m: float | None = Field(None, ge=0)
    timing: PlanTiming | None = None
    legs: list[PlanLeg] = []
    turning: PlanTurning | None = None
    targets: list[str] = []
    energy_saved_percent: float | None = None
    length_added_percent: float | None = None
    convergence: dict[str, list[PlanStep]] = {}


@dataclass(frozen=True)
class PlanFile:
    """A plan as read: ``summary`` is all but the columns, ``motion`` the whole, with approach and
    return."""

    summary: dict[str, Any]
    baseline: PlanPath
    plan: PlanPath
    motion: PlanPath


def path_record(solved: States, targets: tuple[str, ...] = (), *,
                pace: Pace = DEFAULT_PACE, stops: tuple[int, ...] = (),
                field_energies: np.ndarray | None = None,
                phases: tuple[str, ...] | None = None) -> PlanPath:
    """Return the path of solved poses as fast as ``pace`` allows, at standstill at ``stops``;
    target names in the order of the solution."""
    return PlanPath(
        poses=solved.poses, energies=solved.energies, strains=solved.strains, forces=solved.forces,
        torques=solved.torques,
        times=times_along(solved.poses[:, :3], pace, stops), tips=solved.tips,
        targets={name: solved.targets[:, k] for k, name in enumerate(targets)},
        field_energies=field_energies, phases=phases, stresses=solved.stresses,
        axial_forces=solved.axial_forces)


def whole_motion(path: ResolvedPath, targets: tuple[str, ...] = (),
                 pace: Pace = DEFAULT_PACE) -> PlanPath:
    """Return approach from rest, path, and the return path, which is the same reversed. Equilibria
    have no memory: on the return path the branch takes the same states."""
    ahead, on_path = path.ahead, len(path.solved.poses)
    back = np.arange(len(ahead.poses) - 1)[::-1]
    phases = (("approach",) * (len(ahead.poses) - on_path) + ("path",) * on_path
              + ("return",) * len(back))
    return path_record(ahead.joined(ahead.take(back)), targets, pace=pace,
                       stops=(len(ahead.poses) - 1,), phases=phases)


def limits_of_motion(motion: PlanPath, limits: Limits) -> dict[str, dict[str, float]]:
    """Return value, peak along the motion and margin of each requested limit."""
    peaks = {"energy": motion.energies, "force": motion.force_sizes, "strain": motion.strains,
             "stress": motion.stresses, "axial_force": motion.axial_forces,
             "torque": np.linalg.norm(present(motion.torques, "torque"), axis=1)}
    found = {}
    for name, limit in limits.asked().items():
        if name not in peaks:
            continue
        peak = float(np.abs(peaks[name]).max())
        found[with_unit(name)] = {"limit": limit, "peak": peak, "margin": limit - peak}
    return found


def plan_content(summary: dict[str, Any], baseline: PlanPath, plan: PlanPath, motion: PlanPath,
                 limits: dict[str, dict[str, float]], pace: Pace = DEFAULT_PACE) -> dict[str, Any]:
    """Return the content of a file of format 2; the summary has an entry for ``baseline`` and for
    ``plan``."""
    return plain({
        "format_version": FORMAT, **summary, "targets": sorted(plan.targets),
        "timing": {"kind": "limited acceleration", "speed_m_s": pace.speed,
                   "acceleration_m_s2": pace.acceleration}, "limits": limits,
        "robot": summary.get("robot"),
        "baseline": summary["baseline"] | _columns(baseline),
        "plan": summary["plan"] | _columns(plan), "motion": _columns(motion)})


def read_plan(path: Path) -> PlanFile:
    """Read a plan of format 2. InputError if it is not a plan, is damaged, or is from a newer
    program."""
    try:
        content = read_json(path, "a plan")
        version = content.get("format_version")
    except AttributeError as error:
        raise _not_a_plan(path, str(error)) from error
    if isinstance(version, int) and version > FORMAT:
        raise InputError(f"{path} is a plan in format {version}.",
                         f"This program reads format {FORMAT}.", "Update Limber.")
    try:
        paths = {name: _path_from(content[name]) for name in _WAYS}
        motion = _path_from(content["motion"])
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise _not_a_plan(path, f"{type(error).__name__}: {error}") from error
    checked_as(path, PlanSummary, content, "a plan", strict=True)
    kept = {name: value for name, value in content.items() if name != "motion"}
    return PlanFile(kept, paths["baseline"], paths["plan"], motion)


def read_plan_summary(path: Path) -> dict[str, Any]:
    """Return the entries of a plan's file beside its columns, as far as present. InputError if it
    is not a plan, or is damaged."""
    content = read_json(path, "a plan")
    checked_as(path, PlanSummary, content, "a plan", strict=True)
    return content


def _columns(path: PlanPath) -> dict[str, Any]:
    found = {column: getattr(path, name) for name, column in _COLUMNS.items()
             if getattr(path, name) is not None}
    found |= {"forces_n": path.forces, "targets_m": path.targets}
    return found if path.phases is None else found | {"phases": path.phases}


def _path_from(content: dict[str, Any]) -> PlanPath:
    values = {name: number_array(content[column]) for name, column in _COLUMNS.items()
              if content.get(column) is not None}
    count = len(values["poses"])
    forces = number_array(content["forces_n"])
    targets = {name: number_array(positions)
               for name, positions in content.get("targets_m", {}).items()}
    phases = tuple(content["phases"]) if "phases" in content else None
    columns: list[Any] = [*values.values(), forces, *targets.values(),
                          *([] if phases is None else [phases])]
    if values["poses"].shape != (count, 6) or any(len(column) != count for column in columns):
        raise ValueError("columns of unequal length")
    if forces.shape != (count, 3):
        raise ValueError("forces that are no vectors")
    if any(not np.isfinite(column).all() for column in [*values.values(), forces]):
        raise ValueError("values that are not finite")
    return PlanPath(forces=forces, targets=targets, phases=phases, **values)


def _not_a_plan(path: Path, why: str) -> InputError:
    return InputError(f"{path} is not a plan ({why}).",
                      Text("It was not written by ", Command("plan"), ", or is damaged."),
                      "Run ", Command("plan"), " again with ", Option("force", True), ".")


# The summary of a plan: its measures and the shortest path's, its bound, and warnings.

_CHANGES = ("energy_saved_percent", "peak_energy_saved_percent", "length_added_percent")
_STILL = 1e-9  # [m] a path that is not longer has no length
_WIDE_GAP = 5.0  # percent above which there is a warning


def summary_of(field: EnergyField, goal: Goal, start: np.ndarray, pair: PathPair,
               baseline: ResolvedPath, plan: ResolvedPath, settings: PlanSettings,
               ) -> dict[str, Any]:
    """Return the entries of a plan's file beside its columns that are known without rounds."""
    before, after = baseline.measures, plan.measures
    return {
        "goal": goal.describe() | {"chosen": not asked_kinds(settings)},
        "start_m": start, "seed": settings.seed, "planner": settings.planner,
        "engine": chosen_engine(settings.effort.engine),
        "certificate": pair.certificate.describe() | {"full_model": _on_full_model(
            field, goal, pair, after)},
        "paths_on_field": {name: asdict(_on_field(field, points)) | {
            "peak_strain": float(np.abs(field.load(resample(points, STEP), "strain")).max())}
            for name, points in pair.compared.items()},
        "margins": pair.margins,
        "detour": pair.detour and pair.detour.describe(),
        "weights": {"deformation": pair.cost.deformation,
                    "distance": pair.cost.distance,
                    "energy_scale_j": pair.cost.energy_scale,
                    "length_scale_m": pair.cost.length_scale},
        "zero_of_energy": "the rest state: the branch as scanned, the gripper open; an energy is "
        "the potential of strain and weight, and the gripper's force is its gradient",
        "baseline": asdict(before) | _checked(field, baseline),
        "plan": asdict(after) | _checked(field, plan),
        **(dict.fromkeys(_CHANGES) if pair.stays else dict(zip(_CHANGES, (
            _change(before.energy_integral_jm, after.energy_integral_jm, -1),
            _change(before.peak_energy_j, after.peak_energy_j, -1),
            _change(before.length_m, after.length_m, 1)), strict=True))),
        "convergence": {"baseline": pair.baseline.history, "plan": pair.plan.history},
    }


def _on_full_model(field: EnergyField, goal: Goal, pair: PathPair, found: PathMeasures,
                   ) -> dict[str, Any]:
    """Return the bound for every branch whose energy is nowhere farther below the field's than 95 %
    of left-out samples were, and the plan's gap to it. As E falls by e, c falls to at least l / (l
    + w e) of itself, and an integral by e times the length. A target has no bound."""
    weights, detour = pair.cost.weights, pair.detour
    cheap = field.samples.energies <= 1.5 * max(found.peak_energy_j, 1e-12)
    missed = np.abs(field.missed[cheap & field.tested, 0])
    error = float(np.quantile(missed, 0.95)) if len(missed) else float(
        np.abs(field.missed[:, 0]).max())
    cost = found.energy_integral_jm if detour else (
        weights.energy * found.energy_integral_jm + weights.length * found.length_m)
    if not np.isfinite(error) or goal.uncertainty(field, pair.plan.points[-1:])[0] > 0.0:
        return {"field_error_j": error if np.isfinite(error) else None, "lower_bound": None,
                "cost": cost, "gap_percent": None}
    lower = pair.certificate.lower - error * detour.longest if detour else (
        pair.certificate.lower * weights.length / (weights.length + weights.energy * error))
    return {"field_error_j": error, "lower_bound": max(lower, 0.0), "cost": cost,
            "gap_percent": 100.0 * (cost / lower - 1.0) if lower > 0.0 else None}


def _checked(field: EnergyField, path: ResolvedPath) -> dict[str, Any]:
    """Return the peak strain, and the field's error against the full model along the path."""
    solved = path.solved
    off = field.energy(solved.poses[:, :3]) - np.maximum(solved.energies, 0.0)
    return {"peak_strain": float(solved.strains.max()),
            "tip_end_m": solved.tips[-1],
            "field_energy_error": field_error(field, solved),
            "field_energy_error_max_j": float(np.abs(off).max()),
            "unsolved_count": path.unsolved_count}


def _on_field(field: EnergyField, points: np.ndarray) -> PathMeasures:
    fine = resample(points, STEP / 5)
    return measure_path(fine, field.energy(fine), np.linalg.norm(field.force(fine), axis=1))


def doubts_of(summary: dict[str, Any], field_error: float, *paths: ResolvedPath) -> list[str]:
    """Return warnings about a plan on a field with an allowed error of ``field_error`` [%]."""
    if summary["plan"]["length_m"] <= _STILL:
        return ["The start already lies in the goal. The path has no length, and there is no "
                "energy to save."]
    doubts: list[str] = [
        Text(f"Along the {label} path the energy field has an error of {error:.2g} % of the full "
             f"model's energy, which exceeds the limit of {most:g} %. Sample more poses with ",
             Command("energy", Option("samples")), ".")
        for key, label, most in (("baseline", "shortest", 15.0), ("plan", "gentle", field_error))
        if (error := 100.0 * summary[key]["field_energy_error"]) > most]
    gap = summary["certificate"]["gap_percent"]
    if gap is not None and gap > _WIDE_GAP:
        takes = "cost" if summary["certificate"].get("quantity", COST) == COST else "take"
        energy = "" if takes == "cost" else "energy "
        doubts.append(Text(
            f"The path may {takes} up to {gap:.1f} % more {energy}than the best possible one",
            *(".",) if summary["planner"] == "eikonal" else (
                "; `", Option("planner", "eikonal"), "` comes closest.")))
    unsolved = sum(path.unsolved_count for path in paths)
    if unsolved:
        doubts.append(f"{unsolved} poses along the shortest path had no acceptable solution. Its "
                      "measures exclude them.")
    return doubts


def _change(before: float, after: float, sign: int) -> float | None:
    return 100.0 * sign * (after / before - 1.0) if before > 0.0 else None
