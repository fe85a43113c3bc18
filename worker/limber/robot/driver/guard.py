"""The guard: one object that checks every motion of the robot.

It is a pure state machine: samples and requests go in, decisions come out; it opens no connection
and reads no clock. After a stop nothing continues automatically: a person acknowledges it and
chooses.

This is software on a computer that can stall, behind a network that can break. It is no certified
safety function and claims no standard: the controller's own limits and the button on the pendant
protect people.
"""

from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any

import numpy as np

from limber.cell.arm import Arm, within_ratings
from limber.cell.cell_file import Cell, LimitsEntry, WorkspaceEntry
from limber.core.errors import SafetyStop
from limber.geometry.rigid_kernels import frame_of, length, pose_between, turn_between
from limber.robot.controller_settings import SteadySettings
from limber.robot.driver.force_test import BLOCK_SECONDS, Block, ForceErrors, ForceTest
from limber.robot.interface import Sample

NOISES = 7.0
"""Standard deviations of the filtered force that noise explains: in three directions, one in a
million motions of a minute exceeds it."""
LOST_SHARE = 0.4
"""Fraction of its force that a held branch loses when it slips or breaks."""
DEVIATIONS = 3.0
"""Standard deviations of a prediction that are allowed by the bounds that no likelihood widens."""

_UNLIKE = "the force differs from the predicted one"


_NOTHING = np.zeros(0)


def allowed_difference(off: np.ndarray, covariance: np.ndarray, least: float, most: float) -> float:
    """Return the largest allowed difference in the direction of ``off`` [3]: an ellipsoid,
    ``least`` widened by standard deviations of the prediction up to ``most``."""
    squares, axes = np.linalg.eigh(covariance)
    radii = least**2 + np.minimum(DEVIATIONS**2 * np.maximum(squares, 0.0), most**2)
    along = axes.T @ (off / max(length(off), 1e-12))
    return float(1.0 / np.sqrt(max((along**2 / radii).sum(), 1e-300)))


class _Blocks:
    """Averages forces over blocks, and tests these: of the branch held, for which ``first`` [N],
    shape [3], was expected at rest, or of an empty gripper ``since`` some time after its tare [s].
    """

    def __init__(self, errors: ForceErrors, first: np.ndarray, since: float):
        self.test, self._first = ForceTest(errors, since=since), first
        self._rows: list[tuple[np.ndarray, ...]] = []
        self._last = _NOTHING

    def take(self, sample: Sample, off: np.ndarray, expected: np.ndarray, covariance: np.ndarray,
             places: np.ndarray, base_turn: np.ndarray, count: int, *, is_beyond: bool,
             ) -> str | None:
        """Take a force change [N], shape [3], measured minus expected, with covariance [3, 3] and
        places [3, 6]; ``count`` make a block. Return the alarm, or where the change ``is_beyond``
        its bound what explains it best."""
        now = np.r_[sample.pose[:3], sample.clock]
        if not len(self._last):
            self._last = now
        self._rows.append((off, expected - self._first, covariance, places))
        step = now - self._last
        if len(self._rows) < count and not (is_beyond and step[3] > 0.0):
            return _UNLIKE if is_beyond else None
        off, expected, covariance, places = (np.mean(each, axis=0)
                                             for each in zip(*self._rows, strict=True))
        self._last, self._rows = now, []
        self.test.take(Block(off, expected, covariance, base_turn @ frame_of(sample.pose)[:3, :3],
                              base_turn @ sample.speed[:3], length(step[:3]), float(step[3]),
                              places))
        return self.test.alarm(-np.inf) if is_beyond else self.test.alarm()


class State(Enum):
    """What the guard currently allows."""

    IDLE = "idle"
    MOVING = "moving"
    PAUSED = "paused"
    STOPPED = "stopped"


class Verdict(Enum):
    """Action to take after a sample."""

    GO = "go"
    PAUSE = "pause"
    STOP = "stop"


@dataclass(frozen=True)
class Decision:
    """A verdict and its reason."""

    verdict: Verdict
    reason: str = ""
    value: float = 0.0
    limit: float = 0.0

    def __str__(self) -> str:
        if self.limit:
            return f"{self.reason} ({self.value:.3g}, allowed {self.limit:.3g})"
        return self.reason

GO = Decision(Verdict.GO)


