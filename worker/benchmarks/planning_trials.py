"""Branches and trials of the planning bench: one start, limit or goal on a branch, and the rows.

Each returns values by name; one whose problem could not be solved has a failure.
"""

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.integrate import trapezoid
from scipy.optimize import minimize

from benchmarks.paper_branches import BRANCHES, FRACTIONS, PaperBranch
from benchmarks.table import Asked, Row
from benchmarks.trials import Trial, column, sound
from limber.cell.cell_file import Cell
from limber.core.errors import LimberError, NoPathError
from limber.core.numerics.rigid import curve_through, pose_vectors
from limber.core.progress import SILENT, Progress
from limber.geometry.generated import generate_branch
from limber.geometry.settings import GRASP_FRACTION
from limber.geometry.skeleton.skeleton import Skeleton, control_points
from limber.geometry.tets.tet_mesh import TetMesh, mark
from limber.geometry.tets.tetrahedra import mesh_branch
from limber.mechanics import BranchModel, young_weights
from limber.mechanics.loads.loaded_branch import hang
from limber.planning.baseline_and_plan import plan_pair
from limber.planning.constraints.chance import YoungUncertainty
from limber.planning.constraints.limits import Limits
from limber.planning.cost import CostWeights, arc_lengths, resample
from limber.planning.field.energy_field import EnergyField, limited
from limber.planning.field.grasp_model import GraspModel, grasp_model_of
from limber.planning.field.radial import LocalError
from limber.planning.field.sampling import solve_branch
from limber.planning.field.stored_states import States
from limber.planning.goals.goal import CellPlace, Goal, GoalRequest, grasp_goal
from limber.planning.goals.goal_kinds import default_goal, goal_of
from limber.planning.make_plan import PlannedMotion, plan_motion
from limber.planning.path_on_full_model import ResolvedPath, resolve_path
from limber.planning.path_problem import BlockedError, GentleProblem, random_start
from limber.planning.settings import PlanSpec
from limber.stages.paths.plan_cell import cell_positions

ARC_NAMES = tuple(branch.name for branch in BRANCHES)
_GRAVITY = (0.0, 0.0, -9.80665)
_DENSITY = 900.0


@dataclass(frozen=True)
class Subject:
    """A branch to plan on; ``shares`` [tets, K] of each control point in a tetrahedron's E."""

    name: str
    model: GraspModel
    shares: np.ndarray


def arcs() -> list[Subject]:
    """Return the paper's branches with its moduli, too soft to bear their own weight."""
    return [arc_of(branch=branch) for branch in BRANCHES]


def forked(seed: int, count: int, progress: Progress = SILENT) -> list[Subject]:
    """Return ``count`` drawn branches of wood, 0.4 to 0.7 m long with one to three twigs."""
    found = []
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        length = rng.uniform(0.4, 0.7)
        root = rng.uniform(0.010, 0.013) * length
        drawn = generate_branch(
            int(rng.integers(1 << 31)), length=length, radius_root=root, bend=rng.uniform(0.2, 0.7),
            radius_tip=rng.uniform(0.45, 0.7) * root, fork_count=int(rng.integers(1, 4)),
            young_mean=10 ** rng.uniform(8.5, 9.5))
        mesh = mesh_branch(drawn.skeleton).mesh
        found.append(_subject(f"forked {number + 1}", mesh, drawn.skeleton, drawn.young, 0.35,
                              _GRAVITY, progress))
    return found


def arc_of(slice_length: float = 2.0, sides: int = 6, branch: PaperBranch = BRANCHES[1],
           ) -> Subject:
    """Return one of the paper's branches, in slices of that many radii."""
    return _subject(branch.name, branch.mesh(slice_length=slice_length, sides=sides),
                    branch.skeleton, np.array(branch.young), branch.poisson, None)


def _subject(name: str, mesh: TetMesh, skeleton: Skeleton, young: np.ndarray, poisson: float,
             gravity: tuple[float, float, float] | None, progress: Progress = SILENT) -> Subject:
    mesh = mark(mesh, skeleton, young=1.0, poisson=poisson, density=_DENSITY)
    parts = young_weights(mesh, control_points(skeleton, FRACTIONS)) * young
    values = parts.sum(axis=1)
    mesh = mesh.with_data(cell_data={"young": values})
    model = BranchModel(mesh, young=values, poisson=poisson, density=_DENSITY, gravity=gravity)
    loaded = replace(hang(model, progress=progress),
                     grasp_point=tuple(map(float, skeleton.point_at(GRASP_FRACTION))))
    return Subject(name, grasp_model_of(loaded, skeleton), parts / values[:, None])


