"""What the guard notices, against what it promises before the start: paths in stepped time.

A branch near its rest is a spring, stiff along its axis, that the arm bends sideways while its
gripper turns. The prediction is off as a real one is: E within its interval, the base within its
stated error, a force that grows a little otherwise than predicted, a sensor with noise and drift.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.robot_stepped import Spring, SteppedRobot
from benchmarks.table import Asked, Row, Setting
from limber.cell.cell_file import Cell
from limber.core.numerics.rigid import composed, matrices
from limber.robot.driver.force_test import ForceErrors, noticed
from limber.robot.driver.link import RobotLink
from limber.robot.motion.trajectory import Predicted, Trajectory, along, densely
from limber.robot.virtual.controller import Controller

PEAKS_N = (0.5, 1.5, 5.0, 20.0)
WITHIN_M, WAY_M = 0.01, 0.04
_TOOL = np.array([0.0, 0.0, 0.15])
CELL = Cell(robot={"model": "ur5e"}, base={"pose": (0,) * 6, "rotation_sigma_rad": 5e-3},
            tool={"grasp_pose": (*_TOOL, 0, 0, 0), "mass_kg": 0.0, "gripper": "digital_output"},
            limits={"soft_force_n": 35.0, "hard_force_n": 50.0, "contact_n_per_m": 1000.0})
_AXIAL = 100.0  # times as stiff along the branch as across
_TURN_RAD, _SPEEDS_M_S, _ACCELERATION = np.radians(30.0), (0.008, 0.03), 0.3
_YOUNG, _OTHERWISE = 0.1, 0.03  # standard deviations: of log E, and of the growth of the force
_CLEAN, _FALSE = 100, 2


class Gripped(Spring):
    """A spring in a gripper that yields as the cell says, once it has a ``rest``; what is wrong is
    set."""

    def __init__(self, stiffness: np.ndarray, otherwise: float):
        super().__init__(_TOOL, np.full(3, np.nan), np.linalg.solve(
            np.eye(3) + CELL.tool.compliance_m_per_n * stiffness, stiffness))
        self._otherwise = otherwise
        # Share of the force that is left, slip [1/s], load [kg], drift [N/s], sensor's response.
        self.share, self.rate, self.mass, self.drift = 1.0, 0.0, 0.0, 0.0
        self.gain, self.turn, self._time = 1.0, 0.0, 0.0

    def wrench(self, flange: np.ndarray, seconds: float) -> np.ndarray:
        added = np.array([0.0, 0.0, -9.81 * self.mass])
        force = np.zeros(3)
        if np.isfinite(self.rest).all():
            off = flange[:3, :3] @ _TOOL + flange[:3, 3] - self.rest
            self.rest = self.rest + min(self.rate * seconds, 1.0) * off
            self._time += seconds
            added[1] += self.drift * self._time
            force = self.share * (1.0 + self._otherwise * float(np.linalg.norm(off)) / WAY_M
                                  ) * super().wrench(flange, seconds)[:3]
        turned = matrices(np.array([0.0, 0.0, 0.0, 0.0, 0.0, self.turn]))[:3, :3]
        force = self.gain * turned @ (force + flange[:3, :3].T @ added)
        return np.r_[force, np.cross(_TOOL, force)]


CASES: dict[str, tuple[str, float, bool]] = {
    "empty gripper": ("share", 0.0, False),
    "branch breaks": ("share", 0.0, True),
    "branch slips by 5 % a second": ("rate", 0.05, True),
    "branch slips by 30 % a second": ("rate", 0.3, True),
    "branch three times softer": ("share", 1 / 3, False),
    "branch three times stiffer": ("share", 3.0, False),
    "sensor reads a tenth": ("gain", 0.1, False),
    "sensor's sign": ("gain", -1.0, False),
    **{f"sensor's axes turned by {angle} degrees": ("turn", np.radians(angle), False)
       for angle in (20, 45)},
    **{f"another {mass:g} kg in the gripper": ("mass", mass, False) for mass in (0.1, 0.3, 1.0)},
    "sensor drifts by 0.5 N/s": ("drift", 0.5, False)}
"""What is wrong, as the table of what the guard would notice names it: an attribute of the branch,
its value, and whether it begins half way."""


@dataclass(frozen=True)
class Outcome:
    """After which travel since the fault the arm was stopped [m], None if it was not, and why;
    the travel promised before the start [m], None if that it would not be noticed; and the travel
    left after the fault [m]."""

    stopped_after: float | None
    reason: str
    promised: float | None
    left: float

    @property
    def is_good(self) -> bool:
        """Whether it was noticed in time, and as promised, or said not to be noticed so."""
        after, told = (np.inf if each is None else each
                       for each in (self.stopped_after, self.promised))
        return not self.reason.startswith("before") and bool(
            (after <= told or told > self.left) and (after <= WITHIN_M or told > WITHIN_M))


def followed(peak: float, seed: int, name: str | None) -> Outcome:
    """Follow a path whose predicted force grows to ``peak`` [N], with a fault or without."""
    rng = np.random.default_rng(seed)
    controller = Controller("ur5e", seed=seed)
    controller.set_tool(np.r_[_TOOL, 0, 0, 0])
    start = controller.pose.copy()
    speed = float(np.exp(rng.uniform(*np.log(_SPEEDS_M_S))))
    path, stiffness = path_to(peak, start, speed, rng)
    base = matrices(np.r_[np.zeros(3), CELL.base.rotation_sigma_rad * rng.standard_normal(3)])
    controller.load = branch = Gripped(
        np.exp(_YOUNG * rng.standard_normal()) * base[:3, :3] @ stiffness @ base[:3, :3].T,
        _OTHERWISE * float(rng.standard_normal()))
    table = {each["fault"]: each["after_m"]
             for each in noticed(path, ForceErrors.of_cell(CELL), np.eye(3))}
    attribute, value, from_half = CASES.get(name or "", ("share", 1.0, False))
    begun = [] if from_half else [0.0]

    def gone() -> float:
        return float(np.linalg.norm(controller.pose[:3] - start[:3]))

    def on_the_way() -> None:
        if not begun and gone() >= 0.5 * WAY_M:
            begun.append(gone())
            setattr(branch, attribute, value)
    if not from_half:
        setattr(branch, attribute, value)
    robot = SteppedRobot(controller)
    robot.each_step = on_the_way
    with robot.here(), RobotLink(CELL) as link:
        link.wait_for_samples()
        link.tare(0.5)
        branch.rest = start[:3].copy()
        robot.rest(0.3)
        event = link.follow(path)
        stopped = None if event["event"] == "reached" else gone() - (begun or [0.0])[0]
    reason = "" if stopped is None else f"{'' if begun else 'before: '}{event['reason']}"
    return Outcome(stopped, reason, table.get(name or ""), WAY_M - (begun or [0.0])[0])


def path_to(peak: float, start: np.ndarray, speed: float, rng: np.random.Generator,
            ) -> tuple[Trajectory, np.ndarray]:
    """Return a path from ``start`` [6] to a random side while the gripper turns, with the wrench
    predicted of a spring and its errors as a plan states them, and that spring [N/m], [3, 3]."""
    side, axis, across = np.linalg.qr(rng.standard_normal((3, 3)))[0].T
    parts = np.linspace(0.0, 1.0, 21)[:, None]
    poses = densely(np.hstack([start[:3] + WAY_M * parts * side,
                               composed(_TURN_RAD * parts * across, start[3:])]))
    directions = np.column_stack([side, axis, across])
    stiffness = peak / WAY_M * (directions * [1.0, _AXIAL, 1.0]) @ directions.T
    count = len(poses)
    forces = (poses[:, :3] - poses[0, :3]) @ stiffness
    slopes = np.zeros((count, 6, 6))
    slopes[:, :3, :3] = stiffness
    predicted = Predicted(poses, np.hstack([forces, np.zeros((count, 3))]), slopes,
                          _YOUNG**2 * np.einsum("ni,nj->nij", forces, forces))
    return Trajectory(along(poses, speed, _ACCELERATION), poses,
                      predicted.felt(CELL, poses[0])), stiffness


GUARD_ROWS = (
    Asked(f"{len(CASES)} faults on paths of 0.5 to 20 N: noticed within 10 mm, or said before the "
          "start that not", "100 %"),
    Asked(f"false alarms on {_CLEAN} clean paths of 0.5 to 20 N", f"{_FALSE}"))


def guarded_paths(setting: Setting) -> list[Row]:
    """Follow clean paths, and paths with each fault in turn."""
    names = list(CASES)

    def clean(number: int) -> dict[str, Any]:
        return {"why": followed(PEAKS_N[number % len(PEAKS_N)], number, None).reason}

    def faulty(number: int) -> dict[str, Any]:
        seed, kind = divmod(number, len(PEAKS_N) * len(names))
        peak, name = PEAKS_N[kind // len(names)], names[kind % len(names)]
        found = followed(peak, seed, name)
        if not found.is_good:
            print(f"{name}, {peak:g} N, seed {seed}: {found}", flush=True)
        return {"is_good": found.is_good, "is_promised": (found.promised or np.inf) <= WITHIN_M}
    whole = len(PEAKS_N) * len(names)
    trials = setting.trials("guard faults", setting.seeds(5 * whole, whole), faulty, "robot")
    runs = setting.trials("guard clean", setting.seeds(_CLEAN, 4), clean, "robot")
    good, promised = (sum(bool(each[key]) for each in trials) for key in ("is_good", "is_promised"))
    false, count = sum(bool(each["why"]) for each in runs), len(runs)
    is_met = False if good < len(trials) else True if len(trials) >= whole else None
    return [Row(*GUARD_ROWS[0], f"{good} of {len(trials)}, {promised} of them promised and noticed "
                "within 10 mm, the rest said", is_met, len(trials)),
            Row(*GUARD_ROWS[1], f"{false} of {count}", False if false > _FALSE else
                True if count >= _CLEAN else None, count)]
