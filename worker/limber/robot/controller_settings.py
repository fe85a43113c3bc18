"""Settings of a controller compared with the cell file: tool, payload, slider, program."""

from dataclasses import dataclass

import numpy as np

from limber.cell.arm import Arm
from limber.cell.cell_file import Cell
from limber.core.errors import SafetyStop
from limber.core.numerics.rigid import inverted, matrices, pose_vectors
from limber.geometry.rigid_kernels import frame_of, inverse_of, length, pose_of, turn_between
from limber.robot.interface import Sample
from limber.robot.ur.factory_calibration import FactoryCalibration

# A tool that the controller reports is known up to rounding. One computed from nominal joints is
# known to millimetres, since real arms differ that much from their nominal dimensions.
_TOLD_M, _TOLD_RAD = 1e-4, 1e-3
NOMINAL_M, NOMINAL_RAD = 0.01, np.radians(2.0)
# From one sample to the next an arm's own dimensions explain micrometres of a change.
_STEP_M, _STEP_RAD = 1e-3, np.radians(0.5)
_SAME_KG, _SAME_CENTRE_M = 0.005, 0.001


@dataclass(frozen=True)
class Difference:
    """A value of the controller that differs from the cell file's; ``is_set``: a motion sets it,
    and restores it."""

    what: str
    seen: str
    required: str
    is_set: bool

    def __str__(self) -> str:
        message = f"{self.what}: {self.seen} in the controller, {self.required} in the cell file"
        return f"{message} (set for a motion, and put back)" if self.is_set else message


def tool_in_controller(cell: Cell, sample: Sample,
                       calibration: FactoryCalibration | None = None) -> np.ndarray:
    """Return the tool [m, rad, 6] set in the controller, in the flange's frame: as newer ones
    report it, else from joints and pose, with the arm's reported dimensions or with nominal ones,
    to some millimetres."""
    if sample.tool is not None:
        return sample.tool
    flange = (cell.arm.forward(sample.joints) if calibration is None
              else calibration.forward(sample.joints))
    return pose_vectors(inverted(flange) @ matrices(sample.pose))


def is_tool(cell: Cell, sample: Sample, tool: np.ndarray,
            calibration: FactoryCalibration | None = None) -> bool:
    """Whether ``tool`` [6] is set in the controller, as far as that is known."""
    seen = tool_in_controller(cell, sample, calibration)
    is_reported = sample.tool is not None or calibration is not None
    return bool(length(seen[:3] - tool[:3]) <= (_TOLD_M if is_reported else NOMINAL_M)
                and length(turn_between(tool, seen)) <= (_TOLD_RAD if is_reported else NOMINAL_RAD))


def require_tool(cell: Cell, sample: Sample) -> None:
    """Refuse a motion with another tool in the controller than the cell's: a SafetyStop that states
    both."""
    grasp = np.array(cell.tool.grasp_pose)
    if not is_tool(cell, sample, grasp):
        raise SafetyStop("The tool centre point in the controller is "
                         f"{in_millimetres(tool_in_controller(cell, sample))}, that of the cell "
                         f"file {in_millimetres(grasp)}.", "Each target would be of another point "
                         "of the gripper.", "Something has changed it since the start: end that "
                         "program, and begin again.")


def differences(cell: Cell, sample: Sample, calibration: FactoryCalibration | None = None,
                ) -> list[Difference]:
    """Return the differences between controller and cell, without values not reported;
    ``calibration``: the dimensions that the controller reports of its arm."""
    found, grasp = [], np.array(cell.tool.grasp_pose)
    if not is_tool(cell, sample, grasp, calibration):
        exact = sample.tool is not None or calibration is not None
        found.append(Difference("tool centre point", ("" if exact else "about ") + in_millimetres(
                                    tool_in_controller(cell, sample, calibration)),
                                in_millimetres(grasp), True))
    mass = cell.tool.mass_kg
    if sample.payload is not None and mass is not None and not (
            abs(sample.payload - mass) <= _SAME_KG):
        found.append(Difference("payload", f"{sample.payload:.3f} kg", f"{mass:.3f} kg", True))
    centre = np.array(cell.tool.centre_of_mass_m)
    if sample.payload_centre is not None and mass and not (
            length(sample.payload_centre - centre) <= _SAME_CENTRE_M):
        found.append(Difference("centre of the payload", _position_text(sample.payload_centre),
                                _position_text(centre), True))
    if sample.slider < 1.0:
        found.append(Difference("speed slider", f"{100 * sample.slider:.0f} %",
                                "100 % assumed", False))
    return found


class SteadySettings:
    """Notices that tool centre point or payload were changed in the controller: targets and
    recorded poses are of that point and then mean another place, though no joint moves; another
    payload looks like a force on the branch."""

    def __init__(self, arm: Arm):
        self._arm = arm
        self._last: np.ndarray | None = None
        self._payload: float | None = None

    def change(self, sample: Sample) -> str | None:
        """Return in words what changed since the last sample, or None."""
        before, self._payload = self._payload, sample.payload
        if before is not None and sample.payload is not None and (
                abs(sample.payload - before) > _SAME_KG):
            return (f"the payload in the controller was changed from {before:.3f} to "
                    f"{sample.payload:.3f} kg")
        tool = pose_of(inverse_of(self._arm.forward(sample.joints)) @ frame_of(sample.pose))
        last, self._last = self._last, tool
        if last is None:
            return None
        moved, turned = length(tool[:3] - last[:3]), length(turn_between(last, tool))
        # Poses that are no numbers are judged elsewhere.
        if not (moved > _STEP_M or turned > _STEP_RAD):
            return None
        return (f"the tool centre point in the controller was changed by {1000 * moved:.1f} mm "
                f"and {np.degrees(turned):.1f} degrees")


def in_millimetres(pose: np.ndarray) -> str:
    """Return a pose [m, rad, 6] as text."""
    # Adding 0 makes a zero of a rounded -0.
    turn = ", ".join(f"{value:.1f}" for value in np.degrees(pose[3:]).round(1) + 0.0)
    return f"{_position_text(pose[:3])}, turned by ({turn}) degrees"


def _position_text(position: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.0f}" for value in (1000 * position).round() + 0.0) + ") mm"