@dataclass(frozen=True)
class Start:
    """What a trial gets: a branch with its field, and the number and seed of a start on it.

    Attributes:
        subject: The branch.
        known: Its field.
        number: 0: from rest.
        seed: Of all draws.
        turn: Which of the quantities and kinds that take turns it is.
    """

    subject: Subject
    known: EnergyField
    number: int
    seed: int
    turn: int

    @property
    def model(self) -> GraspModel:
        return self.subject.model

    @property
    def goal(self) -> Goal:
        return default_goal(self.known, 0.01)

    def place(self, settings: PlanSpec) -> np.ndarray:
        """Where the plan starts [m], shape [3]."""
        return self.known.rest.copy() if self.number == 0 else random_start(
            self.known, self.goal, settings, self.seed)


def spread(values: np.ndarray, unit: str, digits: int = 1) -> str:
    """Median and worst, as text."""
    return f"{np.median(values):.{digits}f} / {values.max():.{digits}f}{unit}"


# --- whole plans ------------------------------------------------------------------------------

_OPTIMUM_STARTS = 3
_MODES = 7
_POINTS = 121  # of the quadrature; Simpson's rule
_PENALTY = 3e3  # on squared height above the sampled region, relative to the path's length


def run_trial(start: Start) -> dict[str, Any]:
    """Plan without limits, and with one that binds."""
    settings = PlanSpec(seed=start.seed)
    place = start.place(settings)
    values, learnt, path = _measure(start, place, settings)
    return values | _with_binding_force(start.model, learnt, place, path, settings)


def _measure(start: Start, place: np.ndarray, settings: PlanSpec,
             ) -> tuple[dict[str, Any], EnergyField, np.ndarray]:
    """Plan without limits; return values, the field at the end of planning, the path [n, 3]."""
    goal = start.goal
    motion = plan_motion(start.known, start.model, settings.model_copy(update={
        "start": tuple(map(float, place)), "goal": tuple(map(float, goal.region.middle)),
        "goal_tolerance": goal.tolerance}), workers=1)
    summary, learnt, rounds = motion.summary, motion.field, motion.summary["rounds"]
    certificate, scales = summary["certificate"], summary["weights"]
    weights = CostWeights(scales["deformation"], scales["distance"], scales["energy_scale_j"],
                          scales["length_scale_m"]).weights
    problem = GentleProblem(learnt, learnt.limited(), weights, place, goal)
    points = motion.plan.solved.poses[:, :3]
    cost, best = problem.cost(points), best_cost(problem, _OPTIMUM_STARTS, settings.seed)
    on_field = summary["paths_on_field"]
    gentle = on_field["eikonal"]
    others = {name: path for name, path in on_field.items()
              if name.startswith("RRT*") or name == "straight line"}
    return {
        "seconds": max(each["plan_seconds"] for each in rounds),
        "check_seconds": max(each["check_seconds"] for each in rounds), "rounds": len(rounds),
        "field_error": rounds[-1]["field_energy_error"],
        "first_field_error": rounds[0]["field_energy_error"],
        "gap": certificate["upper_bound"] / certificate["lower_bound"] - 1.0,
        "to_optimum": cost / best, "bound_to_optimum": certificate["lower_bound"] / min(best, cost),
        "seconds_to_close": min((level["seconds"] for level in certificate["levels"]
                                 if level["upper"] <= 1.02 * best), default=np.nan),
        "saved": {name: 100.0 * (1.0 - gentle["energy_integral_jm"] / path["energy_integral_jm"])
                  for name, path in others.items()},
        "added": {name: 100.0 * (gentle["length_m"] / path["length_m"] - 1.0)
                  for name, path in others.items()}}, learnt, points


