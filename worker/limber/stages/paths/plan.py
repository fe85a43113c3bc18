"""Stage ``plan``."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from limber.core.errors import (
    BranchFolderError,
    Cancelled,
    Command,
    InputError,
    NoPathError,
    Option,
    Text,
)
from limber.core.files.atomic import file_digest
from limber.core.progress import Progress
from limber.planning.settings import PlanSettings
from limber.stages.result import (
    FORCE,
    POSE,
    Picture,
    Result,
    Table,
    drawn,
    filled,
    frozen,
    of_files,
    shown,
)
from limber.stages.stage import About, PlacedStage, Repeatable, given
from limber.store import Branch, OpenStage

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from limber.cell.cell_file import Cell
    from limber.cell.obstacles import Obstacle
    from limber.planning.constraints.limits import Limits
    from limber.planning.field.grasp_model import GraspModel
    from limber.planning.goals.goal import CellPlace
    from limber.planning.make_plan import PlannedMotion
    from limber.planning.plan_file import PlanPath
    from limber.planning.timing import Pace
    from limber.results.report.section import Section


_FRAME_RATE = 24.0  # frames per second of the played motion; a pose is a frame


class PathNumbers(Result):
    """What a path costs on the full model."""

    keys: ClassVar = {"peak_strain": "peak_strain"}
    length: float | None = shown("path length", ".4g m")
    energy_integral: float | None = shown("energy along the path", ".4g J m")
    energy_sum: float | None = shown("sum of energy, 5 mm steps", ".4g N mm")
    peak_energy: float | None = shown("peak energy", ".4g J")
    peak_force: float | None = shown("peak force", ".4g N")
    peak_strain: float | None = shown("largest strain", ".4g m/m")


class Plan(Result):
    """A gentle path of the grasp and the shortest one, both computed with the full model.

    >>> plan = limber.open("a.branch").results["plan:to-goal"]
    >>> plan.path.shape[1], plan.bound <= plan.cost
    (6, True)
    """

    heading = "Paths: {name}"
    missing = "limber plan NAME.branch"
    pictures = (Picture("plan_figures.paths_over_slice", "", ("field", "file")),)
    columns: ClassVar = {"times": "time_s", "path": POSE, "energies": "energy_j", "forces": FORCE,
                         "strains": "strain"}

    name: str = shown("name", meaning="name of its files")
    length: float = shown("length", ".1f mm")
    energy: float = shown("energy", ".3g J m", meaning="energy integrated along the gentle path "
                                                       "[J m]")
    energy_saved: float | None = shown("saved", ".1f percent",
                                       meaning="energy saved relative to the shortest path [%]")
    peak_force: float = shown("peak force", ".3g N")
    gap: float | None = shown(
        "cost above the best path, at most", ".2g percent", meaning="largest cost of the gentle "
        "path above that of the best one [%]; None if unknown")
    cost: float = of_files(
        "cost of the gentle path on the energy field, dimensionless: the planner weighs energy and "
        "length, each over its scale. With a ``max_detour``: the energy along it [J m]")
    bound: float = of_files("lower bound of the cost of any path, dimensionless or [J m] as the "
                            "cost: the certificate")
    path: np.ndarray = of_files("poses along the gentle path: position [m], rotation vector [rad], "
                                "shape [n, 6]")
    times: np.ndarray = of_files("[s], shape [n]")
    energies: np.ndarray = of_files("above the rest shape [J], shape [n]")
    forces: np.ndarray = of_files("forces of the gripper on the branch [N], shape [n, 3]")
    strains: np.ndarray = of_files("largest strain in the branch, shape [n]")
    shortest_path: np.ndarray = of_files("poses along the shortest path [m, rad], shape [k, 6]")
    file: Any = of_files("the plan's file, a :class:`limber.planning.plan_file.PlanFile`")
    field: Any = of_files("the fitted energy field")
    damage: Any = of_files("the strains along the branch; None in a folder of an older version")

    def of_folder(self, branch: Branch, key: str) -> dict[str, Any]:
        from limber.planning.constraints.damage import DamageAlong
        from limber.planning.field.energy_field import EnergyField
        from limber.planning.plan_file import read_plan

        name = key.partition(":")[2]
        damage = f"plans/{name}-damage.csv"
        found = read_plan(branch.path(f"plans/{name}.json"))
        path, gentle, proof = found.plan, self.values["plan"], self.values["certificate"]
        return {"name": name, "length": gentle["length_m"], "energy": gentle["energy_integral_jm"],
                "peak_force": gentle["peak_force_n"], "gap": proof["gap_percent"],
                "cost": float(frozen(proof["upper_bound"])), "bound": proof["lower_bound"],
                "path": frozen(path.poses), "times": frozen(path.times),
                "energies": frozen(path.energies), "forces": frozen(path.forces),
                "strains": frozen(path.strains), "shortest_path": frozen(found.baseline.poses),
                "file": found, "field": EnergyField.read(branch.path("energy.npz")),
                "damage": DamageAlong.read(branch.path(damage)) if branch.has(damage) else None}

    def tables(self) -> list[Table]:
        from limber.results.report.report_tables import leg_rows

        return filled(
            ("Both paths, on the full model", self.comparison()),
            ("The whole motion, leg by leg", leg_rows(self.values.get("legs", []))))

    def comparison(self) -> list[list[str]]:
        """Return the shortest against the gentle path, and below what is known of the latter alone;
        a last column states which limits of arm or wood are exceeded, if any."""
        from limber.results.findings import remarks_on

        plan, remarks = self.values, remarks_on(self.values)
        rows = PathNumbers.of(plan["baseline"]).against(
            PathNumbers.of(plan["plan"]), ("shortest", "gentle"),
            {key.removesuffix("_n"): remark for key, remark in remarks.items()})
        below = []
        if (gap := (plan.get("certificate") or {}).get("gap_percent")) is not None:
            words = "energy above the gentlest within the length" if plan.get("detour") else (
                "cost above the best possible path's")
            below.append([f"{words}, at most [%]", f"{gap:.1f}"])
        if strength := plan.get("strength"):
            share = strength["peak_strain"] / strength["median_strain"]
            below.append([f"largest strain over that at break ({strength['source']})",
                          f"{share:.2g}"])
            if (damage := strength["damage_probability"]) is not None:
                below.append(["probability of damage [%]", f"{100 * damage:.2g}"])
        empty = [""] * (len(rows[0]) - 3)
        return rows + [[title, "", value, *empty] for title, value in below]

    def sentences(self, branch: Branch) -> list[str]:
        from limber.results.findings import plan_sentences

        return plan_sentences(self.values)

    def plot_damage(self) -> Figure:
        """Draw where along the branch the gentle path would damage it, and how probably.

        Raises:
            InputError: the plan is of a version that did not compute it.
        """
        from limber.results.report.figures import damage_along_branch

        if self.damage is None:
            raise InputError(f"The plan {self.name} has no strains along the branch.",
                             "An older version of Limber made it.", "Plan again with force=True.")
        return drawn(lambda: damage_along_branch(self.damage))

    def plot_along(self) -> Figure:
        """Draw energy, force and strain over the length of both paths."""
        from limber.results.report.plan_figures import along_paths

        return drawn(lambda: along_paths(self.file))

    def section(self, branch: Branch, key: str) -> Section:
        from limber.results.findings import beyond_sentence, certificate_sentence
        from limber.results.report import plan_figures
        from limber.results.report.section import Section

        plan = self.file.summary
        section = Section(self.heading.format(name=self.name), tables=self.tables())
        saved, added = plan["energy_saved_percent"], plan["length_added_percent"]
        section.text.append((
            "The start is inside the goal, so the paths have no length and no energy can be saved."
            if saved is None or added is None else
            f"The gentle path saves {saved:.1f} % of the energy along the path and changes the "
            f"length by {added:+.1f} %.") + f" Seed {plan['seed']}.")
        section.text.append(certificate_sentence(plan))
        if moving := plan.get("in_motion"):
            peaks = ", ".join(f"{key} {peak['moving']:.3g} ({peak['standing']:.3g} quasi-static)"
                              for key, peak in moving["peaks"].items())
            section.text.append(
                "A simulation over time on the full model, with inertia and at "
                f"{1e3 * moving['speed_m_s']:.0f} mm/s, keeps all limits. Peaks: {peaks}.")
        section.text += filter(None, [beyond_sentence(plan)])
        for figure, caption in plan_figures.report_figures(branch, self.name):
            section.draw(figure, caption)
        return section


def _found_lines(values: Mapping[str, Any]) -> str:
    from limber.results.findings import modulus_origin

    branch = Branch.read(values["branch_folder"])
    origin = modulus_origin(branch)
    return "\n".join([*Plan.of(values).sentences(branch), *(
        [] if origin == "estimated" else [f"All this holds for Young's modulus as {origin}."])])


class PlanPaths(PlanSettings, Repeatable, PlacedStage):
    """Plan the shortest and the gentlest path to a goal, and compare them.

    The field is used for the search only. All reported energies, forces and strains are computed by
    finite elements along the paths found; the error of the field is reported beside them.
    """

    about = About(
        "plan", 100, Plan, key="plan:{name}", reads=("mesh.vtu", "energy.npz"),
        writes=("plans/{name}.json", "plans/{name}.csv", "plans/{name}-baseline.csv",
                "plans/{name}-motion.csv", "plans/{name}-setpoints.csv", "plans/{name}-trees.csv",
                "plans/{name}-damage.csv", "plans/{name}-bound.npz", "frames/{name}.pc2",
                "frames/{name}.json", "frames/{name}.npz"),
        found=(_found_lines,), then="limber report {branch_folder}", step="plan",
        label="Plan Path")
    common: ClassVar[tuple[str, ...]] = ("coordinates",)

    cell: Path | None = given(
        "The robot's cell file. Its workspace, force limit and obstacles apply, and its arm must "
        "reach the whole path.", common=True)
    break_tests: Path | None = given(
        "CSV of break tests on shoots of the same plant: a column strain_at_break (0.05 is 5 %). "
        "They state the branch's strength.")
    name: str = given("Name of the plan's files.", "path", group="output", common=True)

    def run_in_branch(self, progress: Progress) -> dict[str, Any]:
        """Plan paths on the branch's energy field.

        Writes ``plans/NAME.json``, CSV files of both paths, the whole motion, its poses at the
        controller's rate and the search trees, and the frames.

        Raises:
            BranchFolderError: there is no energy field, or one of another geometry or material.
            InputError: the name is invalid, the start is not allowed, or there are two goals.
            NoPathError: there is no path; the message gives the reason.
            Cancelled: the best result so far was kept, if there was one and no finished plan of
                that name.
        """
        from limber.planning.constraints.damage import DamageAlong, assumed_strain
        from limber.planning.constraints.limits import Limits
        from limber.planning.field.energy_field import EnergyField
        from limber.planning.field.sampling import energy_inputs
        from limber.planning.make_plan import plan_motion
        from limber.planning.plan_file import whole_motion
        from limber.planning.timing import Pace
        from limber.stages.paths.plan_cell import legs_without_cell
        from limber.stages.paths.plan_strength import (
            default_limit,
            strength_for,
            strength_of_plan,
            with_damage,
        )
        from limber.stages.paths.plan_tables import SETPOINT_RATE, setpoints
        from limber.stages.paths.plan_uncertainty import young_uncertainty
        from limber.store.loading import known_damping, load_grasp_model, load_skeleton

        name, key, reads = self.name, self.entry, ["energy.npz"]
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", name) or name.endswith(
                ("-baseline", "-bound", "-damage", "-motion", "-setpoints", "-trees")):
            raise InputError(Text(Option("name"), f" {name!r} cannot name a plan."),
                             "It becomes part of file names, and -baseline, -bound, -damage, "
                             "-motion, -setpoints and -trees are reserved.",
                             "Use letters, digits, dash, dot and underscore.")
        branch = Branch.open(self.branch_folder)
        field_path = branch.require("energy.npz", "energy")
        energy_stage = branch.manifest.stages["energy"]
        gravity = bool(energy_stage.settings.get("gravity", True))
        grasp_model = load_grasp_model(branch, gravity=gravity, progress=progress)
        field = EnergyField.read(field_path)
        digests = energy_inputs(grasp_model)
        if any(energy_stage.reads.get(name) != digest for name, digest in digests.items()):
            raise BranchFolderError(
                "The energy field belongs to another mesh, material, weight or set of targets.",
                Text("The branch was meshed or estimated again, or its targets changed, after ",
                     Command("energy"), " ran."),
                "Run ", Command("energy"), " again.")
        grasp_model = grasp_model.damped(known_damping(branch))
        stiffer = _stiffer(branch) if self.max_stress else 1.0
        digests |= {"damping": repr(grasp_model.model.damping), "stiffer": f"{stiffer:.6f}"}
        strength = strength_for(branch, self, self.break_tests)
        if self.break_tests is not None:
            digests = digests | {"break tests": file_digest(self.break_tests)}
        young = float(np.median(grasp_model.model.young))
        asked = with_damage(Limits.of(self, stiffer), self, strength, young)
        if np.isfinite(asked.strain):
            digests = digests | {"strain": f"{asked.strain:.6g}"}
        uncertainty = None if self.confidence is None else young_uncertainty(
            branch, grasp_model, asked)
        if self.turn_slack is not None and self.cell is None:
            raise InputError(Text(Option("turn_slack"), " is given without ", Option("cell"), "."),
                             "It is the arm in the cell that may not let the gripper turn with the "
                             "branch.",
                             "Give ", Option("cell"), ", or omit ", Option("turn_slack"), ".")
        in_cell = None
        if self.cell is not None:
            in_cell = InCell.of(branch, self.cell, asked, progress, self, grasp_model)
            digests = digests | {"cell": file_digest(self.cell)}
        earlier = branch.manifest.stages.get(key)
        finished = earlier is not None and not earlier.result.get("stopped")
        if earlier is not None and finished and self.is_kept(branch, reads=reads, digests=digests):
            return earlier.result
        if in_cell is not None:
            in_cell.check_goal(self)
        with branch.stage(key, self, reads=reads, digests=digests) as stage:
            limits = asked if in_cell is None else in_cell.limits
            pace = Pace(self.speed) if in_cell is None else in_cell.slowed(
                Pace(self.speed), progress)
            try:
                found = plan_motion(
                    field,
                    grasp_model,
                    self,
                    limits=limits,
                    cell=None if in_cell is None else in_cell.positions,
                    uncertainty=uncertainty,
                    pace=pace,
                    progress=progress,
                )
            except NoPathError as error:
                limited = default_limit(limits, self, strength)
                raise type(error)(error.seen, error.why, error.fix,
                                  *([" ", limited] if limited else [])) from error
            if limited := default_limit(limits, self, strength):
                progress.warn(limited)
            if found.summary["stopped"]:
                progress = progress.to_the_end()
            if found.summary["stopped"] and finished:
                raise Cancelled("The search was stopped.", f"The finished plan {name} is kept.",
                                "Run it again when there is time for it.")
            # A user who limits the strain knows the wood: no strength is assumed.
            if strength is not None or (self.max_strain is None and assumed_strain(young)):
                found.summary["strength"] = strength_of_plan(
                    strength, found.plan, found.summary.get("in_motion"), progress)
            pace = found.pace
            motion = whole_motion(found.plan, tuple(t.name for t in grasp_model.branch.targets),
                                  pace)
            if in_cell is None:
                found.summary["legs"] = legs_without_cell(motion, self.hold)
            else:
                progress(0.95, "inverse kinematics")
                found.summary.update(in_cell.taken(motion, grasp_model, found, self, progress))
            progress(0.95, "writing")
            rate = SETPOINT_RATE if in_cell is None else in_cell.cell.arm.rate
            found.summary["setpoint_rate_hz"] = rate
            stage.write(f"plans/{name}-setpoints.csv", setpoints(motion, pace, rate))
            _write(stage, name, limits, pace, motion, grasp_model, found)
            with open(stage.path(f"plans/{name}-damage.csv"), "w", encoding="utf-8") as stream:
                DamageAlong.of(grasp_model, load_skeleton(branch), found.plan.ahead.displacements,
                               strength).write(stream)
            stage.result.update(found.summary)
        result = branch.manifest.stages[key].result
        if result["stopped"]:
            gap = result["certificate"]["gap_percent"]
            near = "gap to the best possible unknown" if gap is None else (
                f"at most {gap:.2g} % above the best possible")
            raise Cancelled("The search was stopped.",
                            f"The best path so far ({near}) was checked on the full model and "
                            f"stored as plan {name}.", "Run it again to close the bound.")
        progress(1.0, "planned")
        return result


@dataclass(frozen=True)
class InCell:
    """A cell, and its limits."""

    cell: Cell
    obstacles: tuple[Obstacle, ...]
    limits: Limits
    positions: dict[str, CellPlace]
    clearance: float

    @classmethod
    def of(cls, branch: Branch, path: Path, limits: Limits, progress: Progress,
           settings: PlanSettings, grasp_model: GraspModel) -> InCell:
        from limber.cell.obstacles import cell_obstacles
        from limber.cell.reach_and_collision import clearance_in
        from limber.robot.depth_camera import look
        from limber.stages.paths.plan_cell import cell_for, cell_positions, is_fixed, limits_in

        cell = cell_for(branch, path, progress)
        obstacles = cell_obstacles(cell, path.parent)
        nodes = grasp_model.mesh.nodes + grasp_model.rest.displacement
        clearance = clearance_in(cell, settings.clearance, obstacles, grasp_model.rest_position,
                                 nodes)
        is_seen = settings.goal_in == "view" and is_fixed(cell.camera)
        live = look(cell, nodes, progress) if is_seen else None
        return cls(cell, obstacles, limits_in(cell, limits, obstacles, clearance),
                   cell_positions(cell, obstacles, live), clearance)

    def taken(self, motion: PlanPath, grasp_model: GraspModel, found: PlannedMotion,
              settings: PlanSettings, progress: Progress) -> dict[str, Any]:
        """Return a plan's entries about its robot, the clearance, the legs of its motion, and how
        the gripper turns if not with the branch. NoPathError, with the place, without a continuous
        branch of the inverse kinematics, or if the gripper meets an obstacle."""
        from limber.cell.reach_and_collision import blocked_by
        from limber.robot.motion.execution import robot_motion
        from limber.stages.paths.plan_cell import (
            legs_in_cell,
            predicted_ahead,
            robot_summary,
            surface_points,
        )

        predicted, states, turning = predicted_ahead(motion), found.plan.ahead, None
        asked: dict[str, Any] = {"speed": found.pace.speed, "blocked": blocked_by(
            self.cell, self.obstacles, self.clearance)}
        try:
            taken = robot_motion(self.cell, predicted, grasp_model.reach.axis, **asked)
        except NoPathError:
            if settings.turn_slack is None:
                raise
            from limber.stages.paths.plan_cell import turned_by

            progress(0.95, "turning the gripper beyond the branch's own rotation")
            held, turning = turned_by(self.cell, predicted, grasp_model, states,
                                      settings.turn_slack, self.limits, **asked)
            taken = held.motion
        return {"robot": robot_summary(self.cell, taken), "clearance_m": self.clearance,
                "turning": turning, "legs": legs_in_cell(
                    self.cell, self.obstacles, taken, states.poses[:, :3],
                    surface_points(grasp_model.mesh, states.displacements), settings.hold,
                    progress)}

    def slowed(self, pace: Pace, progress: Progress) -> Pace:
        """Return the pace, no faster than the cell allows."""
        from limber.robot.motion.trajectory import speed_within

        most = self.cell.limits
        return replace(pace, speed=speed_within(self.cell, min(pace.speed, most.speed_m_s),
                                                progress.warn),
                       acceleration=min(pace.acceleration, most.acceleration_m_s2))

    def check_goal(self, settings: PlanSettings) -> None:
        """Raise NoPathError if the given goal is inside an obstacle."""
        from limber.cell.obstacles import closest
        from limber.planning.goals.goal_kinds import asked_kinds

        requested = [getattr(settings, kind.name) for kind in asked_kinds(settings)
                     if kind.is_place]
        for name in requested:
            hit = closest(self.obstacles, np.array([name], float), self.clearance)
            if hit:
                inside = hit[1] - self.clearance
                raise NoPathError(
                    f"The goal lies {1e3 * inside:.1f} mm inside {hit[0]}." if inside >= 0.0 else
                    f"The goal lies {-1e3 * inside:.1f} mm from {hit[0]}, nearer than the "
                    f"clearance of {1e3 * self.clearance:.1f} mm.",
                    "The branch cannot be moved there.",
                    "Choose another goal, or correct the obstacle in the cell file.")


def _stiffer(branch: Branch) -> float:
    """Return the largest ratio of Young's modulus to its estimate, by the widest interval;
    InputError if one has no upper end."""
    if "estimate" not in branch.manifest.stages:
        return 1.0
    result = branch.manifest.stages["estimate"].result
    highest = np.array(result["young_interval_pa"], float)[:, 1]
    share = highest / np.array(result["young_pa"], float)
    if not np.isfinite(share).all():
        raise InputError(Text(Option("max_stress"), " was given, but the estimate has no upper "
                              "limit for the stiffness."),
                         "A stiffer branch has more stress at the same pose.",
                         "Record another pull, or limit ", Option("max_strain"), " instead.")
    return float(np.max(share, initial=1.0))


def _write(stage: OpenStage, name: str, limits: Limits, pace: Pace, motion: PlanPath,
           grasp_model: GraspModel, found: PlannedMotion) -> None:
    from limber.mechanics.strain import strain_state
    from limber.planning.plan_file import limits_of_motion, path_record, plan_content
    from limber.results.motion_files import surface_fields, write_pc2
    from limber.stages.paths.plan_tables import motion_table, path_table, trees_table

    names = tuple(target.name for target in grasp_model.branch.targets)
    baseline, plan = (path_record(path.solved, names, pace=pace,
                                  field_energies=found.field.energy(path.solved.poses[:, :3]))
                      for path in (found.baseline, found.plan))
    stage.write(f"plans/{name}.json", plan_content(
        found.summary, baseline, plan, motion, limits_of_motion(motion, limits), pace))
    stage.write(f"plans/{name}.csv", path_table(plan))
    stage.write(f"plans/{name}-baseline.csv", path_table(baseline))
    stage.write(f"plans/{name}-motion.csv", motion_table(motion))
    stage.write(f"plans/{name}-trees.csv", trees_table(found.trees))
    if found.to_go is not None:
        found.to_go.write(stage.path(f"plans/{name}-bound.npz"))
    displacements = found.plan.solved.displacements
    vertices = np.unique(grasp_model.mesh.surface_faces())
    frames = grasp_model.mesh.nodes[vertices] + displacements[:, vertices]
    write_pc2(stage.path(f"frames/{name}.pc2"), frames, 0.0, 1.0)
    stage.write(f"frames/{name}.json", {
        "frame_count": len(frames), "rate": _FRAME_RATE, "vertex_count": len(vertices),
        "energies_j": plan.energies, "forces_n": plan.force_sizes, "path": name}, indent=None)
    # Values for colouring the surface in the scene, at the vertices and in the order of the frames.
    model, mesh = grasp_model.model, grasp_model.mesh
    states = [strain_state(model, u) for u in displacements]
    np.savez_compressed(stage.path(f"frames/{name}.npz"), **surface_fields(mesh, states))