@dataclass(frozen=True)
class GuardSettings:
    """Limits of the guard.

    Attributes:
        limits: Limits of the cell. The guard reduces them to what the arm's table allows.
        workspace: Box that contains the grasp, branch frame, or None.
        joint_limits: [rad], shape [6, 2].
        longest_silence: Age at which data is lost [s].
        frozen_time: Longest time for which a wrench may repeat to the last digit [s]; a working
            sensor's noise never does.
        filter_time: Time constant of the torque that is compared with the predicted one [s]. The
            hard limits apply to every single reading.
        off_path: Largest distance from the target [m].
        errors: Errors of the measured force; its noise until that is measured at rest.
        base_turn: Rotation of the base in the branch's frame, shape [3, 3].
        loss_time: Time in which such a loss counts as sudden [s].
        largest_torque_error: Largest difference between the torque and the predicted one [N m].
        relief_distance: Path of a retreat over which a force above the soft limit falls by more
            than its noise [m].
        relief_time: The same for a slow retreat [s].
    """

    limits: LimitsEntry
    joint_limits: np.ndarray
    workspace: WorkspaceEntry | None = None
    errors: ForceErrors = field(
        default_factory=lambda: ForceErrors(noise=0.05, drift=0.8 / 60.0, mass=0.0))
    base_turn: np.ndarray = field(default_factory=lambda: np.eye(3))
    longest_silence: float = 0.05
    frozen_time: float = 0.05
    filter_time: float = 0.01
    off_path: float = 0.01
    loss_time: float = 0.5
    largest_torque_error: float = 1.0
    relief_distance: float = 0.02
    relief_time: float = 10.0

    @classmethod
    def of_cell(cls, cell: Cell, **others: Any) -> "GuardSettings":
        """Return the settings for a cell."""
        return cls(cell.limits, cell.joint_limits, cell.workspace, ForceErrors.of_cell(cell),
                   frame_of(np.array(cell.base.pose))[:3, :3], **others)


@dataclass
class Relief:
    """Progress of a retreat in reducing the values that exceeded their limits: least force [N],
    torque [N m] and excess over each limit of position so far; ``marked_...`` start the next
    measurement of a fall."""

    force: float
    torque: float
    excess: dict[str, float] = field(default_factory=dict)
    marked_force: float = np.inf
    marked_clock: float = -np.inf
    marked_grasp: np.ndarray | None = None


@dataclass
class GuardMemory:
    """The guard's record of the last samples."""

    clock: float | None = None
    raw: np.ndarray | None = None
    frozen_since: float = 0.0
    filtered: np.ndarray | None = None
    peak: float = 0.0
    largest_expected: float = 0.0
    grasp: np.ndarray | None = None
    travel: np.ndarray | None = None
    relief: Relief | None = None
    by_joints: bool = False


SAFETY_MODES = {
    2: "reduced mode: the controller holds other limits", 3: "protective stop", 4: "recovery mode",
    5: "safeguard stop", 6: "emergency stop", 7: "emergency stop", 8: "safety violation",
    9: "safety fault", 10: "joints to be identified", 11: "undefined safety mode",
    12: "safeguard stop of the automatic mode", 13: "three-position enabling stop"}
"""Names of the controller's safety modes in which nothing may move."""


_RUNNING, _NORMAL = 7, 1
_SAME = 1e-9  # N, N m
_PLACE_SLACK = 0.01  # rad of a joint, or of the distance from a singularity, during a retreat
_TARE_SECONDS = 5.0  # that a tare and its motion take at most
_CERTAIN, _NO_PLACES = np.zeros((6, 6)), np.zeros((3, 6))
_RISES = "the {} rises during the return"