def _with_binding_force(model: GraspModel, known: EnergyField, start: np.ndarray,
                        free: np.ndarray, settings: PlanSpec) -> dict[str, Any]:
    """Plan to the same end under a force halfway from the ends' largest to the free peak."""
    force = np.linalg.norm(known.force(resample(free, 0.002)), axis=1)
    ends = max(force[0], force[-1])
    cap = float(max(0.5 * (ends + force.max()), 1.1 * ends))
    bound = settings.model_copy(update={
        "max_force": cap, "start": tuple(map(float, start)), "iterations": 500,
        "goal": tuple(map(float, free[-1]))})
    try:
        motion = plan_motion(known, model, bound, workers=1)
    except NoPathError as error:
        return {"refused": error.seen}
    states = motion.plan.approach.joined(motion.plan.solved)
    moving, excess = motion.summary["in_motion"], np.inf
    # Not the states that accepted it: from rest, at half the spacing of the gripper's curve.
    passed = motion.plan.solved.poses[:, :3]
    arc = arc_lengths(passed)
    again = resolve_path(model, curve_through(arc, passed, np.linspace(
        0.0, arc[-1], 2 * len(arc))), motion.plan.approach.poses[:, :3])
    if again.is_whole:
        excess = max(states.force_sizes.max(), again.solved.force_sizes.max()) / cap - 1.0
    return {"accepted_after": len(motion.summary["rounds"]), "moving_seconds": moving["seconds"],
            "slowings": moving["slowings"], "excess": excess,
            "moving_ratio": moving["peaks"]["force_n"]["moving"] / cap}


def best_cost(problem: GentleProblem, starts: int, seed: int) -> float:
    """Return the least cost found; infinite if every path ends outside the allowed region.

    An independent method: many sine bulges, many starts, fine quadrature. It shares only the field
    with the planner: no polyline, no penalty rounds, no grid.
    """
    rng = np.random.default_rng([seed, 3])
    centre = problem.goal.centre(problem.energy_field)
    span = float(np.linalg.norm(centre - problem.start))
    best = np.inf
    for number in range(starts):
        bulge = np.zeros((_MODES, 3))
        bulge[0] = 0.0 if number == 0 else 0.2 * span * rng.normal(size=3)
        found = minimize(_cost, np.concatenate([bulge.ravel(), np.zeros(3)]), jac=True,
                         args=(problem, centre), method="L-BFGS-B",
                         options={"maxiter": 200, "maxcor": 20})
        best = min(best, problem.cost(_path(found.x, problem, centre)[0]))
    return best


def _path(unknown: np.ndarray, problem: GentleProblem, centre: np.ndarray, count: int = 400,
          ) -> tuple[np.ndarray, ...]:
    """Points [n, 3] of a path, its velocity, and the functions that they are linear in."""
    s = np.linspace(0.0, 1.0, count)
    modes = np.arange(1, _MODES + 1) * np.pi
    shape, slope = np.sin(s[:, None] * modes), modes * np.cos(s[:, None] * modes)
    bulge, end = unknown[:-3].reshape(_MODES, 3), unknown[-3:]
    size = float(np.linalg.norm(end))
    # Anywhere in the goal's ball: the last three unknowns, squashed.
    reach = problem.goal.tolerance * (1.0 - 1e-6)
    place = centre + reach * end / np.sqrt(1.0 + size**2)
    line = place - problem.start
    return (problem.start + s[:, None] * line + shape @ bulge, line + slope @ bulge, s, shape,
            slope, reach * (np.eye(3) - np.outer(end, end) / (1.0 + size**2))
            / np.sqrt(1.0 + size**2))


def _cost(unknown: np.ndarray, problem: GentleProblem, centre: np.ndarray,
          ) -> tuple[float, np.ndarray]:
    points, velocity, s, shape, slope, squash = _path(unknown, problem, centre, _POINTS)
    weights, field = problem.weights, problem.energy_field
    rule = np.ones(_POINTS)
    rule[1:-1:2], rule[2:-1:2] = 4.0, 2.0
    rule /= 3.0 * (_POINTS - 1)
    speed = np.sqrt((velocity**2).sum(axis=1) + 1e-16)
    height, upward = field.region.height_and_slope(points)
    over = np.maximum(height + 2e-5, 0.0)
    rate = weights.length + weights.energy * field.energy(points)
    scale = _PENALTY * weights.length**2
    value = float(rule @ (rate * speed + scale * over**2))
    to_point = rule[:, None] * (weights.energy * speed[:, None] * field.energy_gradient(points)
                                + 2.0 * scale * over[:, None] * upward)
    to_velocity = (rule * rate / speed)[:, None] * velocity
    to_bulge = shape.T @ to_point + slope.T @ to_velocity
    to_place = s @ to_point + to_velocity.sum(axis=0)
    return value, np.concatenate([to_bulge.ravel(), squash @ to_place])


