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
from limber.robot.ur.factory_calibration import FactoryCalibration

# A force sensor tested by the weight of the gripper: sign, unit, axes and stated mass.
#
# The gripper is tilted a little about two axes. The change of its weight is known from the stated
# mass; a sensor with another sign, unit or other axes shows another change.

GRAVITY = 9.81
_LEAST_TILT = 0.03  # sine of the angle of gravity's change
_MOST_TILT = 0.5  # rad
_CHANGE_N = 2.0  # N of the weight; the guard stops at limits.unexpected_force_n, 3 N by default
_SECOND_TILT = 0.4  # fraction of the first, about the second axis
_ALIKE = 0.8  # cosine of the angle between measured and expected change
_UNITS = {0.1019: "kilograms-force", 0.2248: "pounds-force", 0.001: "kilonewtons",
          1000.0: "millinewtons"}
_NEAR = 0.15  # relative
_LOOPBACK = "127."


@dataclass(frozen=True)
class Weighing:
    """A sensor's readings of a tilted gripper: the mass that explains the changes [kg], its
    standard error, and errors of the sensor or the stated mass, in words."""

    mass: float
    sigma: float
    faults: tuple[str, ...]


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
    off = _mass_off(mass, float(last.get("mass_sigma_kg", 0.0)), stated)
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


def tilted_joints(joints: np.ndarray, mass: float) -> np.ndarray:
    """Return joint angles [6, n] from ``joints`` [n] and back, tilted by the two middle wrists so
    little that the weight of ``mass`` [kg] changes by no more than the guard allows."""
    tilt = min(_MOST_TILT, float(np.arcsin(min(1.0, _CHANGE_N / max(GRAVITY * mass, 1e-9)))))
    offs = np.zeros((6, len(joints)))
    offs[[1, 2], 3] = tilt, -tilt
    offs[[3, 4], 4] = tilt, -tilt
    return joints + offs


def require_tilts(downs: np.ndarray, stated: float) -> np.ndarray:
    """Return the axes [3, 3] along which directions of gravity [n, 3] differ, most first;
    InputError for too few, about one axis only, or if no mass [kg] is stated."""
    if not stated > 0.0:
        raise InputError("The cell file states no tool.mass_kg above 0.", "Without a weight there "
                         "is nothing to compare the sensor with.", "State the gripper's mass.")
    _, sizes, axes = np.linalg.svd(downs - downs[0], full_matrices=False)
    if len(downs) < 6 or sizes[1] < max(_LEAST_TILT, _SECOND_TILT * sizes[0]):
        raise InputError("The gripper is not tilted about two axes.", "A wrong axis of the sensor "
                         "would not show.", "Turn the wrist so that its joints 4 and 5 tilt the "
                         "gripper against the vertical.")
    return axes


def weigh(downs: np.ndarray, forces: np.ndarray, times: np.ndarray, stated: float) -> Weighing:
    """Compare mean readings [N], [n, 3], of the surroundings on the tool, flange axes, not
    corrected for a payload, at some directions of gravity there [n, 3] and times [s], with the
    weight of the stated mass [kg]; bias and a linear drift are fitted too. InputError for too few
    tilts, about one axis only, or without a stated mass."""
    axes = require_tilts(downs, stated)
    away = downs - downs[0]
    # Along gravity itself bias and weight are nearly indistinguishable: only the two tilts separate
    # them.
    tilts = away @ axes[:2].T
    columns = np.column_stack([away @ axes.T, np.ones(len(downs)), times - times.mean()])
    found, *_ = np.linalg.lstsq(columns, forces, rcond=None)
    left = forces - columns @ found
    free = max(left.size - found.size, 1)
    spread = float(np.sqrt((left**2).sum() / free))
    changes, regressors = found[:2] / GRAVITY, axes[:2]
    along = float((changes * regressors).sum() / 2)
    size = float(np.sqrt((changes**2).sum() / 2))
    sigma = spread / GRAVITY / np.sqrt((tilts**2).sum())
    return Weighing(along, sigma, tuple(_faults(along, size, sigma, stated)))


def _faults(along: float, size: float, sigma: float, stated: float) -> list[str]:
    message = f"the sensor shows {along:.3f} kg for {stated:.3f} kg"
    if size < 4 * sigma or size < 0.02 * stated:
        return [f"the sensor does not notice the gripper's weight ({message})"]
    if along < -_ALIKE * size:
        return [f"the sensor's sign is wrong ({message})"]
    if along < _ALIKE * size:
        return ["the sensor's axes are wrong: the weight changes it in another direction. Check "
                f"sensor.pose ({message})"]
    factor = along / stated
    for unit, name in _UNITS.items():
        if abs(factor / unit - 1.0) < _NEAR:
            return [f"the sensor's unit seems to be {name} ({message})"]
    if _mass_off(along, sigma, stated):
        return [f"tool.mass_kg or the sensor's scale is wrong ({message})"]
    return []


def _mass_off(mass: float, sigma: float, stated: float) -> bool:
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

    @property
    def program_runs(self) -> bool:
        """Whether a program runs on the controller."""
        return self.samples[-1].program_runs

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
                                "the "
                                f"cell file states {stated:.2g} {unit}: the gripper is touched, or "
                                "the unit differs")
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
        sensor = open_sensor(cell)
        try:
            control.skip()
            # The first reading of a sensor with its own connection has not arrived yet.
            select.select(sensor.connections, [], [], _FIRST_READING_SECONDS)
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
    if seen.program_runs:
        raise SafetyStop("A program is running on the controller.",
                         "Limber's own program would end it, wherever it is.",
                         "Stop it on the pendant.")
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
