"""State of a robot and its sensor before a motion: it is only read, nothing is written."""

import select
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from limber.cell.cell_file import Cell
from limber.core.errors import Command, SafetyStop
from limber.core.numerics.rigid import matrices
from limber.robot.cell.controller_settings import Difference, differences
from limber.robot.driver.controls import calibration_of, control_of
from limber.robot.driver.force_sensors import ForceTorqueSensor, open_sensor
from limber.robot.interface import ArmControl, Sample
from limber.robot.ur.factory_calibration import FactoryCalibration
from limber.robot.weighing import unweighed

_FEWEST = 3
_FIRST_READING_SECONDS = 0.2
_BEFORE_MOTION_SECONDS = 0.1
_NOISE = 10.0  # times the stated noise; more is contact, vibration or another unit
_STILL = 1e-6  # N: a working sensor's noise never repeats so closely


@dataclass(frozen=True)
class Observed:
    """A robot at rest.

    Attributes:
        facts: Description of the controller, as in :class:`.ArmControl`.
        samples: In order.
        readings: Reading of the force sensor with each, flange axes, not tared [N, N m], shape [n,
        6].
        differences: Differences between the controller and the cell.
        calibration: Dimensions of the arm that its controller reports; None if it does not.
    """

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
        """Return the deviation of the controller's pose from the arm's nominal dimensions [m].

        Most of it is the arm's own calibration, which the controller knows. None if the tool of its
        pose is not known.
        """
        sample = self.samples[-1]
        if sample.tool is None and any(each.what == "tool centre point"
                                       for each in self.differences):
            return None
        tool = np.array(cell.tool.grasp_pose) if sample.tool is None else sample.tool
        return self._off(cell.arm.forward(sample.joints), tool)

    def calibrated_off(self, cell: Cell) -> float | None:
        """Return the deviation of the controller's pose from that of the reported dimensions [m].

        More than rounding is a tool that is not the one assumed: an arm that has been repaired or
        calibrated again, or a tool centre point that an older controller does not report. None
        without reported dimensions.
        """
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
    """Read a robot and its force sensor for ``seconds`` [s].

    Raises:
        LimberError: the robot or its sensor does not answer, or cannot be moved now.
    """
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
    """Report differences from the cell before anything is written or moves.

    Raises:
        LimberError: as :func:`observe`. SafetyStop: a program runs, or the sensor is implausible.
    """
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