# --- the paper's table: savings of a path at most 8.1 % longer than that of RRT* ---------------

SAVED, ADDED = 35.69, 8.10
"""Percent, means over the paper's three branches."""

AGAINST = ("RRT*, not smoothed", "RRT*", "straight line")
DETOUR_ROWS = (*(Asked(
    f"paper's arcs, --max-detour {ADDED}: saved against {name}",
    f"paper: {SAVED} %, {ADDED} % longer" if name == AGAINST[0] else "-") for name in AGAINST),
    Asked("there: points of saving that the certified optimum may still have, median / worst",
          "2"),
    Asked("there: certified gap of the energy within the length, median / worst", "3 / 6 %"),
    Asked("there: planning after the field, processor time, median / worst", "10 s median"))


def run_detour(start: Start) -> dict[str, Any]:
    """Plan within the paper's detour: savings [%], and the most points by which they could grow."""
    known, settings = start.known, PlanSpec(seed=start.seed, max_detour=ADDED)
    place, began = start.place(settings), time.process_time()
    pair = plan_pair(known, place, start.goal, settings, is_compared=True)
    seconds = time.process_time() - began
    own_length, own = _measured(pair.plan.points, known)
    assert pair.detour is not None
    found = {"seconds": seconds, "gap": 100.0 * pair.certificate.gap, "saved": {}, "added": {}}
    for name in AGAINST:
        if name in pair.compared:
            length, integral = _measured(pair.compared[name], known)
            found["saved"][name] = 100.0 * (1.0 - own / integral)
            found["added"][name] = 100.0 * (own_length / length - 1.0)
            if name == AGAINST[0]:
                found["below"] = 100.0 * (own - max(pair.detour.energy_bound, 0.0)) / integral
    return found


def detour_rows(trials: list[Trial]) -> list[Row]:
    """Return the rows of the paper's table."""
    good, table = sound(trials), []
    for row, name in zip(DETOUR_ROWS, AGAINST, strict=False):
        saved, added = saved_and_added(good, name)
        asked = name == AGAINST[0]
        table.append(Row(
            *row, f"{np.mean(saved):.1f} %, {np.mean(added):+.1f} % long, {len(saved)} of "
            f"{len(trials)} starts" if saved else "none",
            bool(saved and np.mean(saved) > SAVED) if asked else None, len(trials)))
    for row, name, unit, median, worst in zip(
            DETOUR_ROWS[3:], ("below", "gap", "seconds"), ("", " %", " s"), (2.0, 3.0, 10.0),
            (np.inf, 6.0, np.inf), strict=True):
        values = column([each for each in good if name in each.values], name)
        table.append(Row(*row, spread(values, unit, 1 if name == "seconds" else 2), bool(
            np.median(values) <= median and values.max() <= worst), len(values))
            if len(values) else Row(*row, "none", False, 0))
    return table


def saved_and_added(trials: list[Trial], name: str) -> tuple[list[float], list[float]]:
    """Savings and added lengths [%] of the trials that were compared with a path."""
    both = [(each["saved"][name], each["added"][name]) for each in trials if name in each["saved"]]
    return [saved for saved, _ in both], [added for _, added in both]


def _measured(path: np.ndarray, known: EnergyField) -> tuple[float, float]:
    fine = resample(path, 0.001)
    along = arc_lengths(fine)
    return float(along[-1]), float(trapezoid(known.energy(fine), along))


# --- limits near the feasible ones, hopeless ones, and stated errors ---------------------------

LIMITED = ("force", "strain", "energy", "axial_force")
"""Limited quantities, by their names in settings."""
_SLACK = 1e-3  # of a limit, that the path at other poses may be over it
_HOPELESS = 0.5  # of what the goal itself takes at least
_IN_GOAL = 4000  # poses in it that are looked at

NEAR_ROWS = (
    Asked("limits within 5 % of a known path's: false proofs", "0"),
    Asked("there: limits broken on the full model, solved again", "0"),
    Asked("there: feasible for sure and planned", "95 %"),
    Asked("there: processor time, median / worst", "10 s median"),
    Asked("hopeless limits: said, processor time, worst", "10 s"))
COVERED_ROW = Asked("stated 95 % errors at fresh poses: energy, force, strain, axial force covered",
                    "93-98 %")


