"""State of a robot and its sensor before a motion: it is only read, nothing is written."""

import select
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from limber.cell.cell_file import Cell
from limber.core.errors import Command, InputError, SafetyStop
from limber.core.json_values import json_objects
from limber.core.numerics.rigid import matrices
from limber.robot.controller_settings import Difference, differences
from limber.robot.driver.controls import calibration_of, control_of
from limber.robot.driver.force_samples import ForceTorqueSensor, open_sensor
from limber.robot.interface import ArmControl, Sample
from limber.robot.motion.retreat import log_path
from limber.robot.ros.topics import is_ros
from limber.robot.ur.factory_calibration import FactoryCalibration

_LOOPBACK = "127."


def weighed_as(cell: Cell) -> dict[str, Any]:
    """Return what a weighing depends on, as its line of the log of motions states it."""
    return {"address": cell.robot.address, "stated_kg": cell.tool.mass_kg,
            "sensor": cell.sensor.kind, "sensor_pose": list(cell.sensor.pose)}


def unweighed(cell: Cell) -> str | None:
    """Return why the last weighing does not confirm sensor and stated mass; None if it does, or
    none is needed: without felt weight, of a bare flange never weighed, or of the virtual robot,
    whose gripper is another at each start."""
    stated, last = cell.tool.mass_kg or 0.0, _last_weighing(cell)
    is_bare = not stated and (last is None or cell.robot.address.startswith(_LOOPBACK))
    if is_bare or cell.sensor.kind == "none":
        return None
    if last is None:
        return (f"The gripper of {stated:g} kg was never weighed with this sensor, so a wrong "
                "mass, unit, sign or axis would go unnoticed")
    mass = float(last.get("mass_kg", np.nan))
    off = mass_off(mass, float(last.get("mass_sigma_kg", 0.0)), stated)
    if off or not np.isfinite(mass):
        return (f"The sensor weighed {mass:.3f} kg at the last weighing, but tool.mass_kg is "
                f"{stated:g}")
    if last.get("faults"):
        return f"The last weighing found that {'; '.join(last['faults'])}"
    return None


def require_weighed(cell: Cell) -> None:
    """Refuse a motion with the branch whose sensor and gripper no weighing confirms: InputError
    with what the last one found, and both masses."""
    if reason := unweighed(cell):
        raise InputError(f"{reason}.", "The guard would feel another force than the branch's, and "
                         "the branch's moduli would be wrong.",
                         "Correct [sensor] or tool.mass_kg in the cell file, and weigh the empty "
                         "gripper away from the branch: limber robot weigh.")


def _last_weighing(cell: Cell) -> dict[str, Any] | None:
    """The last line of the log of motions that is a weighing by this sensor."""
    wanted, path = weighed_as(cell), log_path()
    del wanted["stated_kg"]
    if not path.is_file():
        return None
    with open(path, encoding="utf-8") as stream:
        found = [line for line in json_objects(stream) if line.get("command") == "weigh"
                 and all(line.get(key) == value for key, value in wanted.items())]
    return found[-1] if found else None


def mass_off(mass: float, sigma: float, stated: float) -> bool:
    """Whether a weighed mass [kg], known to ``sigma``, is not the stated one."""
    return abs(mass - stated) > max(0.05, 0.1 * stated, 4 * sigma)


_FEWEST = 3
_FIRST_READING_SECONDS = 0.2
_BEFORE_MOTION_SECONDS = 0.1
_NOISE = 10.0  # times the stated noise; more is contact, vibration or another unit
_STILL = 1e-6  # N: a working sensor's noise never repeats so closely