class Guard:
    """Watches one robot: ``state`` is what it currently allows, ``reason`` that of its last stop or
    pause, ``errors`` those of its force sensor."""

    def __init__(self, arm: Arm, settings: GuardSettings, rate: float):
        self._arm, self._step = arm, 1.0 / rate
        own = np.asarray(arm.joint_limits, float)
        joints = np.column_stack([np.maximum(settings.joint_limits[:, 0], own[:, 0]),
                                  np.minimum(settings.joint_limits[:, 1], own[:, 1])])
        self._settings = replace(settings, limits=within_ratings(arm, settings.limits),
                                 joint_limits=joints)
        self.state = State.IDLE
        self.reason = ""
        self._memory = GuardMemory()
        self._is_tared = False
        self._kept = float(np.exp(-self._step / settings.filter_time))
        self.errors = settings.errors
        self._held: np.ndarray | None = None
        self._held_clock: float | None = None
        self._block_count = int(np.ceil(BLOCK_SECONDS * rate))
        self._forces: _Blocks | None = None
        self._first: np.ndarray | None = None
        self._tared_clock: float | None = None
        self._set = SteadySettings(arm)

    @property
    def force_factor(self) -> tuple[float, float] | None:
        """As :attr:`.ForceTest.scale`, of the motion so far; None without a branch."""
        return None if self._forces is None else self._forces.test.scale

    # Actions of a person

    def tared(self, forces: np.ndarray | None = None) -> None:
        """The force sensor has been tared: from now on its limits apply. ``forces``: readings at
        rest, which tell its noise [N], shape [n, 3]."""
        self._is_tared, self._tared_clock = True, None
        self.errors = self._settings.errors.measured(forces, self._block_count)
        self.hold(None)

    def hold(self, off: np.ndarray | None) -> None:
        """The gripper holds the resting branch: from here on its force follows the prediction.
        ``off``, measured minus predicted [N], shape [3], is what the fingers press aside and the
        drift so far, and tells nothing of the branch; None: it holds nothing."""
        self._held, self._held_clock, self._forces, self._first = off, None, None, None

    def begin(self, *, by_joints: bool = False) -> None:
        """Allow a motion; of one ``by_joints`` singularities are no limit. SafetyStop after a stop
        that was not acknowledged, while one is paused, or before a tare."""
        if self.state != State.IDLE:
            raise SafetyStop(f"The robot is {self.state.value}: {self.reason}.", "No motion begins "
                             "before a person has checked.", "Choose hold, retreat or release.")
        if not self._is_tared:
            raise SafetyStop("The force sensor is not tared.", "Its bias would be taken for a "
                             "force on the branch.", "Tare it with the gripper hanging free.")
        self.state = State.MOVING
        self._memory = GuardMemory(by_joints=by_joints)

    def begin_retreat(self, wrench: np.ndarray) -> None:
        """Allow a motion back along the followed path, which a person has chosen since a value
        exceeds its limit: each such limit becomes the least value since then plus the allowed
        difference to the prediction. It stops if a force rises, or does not fall. ``wrench`` is
        smoothed, [N, N m], shape [6]. SafetyStop if the robot moves, or the force is not known."""
        if self.state == State.MOVING:
            raise SafetyStop("The robot is moving.", "", "Stop it before the return.")
        if not np.isfinite(wrench).all():
            raise SafetyStop("The force is unknown: the sensor gives no number or is at the end "
                             "of its range.", "So Limber cannot check that the force falls during "
                             "the return.", "Open the gripper.")
        self.state = State.IDLE
        self.begin()
        self._memory.relief = Relief(length(wrench[:3]), length(wrench[3:]))

    def end(self) -> None:
        """The motion is over."""
        self._memory.relief = None
        if self.state in (State.MOVING, State.PAUSED):
            self.state = State.IDLE

    def resume(self) -> None:
        """Continue after a pause; raises SafetyStop without one."""
        if self.state != State.PAUSED:
            raise SafetyStop(f"The robot is {self.state.value}, not paused.", self.reason,
                             "Only a pause can be continued; after a stop, choose what to do.")
        self.state = State.MOVING
        self._memory.peak = 0.0

    def acknowledge(self) -> None:
        """A person has seen the stop; a new motion may be requested."""
        if self.state in (State.STOPPED, State.PAUSED):
            self.state, self._forces = State.IDLE, None

    # Events

    def silence(self, age: float) -> Decision:
        """No sample has arrived for ``age`` [s]."""
        if age > self._settings.longest_silence:
            return self._stop("no data from the robot [s]", age, self._settings.longest_silence)
        return GO

    def event(self, reason: str) -> Decision:
        """An event that no sample shows: a lost connection, a parent that has ended."""
        return self._stop(reason)

    def look(self, sample: Sample, *, wrench: np.ndarray, raw: np.ndarray,
             expected: np.ndarray | None = None, uncertainty: np.ndarray | None = None,
             places: np.ndarray | None = None, grasp: np.ndarray | None = None,
             sent: np.ndarray | None = None) -> Decision:
        """Judge a sample. ``wrench``: of the gripper on the branch, tared, branch frame [N, N m],
        shape [6]; ``raw``: as received and rotated to the flange's axes, [2, 6], as a frozen sensor
        repeats one of them to the last digit; ``expected``: as predicted, with covariance [6, 6],
        of which ``places`` [3, 6] are the part that stays; ``grasp``: branch frame [m], ``sent``:
        target, base frame [m]."""
        last, self._memory.grasp = self._memory.grasp, grasp
        self._memory.travel = None if last is None or grasp is None else grasp - last
        for check in (self._check_clock(sample), self.modes(sample),
                      self._check_wrench(sample, wrench, raw), self._check_settings(sample),
                      self._check_position(sample, grasp, sent),
                      self._check_expected(sample, wrench, expected, uncertainty, places)):
            if check.verdict == Verdict.STOP:
                return check
        if self._memory.relief is not None:
            return self._check_relief(self._memory.relief, sample, wrench, grasp)
        force = length(wrench[:3])
        if self.state == State.MOVING and force > self._settings.limits.soft_force_n:
            self.state = State.PAUSED
            self.reason = "soft force limit"
            return Decision(Verdict.PAUSE, "soft force limit [N]", force,
                            self._settings.limits.soft_force_n)
        if self.state == State.PAUSED:
            return Decision(Verdict.PAUSE, self.reason)
        return GO

    def permit(self, current: np.ndarray, target: np.ndarray, seconds: float) -> np.ndarray:
        """Return a target [6] that keeps the speed limits, on the path from ``current`` to it;
        SafetyStop if no motion is allowed now, or it is no pose."""
        if self.state != State.MOVING:
            raise SafetyStop(f"The robot is {self.state.value}.", self.reason, "")
        if target.shape != (6,) or not np.isfinite(target).all():
            self._stop("an invalid target pose")
            raise SafetyStop("An invalid target pose was given.", f"{target}", "")
        limits = self._settings.limits
        distance = length(target[:3] - current[:3])
        turn = length(turn_between(current, target))
        part = min(1.0, limits.speed_m_s * seconds / distance if distance > 0 else 1.0,
                   limits.turn_speed_rad_s * seconds / turn if turn > 0 else 1.0)
        return target if part >= 1.0 else pose_between(current, target, part)

    # Checks

    def _check_clock(self, sample: Sample) -> Decision:
        last, self._memory.clock = self._memory.clock, sample.clock
        if not np.isfinite(sample.clock):
            return self._stop("the controller's clock gives no number")
        if self._tared_clock is None:
            self._tared_clock = sample.clock
        if last is None:
            return GO
        passed = sample.clock - last
        if passed <= 0:
            return self._stop("the controller's clock ran backwards [s]", passed, self._step)
        if passed > self._settings.longest_silence + self._step:
            return self._stop("the controller's clock jumped [s]", passed,
                              self._settings.longest_silence)
        return GO

    def modes(self, sample: Sample) -> Decision:
        """Judge what the controller reports of itself: it may arrive between two samples."""
        if sample.safety_mode != _NORMAL:
            return self._stop(SAFETY_MODES.get(sample.safety_mode,
                                               f"safety mode {sample.safety_mode}"))
        if sample.robot_mode != _RUNNING:
            return self._stop(f"robot mode {sample.robot_mode}: the robot is not running")
        if self.state not in (State.MOVING, State.PAUSED):
            return GO
        if not sample.program_runs:
            return self._stop("the program on the controller was stopped")
        if not sample.slider > 0.0:
            return self._stop("the controller scales the speed to 0: its slider, or a pause")
        return GO

    def _check_wrench(self, sample: Sample, wrench: np.ndarray, raw: np.ndarray) -> Decision:
        numbers = np.concatenate((wrench, sample.wrench, sample.pose, sample.joints, sample.speed))
        if not np.isfinite(numbers).all():
            return self._stop("a sensor gives no number")
        memory = self._memory
        # Rotating a wrench to other axes and back leaves rounding errors in its last digits.
        if memory.raw is None or np.abs(raw - memory.raw).max(axis=1).min() > _SAME:
            memory.frozen_since = sample.clock
        memory.raw = raw.copy()
        if sample.clock - memory.frozen_since > self._settings.frozen_time:
            return self._stop("the force sensor is frozen [s]",
                              sample.clock - memory.frozen_since, self._settings.frozen_time)
        return self.feel(wrench)

    def _check_settings(self, sample: Sample) -> Decision:
        changed = self._set.change(sample)
        return GO if changed is None else self._stop(changed)

    def feel(self, wrench: np.ndarray) -> Decision:
        """Judge a force [6] by the hard limits alone: it arrived between two samples."""
        limits = self._settings.limits
        if not self._is_tared:
            # No motion yet, and before its tare a sensor shows its bias.
            return GO
        if np.isnan(wrench).any():
            return self._stop("a sensor gives no number")
        if np.isinf(wrench).any():
            return self._stop("the force sensor is at the end of its range")
        force, torque = length(wrench[:3]), length(wrench[3:])
        most_force, most_torque = limits.hard_force_n, limits.hard_torque_nm
        limit_text = "hard {} limit"
        if (relief := self._memory.relief) is not None:
            limit_text = _RISES
            most_force = max(most_force, self._relieved_force(relief))
            most_torque = max(most_torque, self._relieved_torque(relief))
        if force > most_force:
            return self._stop(limit_text.format("force") + " [N]", force, most_force)
        if torque > most_torque:
            return self._stop(limit_text.format("torque") + " [N m]", torque, most_torque)
        return GO

    def _relieved_force(self, relief: Relief) -> float:
        return relief.force + max(self._settings.limits.unexpected_force_n, self._least_change)

    @property
    def _least_change(self) -> float:
        """Change of a force [N] that the noise of both its values does not explain."""
        return float(np.sqrt(2.0)) * NOISES * self.errors.noise

    def _relieved_torque(self, relief: Relief) -> float:
        return relief.torque + self._settings.largest_torque_error

    def _check_relief(self, relief: Relief, sample: Sample, wrench: np.ndarray,
                      grasp: np.ndarray | None) -> Decision:
        """Judge a sample of a retreat: a value over its limit falls, or the retreat stops."""
        settings, limits = self._settings, self._settings.limits
        smooth = self._filtered(wrench)
        force, torque = length(smooth[:3]), length(smooth[3:])
        relief.force, relief.torque = min(relief.force, force), min(relief.torque, torque)
        most = max(limits.soft_force_n, self._relieved_force(relief))
        if force > most:
            return self._stop(_RISES.format("force") + " [N]", force, most)
        most = max(limits.hard_torque_nm, self._relieved_torque(relief))
        if torque > most:
            return self._stop(_RISES.format("torque") + " [N m]", torque, most)
        mark = relief.marked_grasp
        has_gone = (mark is not None and grasp is not None
                    and length(grasp - mark) > settings.relief_distance)
        if mark is None or has_gone or sample.clock - relief.marked_clock > settings.relief_time:
            if force > limits.soft_force_n and force > relief.marked_force - self._least_change:
                return self._stop("the force does not fall during the return [N]", force,
                                  limits.soft_force_n)
            relief.marked_force, relief.marked_clock, relief.marked_grasp = (
                force, sample.clock, grasp)
        return GO

    def _is_over(self, name: str, excess: float, slack: float) -> bool:
        """Whether a limit of the arm's position is exceeded by ``excess``; a retreat allows this
        while the excess does not grow by more than ``slack``."""
        relief = self._memory.relief
        if excess <= 0 or relief is None:
            return excess > 0
        least = relief.excess[name] = min(relief.excess.get(name, excess), excess)
        return excess > least + slack

    def _filtered(self, wrench: np.ndarray) -> np.ndarray:
        """Return the force [6] to compare with the predicted one; ``wrench`` updates it."""
        before = wrench if self._memory.filtered is None else self._memory.filtered
        self._memory.filtered = self._kept * before + (1 - self._kept) * wrench
        return self._memory.filtered

    def _check_position(self, sample: Sample, grasp: np.ndarray | None, sent: np.ndarray | None,
                        ) -> Decision:
        limits, settings = self._settings.limits, self._settings
        speed = length(sample.speed[:3])
        if speed > 1.5 * limits.speed_m_s + 0.005:
            return self._stop("speed [m/s]", speed, limits.speed_m_s)
        margin = np.minimum(sample.joints - settings.joint_limits[:, 0],
                            settings.joint_limits[:, 1] - sample.joints)
        joint = int(margin.argmin())
        if self._is_over(f"joint {joint}", 0.5 * limits.joint_margin_rad - float(margin[joint]),
                         _PLACE_SLACK):
            return self._stop(f"joint {joint + 1} at its limit")
        distance = float(self._arm.singularity_distance(sample.joints).min())
        if self.state == State.MOVING and not self._memory.by_joints and self._is_over(
                "singularity", 0.5 * limits.singularity - distance, _PLACE_SLACK):
            return self._stop("singularity", distance, 0.5 * limits.singularity)
        box = settings.workspace
        if box is not None and grasp is not None and self.state == State.MOVING:
            outside = float(np.maximum(np.array(box.low_m) - grasp,
                                       grasp - np.array(box.high_m)).max())
            if self._is_over("workspace", outside - 1e-3, 1e-3):
                return self._stop("the grasp left the workspace")
        if sent is not None and self.state == State.MOVING:
            off = length(sample.pose[:3] - sent)
            if off > settings.off_path:
                return self._stop("the robot left its path [m]" if sample.slider >= 1.0 else
                                  "the speed slider is below 100 %: the robot fell behind its path "
                                  "[m]", off, settings.off_path)
        return GO

    def _check_expected(self, sample: Sample, wrench: np.ndarray, expected: np.ndarray | None,
                        uncertainty: np.ndarray | None, places: np.ndarray | None) -> Decision:
        if self.state not in (State.MOVING, State.PAUSED):
            return GO
        if self._memory.relief is not None:
            # A sudden fall of the force is the purpose of a retreat.
            return GO
        if expected is not None and self._held is not None and self._memory.filtered is None:
            # Begun with a single reading, the filtered force would have that reading's noise.
            self._memory.filtered = expected + np.r_[self._held, np.zeros(3)]
        filtered = self._filtered(wrench)
        if expected is None:
            return self._check_drop(filtered)
        uncertainty = _CERTAIN if uncertainty is None else uncertainty
        off, limits = filtered - expected, self._settings.limits
        within = allowed_difference(off[3:], uncertainty[3:, 3:],
                                    self._settings.largest_torque_error, limits.hard_torque_nm)
        if length(off[3:]) > within:
            return self._stop("the torque differs from the predicted one [N m]", length(off[3:]),
                              within)
        if self._forces is None:
            since = sample.clock - (self._tared_clock or sample.clock) + _TARE_SECONDS
            if self._first is None:
                self._first = np.zeros(3) if self._held is None else expected[:3]
            self._forces = _Blocks(self.errors, self._first, since if self._held is None else 0.0)
        held = np.zeros(3) if self._held is None else self._held
        alarm = self._forces.take(
            sample, wrench[:3] - expected[:3] - held, expected[:3], uncertainty[:3, :3],
            _NO_PLACES if places is None else places, self._settings.base_turn, self._block_count,
            is_beyond=self._is_beyond(sample.clock, off[:3], expected[:3], uncertainty[:3, :3]))
        return GO if alarm is None else self._stop(alarm)

    def _is_beyond(self, clock: float, off: np.ndarray, expected: np.ndarray,
                   covariance: np.ndarray) -> bool:
        """Whether a difference ``off`` [3] to the expected force is larger than is allowed against
        the tare, or against the branch held at rest."""
        memory, limits, errors = self._memory, self._settings.limits, self.errors
        memory.largest_expected = max(memory.largest_expected, length(expected))
        bounds = [(off, limits.unexpected_force_n)]
        if self._held is not None:
            self._held_clock = clock if self._held_clock is None else self._held_clock
            bounds += [(off - self._held, float(np.sqrt(
                (LOST_SHARE * memory.largest_expected)**2 + (NOISES * errors.noise)**2
                + (errors.drift * (clock - self._held_clock))**2
                + (errors.mass * limits.acceleration_m_s2)**2)))]
        return any(length(change) > least and length(change) > allowed_difference(
            change, covariance, least, limits.soft_force_n) for change, least in bounds)

    def _check_drop(self, filtered: np.ndarray) -> Decision:
        """Judge a force [6] without a prediction, as while E is measured: a sudden loss still
        indicates a slip, but not while the branch is released and pulls in the gripper's direction
        of motion."""
        memory, force = self._memory, length(filtered[:3])
        if memory.travel is not None and float(memory.travel @ filtered[:3]) < 0:
            memory.peak = force
        memory.peak = max(memory.peak * np.exp(-self._step / self._settings.loss_time), force)
        allowed = float(np.hypot(LOST_SHARE * memory.peak, self._least_change))
        if memory.peak - force > allowed:
            return self._stop("the force dropped suddenly: slip or break [N]", memory.peak - force,
                              allowed)
        return GO

    def _stop(self, reason: str, value: float = 0.0, limit: float = 0.0) -> Decision:
        decision = Decision(Verdict.STOP, reason, value, limit)
        self._memory.relief = None
        if self.state != State.STOPPED:
            self.state = State.STOPPED
            self.reason = str(decision)
        return decision