_free_paths: dict[tuple[str, int], tuple[PlanSpec, dict[str, float]]] = {}


def _free_path(model: GraspModel, known: EnergyField, branch: str, seed: int,
               ) -> tuple[PlanSpec, dict[str, float]]:
    """Return settings with a random goal, and the peaks of the gentlest path to it, planned once
    for all limits."""
    if (branch, seed) in _free_paths:
        return _free_paths[branch, seed]
    free = PlanSpec(seed=seed, inertia=False, iterations=500, goal_tolerance=0.01)
    goal = random_start(known, grasp_goal(known.rest, 0.01), free, seed)
    asked = free.model_copy(update={"goal": tuple(map(float, goal))})
    peaks = _peaks(plan_motion(known, model, asked, workers=1).plan.ahead)
    return _free_paths.setdefault((branch, seed), (asked, peaks))


def run_near_limit(start: Start) -> dict[str, Any]:
    """Plan with a limit near the peak of a free path to a random goal, each quantity in turn.

    The free path, solved on the full model, shows which limits are surely feasible: those that it
    keeps. An accepted plan is solved again from rest at half the spacing; a proof that no path
    exists is false if the free path keeps the limit.

    Returns:
        ``share`` is the limit over the free path's peak; ``excess`` by how much it is exceeded.
    """
    name = LIMITED[start.number % len(LIMITED)]
    generator = np.random.default_rng([start.seed, start.number])
    # One goal for each of the limited quantities, on which the numbers take turns.
    asked, peaks = _free_path(start.model, start.known, start.subject.name, start.turn)
    share = float(generator.uniform(0.95, 1.05))
    limit = share * peaks[name]
    said, seconds, motion = _said(start, asked.model_copy(update={f"max_{name}": limit}))
    found = {"share": share, "said": said, "seconds": seconds, "excess": -1.0}
    if motion is not None:
        path = resample(motion.plan.solved.poses[:, :3], 0.0025)
        again = resolve_path(start.model, path, motion.plan.approach.poses[:, :3])
        found["excess"] = _peaks(again.ahead)[name] / limit - 1.0 if again.is_whole else np.inf
    if name == LIMITED[0]:
        # Off the low-energy surface forces differ a hundredfold: the least of many counts.
        there = grasp_goal(np.array(asked.goal), asked.goal_tolerance).guess(
            start.known, _IN_GOAL, np.random.default_rng(0))
        force = _HOPELESS * float(np.linalg.norm(start.known.force(there), axis=1).min())
        found["hopeless"], found["hopeless_seconds"], _ = _said(
            start, asked.model_copy(update={"max_force": force}))
    return found


def _said(start: Start, settings: PlanSpec) -> tuple[str, float, PlannedMotion | None]:
    """What planning says: planned, proven that there is no path, or not found; and its time [s]."""
    began, motion = time.process_time(), None
    try:
        motion, said = plan_motion(start.known, start.model, settings, workers=1), "planned"
    except LimberError as error:
        is_proven = isinstance(error, BlockedError) and error.is_proven
        said = "proven" if is_proven else "not found"
    return said, time.process_time() - began, motion


def _peaks(states: object) -> dict[str, float]:
    return {"force": float(states.force_sizes.max()), "energy": float(states.energies.max()),
            "strain": float(states.strains.max()),
            "axial_force": float(np.abs(states.axial_forces).max())}


def near_rows(trials: list[Trial]) -> list[Row]:
    """Return the rows of problems near the feasible limits."""
    good = sound(trials)
    if not good:
        return [Row(*asked, trials[0].failure if trials else "none", False, 0)
                for asked in NEAR_ROWS]
    sure = [one for one in good if one["share"] > 1.0]
    proven, solved = (sum(one["said"] == said for one in sure) for said in ("proven", "planned"))
    planned = [one for one in good if one["said"] == "planned"]
    broken = [one["excess"] for one in planned if one["excess"] > _SLACK]
    seconds, hopeless = column(good, "seconds"), [one for one in good if "hopeless" in one.values]
    slow = max((one["hopeless_seconds"] for one in hopeless), default=0.0)
    said = sum(one["hopeless"] != "planned" for one in hopeless)
    return [
        Row(*NEAR_ROWS[0], f"{proven} of {len(sure)}", not proven, len(sure)),
        Row(*NEAR_ROWS[1], f"{len(broken)} of {len(planned)}" + (
            f", worst {100 * max(broken):+.2f} %" if broken else ""), not broken, len(planned)),
        Row(*NEAR_ROWS[2], f"{solved} of {len(sure)}", solved >= 0.95 * len(sure), len(sure)),
        Row(*NEAR_ROWS[3], spread(seconds, " s"), bool(np.median(seconds) <= 10.0), len(good)),
        Row(*NEAR_ROWS[4], f"{said} of {len(hopeless)}, {slow:.1f} s",
            said == len(hopeless) and slow <= 10.0, len(hopeless))]


