"""Scan, reconstruct, record, estimate, plan, execute: each a process, over loopback.

A branch is generated and mounted beside a virtual robot. It has its own mesh, and moduli unknown to
the rest. All later steps use only what a user has: the camera's pictures, touched points, the
robot's ports and Limber's own commands. At the end both sides are compared.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from limber.cell.cell_file import Cell, read_cell, write_cell
from limber.cell.known_arms import arm_named
from limber.cli.closed_loop.cell_layout import (
    GRASP_FRACTION,
    TaskSizes,
    base_beside,
    bending_modulus,
    grasp_of,
    gripper_at,
    sideways,
    wish_for,
    write_touched,
)
from limber.cli.closed_loop.comparison import Planned, Watch, compared
from limber.core.errors import InputError, NoPathError, SafetyStop, WorkError
from limber.core.json_values import plain
from limber.core.numerics.rigid import matrices
from limber.core.processes.child import run_stage
from limber.core.progress import SILENT, Progress
from limber.estimation.settings import PullSpec
from limber.estimation.simulated_pull import TrueBranch, true_branch
from limber.geometry.generated import read_truth
from limber.geometry.io.skeletons import read_swc
from limber.planning.path_problem import UNPROVEN
from limber.robot.virtual.branch_solver import BranchSetting
from limber.robot.virtual.launch import VirtualRobot
from limber.robot.virtual.server import MARKER_PORT
from limber.store import Branch
from limber.store.loading import load_skeleton

FLOWER, PLAN = "flower", "to-light"
PLANNED_TOLERANCE_M = 0.006
"""Tolerance for planning: a path ends where the region begins, and the model has an error."""

_LENGTH_M = 0.4  # solved within some hundredths of a second
_PEAK_N, _TRAVEL_M = 6.0, 0.04
_SOFTER = 5.0  # a branch is this much stiffer nearer to its root, at most
OPEN_FACTOR = 4.0
"""Ratio of the ends of a modulus's interval above which `limber suggest-pull` decides whether
another pull is worthwhile for the plan."""
_MOST_PULLS = 3
_MORE_SAMPLES = 450  # about twice the default
_FRACTIONS = (0.5, 0.67, 0.8, 0.92)  # fractions of the main path at which another pull may hold it
_GRASP_POSE = (0.0, 0.0, 0.15, 0.0, 0.0, 0.0)
_TOUCH_SIGMA_M = 3e-4
_POISSON_SIGMA, _DENSITY_SIGMA, _WAVE_SIGMA = 0.05, 0.1, 0.12  # standard deviations in the fit
_SCAN_DISTANCE_M, _SCAN_VIEWS = 0.45, 8
_PULL_SPEED_M_S = 0.02
_PLAN_SPEED_M_S = 0.03
_OVERLOAD_N = 30.0  # beyond the hard limit
_DONE = {"generate": 0.02, "scan": 0.08, "reconstruct": 0.15, "calibrate": 0.16, "target": 0.17,
         "record": 0.27, "estimate": 0.5, "energy": 0.6, "plan": 0.66, "suggest": 0.68,
         "dry run": 0.75,
         "execute": 0.88, "overload": 1.0}


@dataclass
class ClosedLoop:
    """One run of the loop on a branch of its own, below ``folder``, with a virtual robot of this
    model and loopback address; ``seed`` of the branch, the sensors' noise and the touching,
    ``seconds`` the duration of each part."""

    folder: Path
    seed: int = 1
    address: str = "127.0.0.1"
    model: str = "ur5e"
    progress: Progress = SILENT
    seconds: dict[str, float] = field(default_factory=dict)
    _done: float = 0.0

    @property
    def branch(self) -> Path:
        """The branch folder that the loop makes."""
        return self.folder / "loop.branch"

    @property
    def cell_file(self) -> Path:
        return self.folder / "cell.toml"

    def run(self) -> dict[str, Any]:
        """Run the loop once; return the result of :func:`.comparison.compared`, and the seconds of
        each part. LimberError if one failed: the robot is then stopped, files made so far are
        kept."""
        self.folder.mkdir(parents=True, exist_ok=True)
        if self.branch.exists():
            raise InputError(f"{self.branch} already exists.", "The loop starts with a new "
                                                                 "branch.",
                             "Choose another folder with -o.")
        truth = self._grown()
        cell = self._cell(truth)
        with VirtualRobot(self.model, self.address, self._setting(truth, cell), seed=self.seed,
                          ) as robot:
            try:
                moved = self._reconstructed(truth, cell)
                planned = self._pulled_and_planned(robot)
                executed, watch = self._executed(robot)
                stopped = self._overloaded(robot, executed)
            except SafetyStop:
                # A real controller is never delayed; a delay of this one may have caused the stop.
                if robot.process.poll() is None:
                    held_up = 1000 * robot.state["lost_seconds"]
                    self.progress.warn("stopped; until then the virtual robot itself was delayed "
                                       f"by {held_up:.0f} ms in total.")
                raise
        return plain({"seed": self.seed, "branch": self.branch, **compared(
            truth, moved, planned, executed, watch, stopped,
            read_cell(self.cell_file).limits.soft_force_n), "part_seconds": self.seconds})

    # Parts

    def _grown(self) -> TrueBranch:
        scan = self.folder / "grown"
        shape = ["--length", _LENGTH_M, "--fork-count", 0, "--seed", self.seed]
        self._part("generate", "a branch grows", "generate", scan, *shape)
        skeleton = read_swc(scan / "truth_skeleton.swc")
        young = bending_modulus(skeleton, GRASP_FRACTION, _PEAK_N, _TRAVEL_M)
        known = read_truth(scan / "truth.json")
        shares = np.array(known["young_pa"]) / np.exp(np.mean(np.log(known["young_pa"])))
        return true_branch(skeleton, PullSpec(young=tuple(young * shares)),
                           fractions=tuple(known["fractions"]))

    def _setting(self, truth: TrueBranch, cell: Cell) -> BranchSetting:
        """Return the true branch: it deviates from the fit's assumptions within their limits."""
        rng, defaults = np.random.default_rng([self.seed, 8]), PullSpec()
        poisson = float(np.clip(rng.normal(defaults.poisson, _POISSON_SIGMA), 0.2, 0.47))
        return BranchSetting.of_truth(
            truth, cell, self.folder / "truth.vtu", poisson=poisson,
            density=defaults.density * (1 + _DENSITY_SIGMA * float(rng.standard_normal())),
            wave=_WAVE_SIGMA * float(rng.standard_normal()))

    def _cell(self, truth: TrueBranch) -> Cell:
        """Place the robot beside the branch; return its true cell in the scan's frame."""
        point, axis = grasp_of(truth.skeleton)
        arm = arm_named(self.model)
        base = base_beside(arm, matrices(np.array(_GRASP_POSE)), point, axis)
        return Cell(
            robot={"model": self.model, "address": self.address},
            base={"pose": tuple(map(float, base))},
            tool={"grasp_pose": _GRASP_POSE, "gripper": "digital_output", "mass_kg": 0.0,
                  "grip_seconds": 4.0},
            # Nothing stiffer than the branch across its axis is in the virtual cell.
            limits={"soft_force_n": 20.0, "hard_force_n": 30.0, "hard_torque_nm": 6.0,
                    "contact_n_per_m": _SOFTER * _PEAK_N / _TRAVEL_M})

    def _reconstructed(self, truth: TrueBranch, cell: Cell) -> np.ndarray:
        """Scan, reconstruct, calibrate, name the flower; return the shift from scan to branch [m],
        [3]."""
        nodes = truth.mesh.nodes
        middle = 0.5 * (nodes.min(axis=0) + nodes.max(axis=0))
        scan = self.folder / "scan.ply"
        self._part("scan", "scanned by the virtual camera", "robot", "scan", "--address",
                   self.address, "-o", scan, "--middle", *middle, "--distance", _SCAN_DISTANCE_M,
                   "--views", _SCAN_VIEWS)
        self._part("reconstruct", "scan to tetrahedra", "reconstruct", scan, "-o", self.branch,
                   "--root", *truth.skeleton.nodes[0], "--grasp-fraction", GRASP_FRACTION)
        alignment = Branch.open(self.branch).manifest.alignment
        moved = alignment.apply(np.zeros((1, 3)))[0]
        assert np.allclose(np.array(alignment.rotation), np.eye(3)), "the scan is upright"
        # The base's position is roughly known; touching determines it.
        base = np.array(cell.base.pose) + np.r_[moved, 0, 0, 0]
        write_cell(self.cell_file, cell.model_copy(update={
            "base": cell.base.model_copy(update={"pose": tuple(map(float, base))})}))
        rng = np.random.default_rng([self.seed, 7])
        on_axis = np.array([truth.skeleton.point_at(part) for part in (0.3, 0.6, 0.85)])
        write_touched(self.folder / "touched.csv", np.array(cell.base.pose), moved, on_axis,
                      _TOUCH_SIGMA_M, rng)
        self._part("calibrate", "base calibrated by touched points", "robot", "calibrate",
                   self.cell_file, self.branch, "--points", self.folder / "touched.csv")
        tip = truth.skeleton.nodes[truth.skeleton.main_path()[-1]] + moved
        self._part("target", "the flower at its tip is named", "target", self.branch, FLOWER,
                   "--at", *tip)
        return moved

    def _pulled_and_planned(self, robot: VirtualRobot) -> Planned:
        """Pull, estimate and plan; repeat the pull as long as that is worthwhile for the plan."""
        branch = Branch.open(self.branch)
        point, axis = grasp_of(load_skeleton(branch))
        self._pulled(robot, 1, point, axis, "--direction", *sideways(point)[0], "--distance",
                     _TRAVEL_M)
        planned = self._planned()
        for number in range(2, _MOST_PULLS + 1):
            if planned.open_factor <= OPEN_FACTOR:
                return replace(planned, reason=f"no interval is open beyond {OPEN_FACTOR:g}")
            reached = [part for part in _FRACTIONS if self._reaches(part)]
            if not reached:
                return replace(planned, reason="the arm reaches no grasp for another pull")
            found = self._part("suggest", "whether another pull is worthwhile", "suggest-pull",
                               self.branch, "--plan", PLAN, "--fractions",
                               ",".join(map(str, reached)), "--max-force",
                               read_cell(self.cell_file).limits.soft_force_n)
            if not found["plan"]["worth"]:
                return replace(planned, reason=found["plan"]["why"])
            self._pulled(robot, number, *grasp_of(load_skeleton(branch),
                                                  found["best"]["grasp_fraction"]), "--suggested")
            planned = replace(self._planned(planned.goal), pull_count=number)
        return replace(planned, reason=f"{_MOST_PULLS} pulls were made")

    def _reaches(self, fraction: float) -> bool:
        """Whether the arm reaches the surroundings of a position on the main path."""
        grasp = grasp_of(load_skeleton(Branch.open(self.branch)), fraction)
        try:
            gripper_at(read_cell(self.cell_file), *grasp)
        except NoPathError:
            return False
        return True

    def _pulled(self, robot: VirtualRobot, number: int, point: np.ndarray, axis: np.ndarray,
                *options: object) -> None:
        """Record a pull with the gripper about ``point`` [3]."""
        joints, _rotation = gripper_at(read_cell(self.cell_file), point, axis)
        robot.ask("stand", joints=list(map(float, joints)))
        name = f"pull-{number}"
        self._part("record", "a pull along the branch's arc", "record", self.branch, "--cell",
                   self.cell_file, "--name", name, "--confirm", name, "--markers", MARKER_PORT,
                   *options, "--speed", _PULL_SPEED_M_S, "--after-stop", "hold")

    def _planned(self, goal: np.ndarray | None = None) -> Planned:
        """Estimate, sample the field, plan the flower's path to a position [3], or one that suits
        the branch."""
        estimated = self._part("estimate", "Young's modulus from the pull", "estimate", self.branch)
        branch = Branch.open(self.branch)
        point, _axis = grasp_of(load_skeleton(branch))
        # A target position for the flower: where a pull to the other side takes it.
        task = wish_for(branch, sideways(point)[1], _TRAVEL_M)
        write_cell(self.cell_file, task.limited(read_cell(self.cell_file)))
        goal = task.target if goal is None else goal
        self._sampled(task)
        try:
            plan = self._path(task, goal)
        except WorkError as error:
            if UNPROVEN not in str(error):
                raise
            # Follow the advice of the error once: with two stable shapes, few poses describe the
            # force of a branch only coarsely.
            self.progress.warn(f"plan: {error} Planning is repeated with {_MORE_SAMPLES} poses.")
            self._sampled(task, "--samples", _MORE_SAMPLES)
            plan = self._path(task, goal)
        return Planned(estimated, goal, task, plan)

    def _sampled(self, task: TaskSizes, *more: object) -> None:
        self._part("energy", "energy over grasp poses", "energy", self.branch, "--seed",
                   self.seed, "--deflection", task.sampled_deflection, *more)

    def _path(self, task: TaskSizes, goal: np.ndarray) -> dict[str, Any]:
        return self._part("plan", "path of the flower to the light", "plan", self.branch, "--name",
                          PLAN, "--cell", self.cell_file, "--target", FLOWER, "--tip-goal", *goal,
                          "--goal-tolerance", PLANNED_TOLERANCE_M, "--max-force", task.max_force,
                          "--speed", _PLAN_SPEED_M_S, "--seed", self.seed)

    def _executed(self, robot: VirtualRobot) -> tuple[dict[str, Any], Watch]:
        dry = self._part("dry run", "the path is checked for the arm", "execute", self.branch,
                         "--cell", self.cell_file, "--name", PLAN, "--speed", _PLAN_SPEED_M_S)
        robot.ask("stand", joints=dry["start_joints_rad"])
        with Watch(robot) as watch:
            result = self._part("execute", "the path is followed, armed", "execute", self.branch,
                                *self._armed(dry))
        return dry | result, watch

    def _overloaded(self, robot: VirtualRobot, executed: dict[str, Any]) -> tuple[str, Watch]:
        """Follow the path again and overload the sensor meanwhile; return what stopped it."""
        robot.ask("stand", joints=executed["start_joints_rad"])
        limit = read_cell(self.cell_file).limits.hard_force_n
        overload = np.array([0.0, 0.0, limit + _OVERLOAD_N, 0.0, 0.0, 0.0])
        stopped: SafetyStop | None = None
        with Watch(robot, overload=overload) as watch:
            try:
                self._part("overload", "the path is followed again, with an "
                                       "overload", "execute", self.branch,
                           *self._armed(executed))
            except SafetyStop as stop:
                stopped = stop
        if stopped is None:
            raise WorkError("The overload stopped nothing.", f"{overload[2]:.0f} N were added to "
                            "the sensor reading while the branch was "
                            "moved.", "See the robot's log.")
        recorded = Branch.open(self.branch).manifest.stages[f"execute:{PLAN}"].result
        if recorded["stop_reason"] is None:
            # It was stopped by something else before it moved; the report is of the earlier path.
            raise stopped
        return recorded["stop_reason"], watch

    def _armed(self, dry: dict[str, Any]) -> list[object]:
        return ["--cell", self.cell_file, "--name", PLAN, "--speed", _PLAN_SPEED_M_S, "--arm",
                "--confirm", PLAN, "--after-stop", "hold", "--gripper-rotation",
                *dry["gripper_rotation"]]

    def _part(self, name: str, title: str, *arguments: object) -> dict[str, Any]:
        """Run a command as a process; show its progress and its time."""
        with self._timed(name, title) as progress:
            result = run_stage([str(a) for a in arguments], progress)
        for warning in result.get("warnings", []):
            self.progress.warn(f"{name}: {warning}")
        return result

    @contextmanager
    def _timed(self, name: str, title: str) -> Iterator[Progress]:
        began = time.perf_counter()
        ends = max(self._done, _DONE[name])
        progress = self.progress.part(self._done, ends)
        progress(0.0, title)
        try:
            yield progress
        finally:
            self._done = ends
            took = round(time.perf_counter() - began, 1)
            self.seconds[name] = round(self.seconds.get(name, 0.0) + took, 1)
            self.progress.say(f"  {title:<42} {took:6.1f} s")