@dataclass(frozen=True)
class Observed:
    """A robot at rest: the controller's facts as in :class:`.ArmControl`, samples in order, each
    with the sensor's reading, flange axes, not tared [N, N m], [n, 6], differences from the cell,
    and the arm's dimensions, if its controller reports them."""

    facts: dict[str, Any]
    samples: list[Sample]
    readings: np.ndarray
    differences: list[Difference]
    calibration: FactoryCalibration | None = None

    def is_busy(self, cell: Cell) -> bool:
        """Whether another program runs on the controller; ROS needs its own there."""
        return self.samples[-1].program_runs and not is_ros(cell)

    def nominal_off(self, cell: Cell) -> float | None:
        """Return how far the controller's pose is from the nominal dimensions' [m], mostly by the
        arm's own calibration, which it knows; None if the tool of its pose is not known."""
        sample = self.samples[-1]
        if sample.tool is None and any(each.what == "tool centre point"
                                       for each in self.differences):
            return None
        tool = np.array(cell.tool.grasp_pose) if sample.tool is None else sample.tool
        return self._off(cell.arm.forward(sample.joints), tool)

    def calibrated_off(self, cell: Cell) -> float | None:
        """Return how far the controller's pose is from the reported dimensions' [m], if any: more
        than rounding is another tool than assumed, of an arm repaired or calibrated again, or one
        that an older controller does not report."""
        if self.calibration is None:
            return None
        sample = self.samples[-1]
        tool = np.array(cell.tool.grasp_pose) if sample.tool is None else sample.tool
        return self._off(self.calibration.forward(sample.joints), tool)

    def _off(self, flange: np.ndarray, tool: np.ndarray) -> float:
        return float(np.linalg.norm((flange @ matrices(tool))[:3, 3] - self.samples[-1].pose[:3]))

    def implausible(self, cell: Cell) -> list[str]:
        """Return implausible properties of the sensor's readings at rest, in words."""
        if len(self.readings) < _FEWEST:
            return []
        if not np.isfinite(self.readings).all():
            return ["the sensor sends readings that are no numbers"]
        sensor, spread = cell.sensor, self.readings.std(axis=0)
        warnings = []
        if spread.max() < _STILL:
            warnings.append("the sensor repeats one reading: it is frozen or not connected")
        for name, part, stated, unit in (("force", slice(0, 3), sensor.force_sigma_n, "N"),
                                         ("torque", slice(3, 6), sensor.torque_sigma_nm, "N m")):
            if (worst := float(spread[part].max())) > _NOISE * stated:
                warnings.append(f"the {name} varies by {worst:.2g} {unit} while the arm stands, "
                                f"the cell file states {stated:.2g} {unit}: the gripper is "
                                "touched, or the unit differs")
        for name, part, most, unit in (
                ("force", slice(0, 3), sensor.force_range_n, "N"),
                ("torque", slice(3, 6), sensor.torque_range_nm, "N m")):
            if (worst := float(np.abs(self.readings[:, part]).max())) >= 0.999 * most:
                warnings.append(f"the {name} of {worst:.3g} {unit} is at the end of the sensor's "
                                f"range ({most:g} {unit})")
        return warnings


def observe(cell: Cell, seconds: float) -> Observed:
    """Read a robot and its force sensor for ``seconds`` [s]; LimberError if either does not answer,
    or the arm cannot be moved now."""
    control = control_of(cell)
    try:
        sensor = open_sensor(cell, control)
        try:
            # The first reading of a sensor with its own connection has not arrived yet.
            select.select(sensor.connections, [], [], _FIRST_READING_SECONDS)
            control.skip()
            samples, readings = _read(control, sensor, seconds)
        finally:
            sensor.close()
    except ConnectionError as error:
        raise SafetyStop(f"{error}.", "The robot was only read, and nothing moved.",
                         "Check its cable and network.") from error
    finally:
        control.close()
    calibration = calibration_of(cell)
    return Observed(control.facts, samples, readings,
                    differences(cell, samples[-1], calibration), calibration)


def show_before_motion(cell: Cell, warn: Callable[[str], None]) -> None:
    """Report differences from the cell before anything is written or moves. LimberError as
    :func:`observe`; SafetyStop if a program runs, or the sensor is implausible."""
    seen = observe(cell, _BEFORE_MOTION_SECONDS)
    if seen.is_busy(cell):
        raise SafetyStop("A program is running on the controller.", "Limber's own program would "
                         "end it, wherever it is.", "Stop it on the pendant.")
    if warnings := seen.implausible(cell):
        raise SafetyStop(f"The force sensor cannot be right: {'; '.join(warnings)}.", "The guard "
                         "would not feel the branch.", "Check the sensor and the cell's [sensor] "
                         "entries with ", Command("robot check"), ".")
    for each in seen.differences:
        warn(f"{each}.")
    if untested := unweighed(cell):
        warn(f"{untested} (limber robot weigh).")


def _read(control: ArmControl, sensor: ForceTorqueSensor, seconds: float,
          ) -> tuple[list[Sample], np.ndarray]:
    """Return samples and readings [n, 6] of ``seconds`` [s], one at least."""
    samples: list[Sample] = []
    readings: list[np.ndarray] = []
    end = time.monotonic() + seconds
    while not samples or time.monotonic() < end:
        got = control.read(1.0)
        if not got:
            raise ConnectionError("The robot has sent no data for 1 s")
        for sample in got:
            samples.append(sample)
            readings.append(sensor.read(sample).wrench)
    return samples, np.array(readings)