def coverage(model: GraspModel, known: EnergyField, count: int, seed: int,
             ) -> dict[str, tuple[int, int]]:
    """Return for each quantity at how many of ``count`` fresh trusted poses the field's
    overestimate is within its stated 95 % error, and the number of poses.
    """
    places = known.region.draw(count, np.random.default_rng(seed))
    good, _ = solve_branch(model, places, workers=1)
    fresh = States.joined(*(one.state for one in good))
    chart, inner = known.region.chart.plain, known.tested
    values, limits = fresh.sizes, Limits(**dict.fromkeys(LIMITED, 1e9))
    above, found = limits.above(known), {}
    for one in limited(known, limits.on(known)):
        error = LocalError.of(chart.map(known.samples.positions)[inner], above[one.name][inner],
                              0.95)
        off = one.size(fresh.positions) - values[one.name]
        kept = off <= error.at(chart.map(fresh.positions)) + 1e-12
        found[one.name] = int(kept.sum()), len(kept)
    return found


def covered_row(found: list[dict[str, tuple[int, int]]]) -> Row:
    """Return the row of the stated errors of several branches."""
    shares = {name: sum(one[name][0] for one in found) / max(sum(one[name][1] for one in found), 1)
              for name in found[0]}
    return Row(*COVERED_ROW, ", ".join(f"{name.replace('_', ' ')} {100 * share:.0f} %"
                                       for name, share in shares.items()),
               all(share >= 0.93 for share in shares.values()),
               sum(one["energy"][1] for one in found))


# --- goals in regions -------------------------------------------------------------------------

_KINDS = (0.005, 0.05, 0.3, 1.0, "second_arm", "view")
"""Radii of balls [m], and regions that a cell gives."""
_SHARES = (0.2, 0.8)
_TRIES = 60
_POSES = 400
_FAR = 5.0  # [m] to where nothing reaches

GOAL_ROWS = (
    Asked("goals of the tip: balls of 5 mm to 1 m, second arm, view, reachable: planned",
          "60 of 60"),
    Asked("there: processor time, median / worst", "-"),
    Asked("unreachable: refused with its reason", "20 of 20"))


def run_region_goal(start: Start) -> dict[str, Any]:
    """Draw a goal of a kind, plan to it from outside, and try one out of reach.

    A region is drawn so that its border passes near a position that the tip has in a state of the
    full model, a sample of the field: so it is reachable. A fraction of the poses, 20 to 80 % for
    large regions, is inside.
    """
    # Seeds of six branches at one number, and of six numbers on one branch, give every kind.
    kind, known, model = _KINDS[start.seed % len(_KINDS)], start.known, start.model
    found: dict[str, Any] = {"kind": str(kind), "said": ""}
    try:
        settings, cell, place = _drawn(kind, known, model, np.random.default_rng(
            [start.seed, start.number]))
    except LimberError:
        return found | {"kind": ""}
    began = time.process_time()
    try:
        motion = plan_motion(known, model, settings.model_copy(update={
            "start": tuple(map(float, place))}), cell=cell, workers=1)
        found["planned"] = motion.summary["plan"]["length_m"] > 0.0
    except LimberError as error:
        found |= {"planned": False, "said": f"{type(error).__name__}: {error}"}
    return found | {"seconds": time.process_time() - began, "refused": _refused(kind, known, model)}


def _drawn(kind: float | str, known: EnergyField, model: GraspModel, generator: np.random.Generator,
           ) -> tuple[PlanSpec, dict[str, CellPlace], np.ndarray]:
    """Return settings, the cell's places and a start outside the goal."""
    points = known.region.draw(_POSES, generator)
    reached = known.samples.tips[known.region.contains(known.samples.positions)]
    for _ in range(_TRIES):
        settings, cell = _asked(kind, reached, generator)
        try:
            goal = goal_of(GoalRequest(known, model, settings, known.limited(), cell))
        except NoPathError:
            continue
        away = goal.excess(known, points)
        share = float((away <= 0.0).mean())
        low, high = (0.0, 1.0) if kind in (0.005, 0.05) else _SHARES
        if low <= share <= high and away.max() > 0.005:
            return settings, cell, points[int(np.argmax(away))]
    raise NoPathError(f"{_TRIES} regions of kind {kind} had no fitting share of poses.")


