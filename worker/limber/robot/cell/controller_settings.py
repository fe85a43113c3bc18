"""Settings of a controller compared with the cell file: tool, payload, slider, program."""

from dataclasses import dataclass

import numpy as np

from limber.core.numerics.rigid import inverted, matrices, pose_vectors
from limber.core.numerics.rigid_kernels import length, turn_between
from limber.robot.cell.cell import Cell
from limber.robot.interface import Sample

# A tool that the controller reports is known up to rounding. One computed from nominal joints is
# known to millimetres, since real arms differ that much from their nominal dimensions.
_TOLD_M, _TOLD_RAD = 1e-4, 1e-3
NOMINAL_M, NOMINAL_RAD = 0.01, np.radians(2.0)
_SAME_KG, _SAME_CENTRE_M = 0.005, 0.001
_PLAYING = 2


@dataclass(frozen=True)
class Difference:
    """One difference between a controller and the cell file.

    Attributes:
        what: Its name.
        seen, wanted: Value in the controller, and in the cell file.
        is_set: Whether a motion sets it automatically, and restores it.
    """

    what: str
    seen: str
    wanted: str
    is_set: bool

    def __str__(self) -> str:
        told = f"{self.what}: {self.seen} in the controller, {self.wanted} in the cell file"
        return f"{told} (set for a motion, and put back)" if self.is_set else told


def tool_in_controller(cell: Cell, sample: Sample) -> np.ndarray:
    """Return the tool [m, rad, 6] that is set in the controller, in the flange's frame.

    Newer controllers report it. Otherwise it is computed from joints and pose with the nominal
    dimensions of the arm, to some millimetres.
    """
    if sample.tool is not None:
        return sample.tool
    return pose_vectors(inverted(cell.arm.forward(sample.joints)) @ matrices(sample.pose))


def is_tool(cell: Cell, sample: Sample, tool: np.ndarray) -> bool:
    """Whether ``tool`` [6] is set in the controller, as far as that is known."""
    seen = tool_in_controller(cell, sample)
    told = sample.tool is not None
    return bool(length(seen[:3] - tool[:3]) <= (_TOLD_M if told else NOMINAL_M)
                and length(turn_between(tool, seen)) <= (_TOLD_RAD if told else NOMINAL_RAD))


def differences(cell: Cell, sample: Sample) -> list[Difference]:
    """Return the differences between controller and cell; values not reported are omitted."""
    found, grasp = [], np.array(cell.tool.grasp_pose)
    if not is_tool(cell, sample, grasp):
        found.append(Difference("tool centre point",
                                ("" if sample.tool is not None else "about ")
                                + in_millimetres(tool_in_controller(cell, sample)),
                                in_millimetres(grasp), True))
    mass = cell.tool.mass_kg
    if sample.payload is not None and mass is not None and not (
            abs(sample.payload - mass) <= _SAME_KG):
        found.append(Difference("payload", f"{sample.payload:.3f} kg", f"{mass:.3f} kg", True))
    centre = np.array(cell.tool.centre_of_mass_m)
    if sample.payload_centre is not None and mass and not (
            length(sample.payload_centre - centre) <= _SAME_CENTRE_M):
        found.append(Difference("centre of the payload", _place(sample.payload_centre),
                                _place(centre), True))
    if sample.slider < 1.0:
        found.append(Difference("speed slider", f"{100 * sample.slider:.0f} %",
                                "100 % assumed", False))
    return found


def plays(sample: Sample) -> bool:
    """Whether a program runs on the controller."""
    return sample.runtime_state == _PLAYING


def in_millimetres(pose: np.ndarray) -> str:
    """Return a pose [m, rad, 6] as text."""
    # Adding 0 makes a zero of a rounded -0.
    turn = ", ".join(f"{value:.1f}" for value in np.degrees(pose[3:]).round(1) + 0.0)
    return f"{_place(pose[:3])}, turned by ({turn}) degrees"


def _place(place: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.0f}" for value in (1000 * place).round() + 0.0) + ") mm"