def _asked(kind: float | str, tips: np.ndarray, generator: np.random.Generator,
           ) -> tuple[PlanSpec, dict[str, CellPlace]]:
    place = tips[generator.integers(len(tips))]
    outward = generator.normal(size=3)
    outward /= np.linalg.norm(outward)
    common = {"inertia": False, "iterations": 500}
    if not isinstance(kind, str):
        # Its border is a little behind a position that the tip reaches.
        centre = place + (kind - min(0.5 * kind, 0.01)) * outward
        return PlanSpec(tip_goal=tuple(map(float, centre)), goal_tolerance=kind, **common), {}
    settings = PlanSpec(goal_in=kind, **common)
    return settings, cell_positions(_cell(kind, place, generator.uniform(0.0, 2.0 * np.pi),
                                          generator.uniform(0.75, 1.0)))


def _cell(kind: str, place: np.ndarray, turn: float, far: float) -> Cell:
    """Return a cell with a second arm, or camera, ``far`` [m] sideways from a position."""
    aside = np.array([np.cos(turn), np.sin(turn), 0.0])
    stand = {"robot": {"model": "ur5e"}, "base": {"pose": (0.0,) * 6}}
    if kind == "second_arm":
        base = place - far * aside
        return Cell(**stand, second_arm={"model": "ur5", "base_pose": (
            float(base[0]), float(base[1]), 0.0, 0.0, 0.0, 0.0)})
    # Camera axes: x right, y down, z ahead.
    frame = np.eye(4)
    frame[:3, 0], frame[:3, 1], frame[:3, 2] = np.cross([0, 0, -1.0], aside), [0, 0, -1.0], aside
    frame[:3, 3] = place - far * aside
    return Cell(**stand, camera={"mount": "branch", "pose": tuple(map(
        float, pose_vectors(frame))),
                                 "range_m": (0.2, far + 0.01)})


def _refused(kind: float | str, known: EnergyField, model: GraspModel) -> str:
    """Return why a goal out of reach is refused; empty if it is not."""
    place = known.tip(known.rest[None])[0] + [_FAR, 0.0, 0.0]
    settings, cell = _asked(kind, place[None], np.random.default_rng(0))
    if kind == "view":
        cell = cell_positions(_cell("view", place, 0.0, 1.0))
    try:
        plan_motion(known, model, settings, cell=cell, workers=1)
    except LimberError as error:
        return error.seen
    return ""


def goal_rows(trials: list[Trial]) -> list[Row]:
    """Return the rows of goals in regions."""
    drawn = [one for one in trials if one["kind"]]
    if not drawn:
        return [asked.not_shown() for asked in GOAL_ROWS]
    failed = [f"{one.task[0]} {one['kind']}: {one['said']}" for one in drawn if not one["planned"]]
    refused = sum(bool(one["refused"]) for one in drawn)
    return [
        Row(*GOAL_ROWS[0], f"{sum(one['planned'] for one in drawn)} of {len(drawn)}" + "".join(
            f"; {one[:160]}" for one in failed[:3]), not failed, len(drawn)),
        Row(*GOAL_ROWS[1], spread(column(drawn, "seconds"), " s"), None, len(drawn)),
        Row(*GOAL_ROWS[2], f"{refused} of {len(drawn)}", refused == len(drawn), len(drawn))]


# --- limits kept with a probability -----------------------------------------------------------

CONFIDENCE = 0.95
_DEVIATION = 0.12  # of log E at each control point: an interval of about -21 to +27 %
_NEIGHBOUR = -0.4  # correlation of neighbours, as fits have it
_EVERY = 4  # pose of the motion is asked under each draw, and the one with most force
_LOW = 0.6  # of the limit: a pose of less force breaks it under no likely draw
_TIGHT = (0.5, 0.75, 0.9, 1.0)
"""Position of the limit between the force that the goal itself needs and the peak of the unlimited
motion, each with the confidence: the first with a plan is used.
"""
SURE_ROW = Asked(f"force limit kept at --confidence {CONFIDENCE}, each draw on the full model",
                 "90 to 100 %")


def run_sure(start: Start, draws: int) -> dict[str, Any]:
    """Plan from rest under a force that binds, with confidence; draw moduli, solve the motion.

    Returns:
        ``kept`` is the fraction of draws, each solved on the full model, that keep the limit;
        ``before`` the same by the risk of the plan for the estimate alone; ``tight`` the element
        of ``_TIGHT`` for the limit.
    """
    unknown = uncertainty_of(start.subject)
    motion, cap, tight = _sure_plan(start, unknown, PlanSpec(
        seed=start.seed, iterations=500, goal=tuple(map(float, start.goal.region.middle)),
        goal_tolerance=start.goal.tolerance))
    states = motion.plan.approach.joined(motion.plan.solved)
    high = np.flatnonzero(states.force_sizes > _LOW * cap)
    chosen = np.unique([*high[::_EVERY], *high[-1:], int(states.force_sizes.argmax())])
    generator = np.random.default_rng([start.seed, 5])
    kept = [unknown.solved(start.model, unknown.draw(generator), states.take(chosen)
                           ).force_sizes.max() <= cap for _ in range(draws)]
    return {"kept": float(np.mean(kept)), "tight": tight,
            "before": motion.summary["confidence"]["of_a_plan_for_the_estimate"]}


def _sure_plan(start: Start, unknown: YoungUncertainty, settings: PlanSpec,
               ) -> tuple[PlannedMotion, float, float]:
    """Return a plan with confidence under a force limit that binds, the limit [N], its place.

    Raises:
        NoPathError: there is none under any of the limits tried.
    """
    free = plan_motion(start.known, start.model, settings, workers=1)
    states = free.plan.approach.joined(free.plan.solved)
    likely = _likely_forces(unknown, start.subject, states)
    end = tuple(map(float, free.plan.solved.poses[-1, :3]))
    for tight in _TIGHT:
        cap = float(max(likely[-1] + tight * (likely.max() - likely[-1]), 1.02 * likely[-1]))
        try:
            return plan_motion(free.field, start.model, settings.model_copy(update={
                "max_force": cap, "confidence": CONFIDENCE, "goal": end}), uncertainty=unknown,
                               workers=1), cap, tight
        except NoPathError:
            if tight == _TIGHT[-1]:
                raise
    raise AssertionError("the last limit either has a plan or raises")


def _likely_forces(unknown: YoungUncertainty, subject: Subject, states: States) -> np.ndarray:
    """Return the largest force [N] that each state takes with the confidence, shape [n]."""
    peak = states.force_sizes.max()
    found = unknown.exposure(subject.model, ResolvedPath(
        states, states.take(np.arange(1)), np.empty((0, 3)), (), True), Limits(force=2.0 * peak))
    return states.force_sizes * found.risk(unknown.covariance, CONFIDENCE).factors["force"]


def uncertainty_of(subject: Subject) -> YoungUncertainty:
    """Return a posterior like an estimate's: the same deviation at each control point."""
    count = subject.shares.shape[1]
    near = np.abs(np.subtract.outer(np.arange(count), np.arange(count))) == 1
    return YoungUncertainty(subject.shares, np.full(count, _DEVIATION),
                            np.eye(count) + _NEIGHBOUR * near)


def sure_rows(trials: list[Trial], draws: int) -> list[Row]:
    """Return the row of limits kept with confidence."""
    good = sound(trials)
    troubles = "; ".join(f"{one.task[0]}: {one.failure}" for one in trials if one.failure)
    if not good:
        return [Row(*SURE_ROW, troubles, False, len(trials))]
    kept, before, tight = (100.0 * column(good, name) for name in ("kept", "before", "tight"))
    return [Row(
        *SURE_ROW, f"{kept.min():.0f} to {kept.max():.0f} %, mean {kept.mean():.1f}, of {draws} "
        f"draws each; {len(good)} of {len(trials)} branches, limit at {tight.min():.0f} to "
        f"{tight.max():.0f} % of the way from what the goal needs to what the free motion "
        f"takes; planned for the estimate alone {before.min():.0f} to {before.max():.0f}"
        + (f"; {troubles}" if troubles else ""),
        bool(kept.min() >= 90.0 and len(good) == len(trials)), len(trials))]
