"""A cell as ROS describes it: URDF and SRDF, from which its nodes make TF and a planning scene.

The root is the branch's frame. Arms are described by the axes of their joints at angle 0, so any
arm of :class:`limber.cell.arm.Arm` has a URDF, also one whose dimensions come from a table.
``base`` and ``tool0`` are those of the controller (REP 199).
"""

from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from limber.cell.arm import Arm
from limber.cell.cell_file import BoxEntry, Cell
from limber.cell.urdf_arm import is_file
from limber.core.numerics.rigid import matrices

_EFFORT = 150.0  # N m; the file has to state one, and Limber limits forces, not torques
_UPRIGHT = 1e-9  # cosine of a pitch of a right angle
_STEP, _MOVES = 1e-3, 1e-6  # rad, m: a rod that a joint moves
_GROUP = "arm"
Element = ElementTree.Element


def cell_urdf(cell: Cell) -> str:
    """Return the URDF of a cell: arm, gripper, camera and obstacles in the branch's frame."""
    root = ElementTree.Element("robot", name=_name(cell))
    _link(root, "branch")
    _fixed(root, "branch", "base", matrices(np.array(cell.base.pose)))
    _link(root, "base")
    _arm(root, cell.arm, joint_names(cell))
    tool = _link(root, "tool0")
    for part in cell.tool.parts:
        _capsule(tool, np.array(part.start_m), np.array(part.end_m), part.radius_m)
    _link(root, "grasp")
    _fixed(root, "tool0", "grasp", matrices(np.array(cell.tool.grasp_pose)))
    if cell.camera is not None:
        _link(root, "camera_optical_frame")
        _fixed(root, "branch" if cell.camera.mount == "branch" else "tool0",
               "camera_optical_frame", matrices(np.array(cell.camera.pose)))
    if cell.second_arm is not None:
        _link(root, "second_arm_base")
        _fixed(root, "branch", "second_arm_base", matrices(np.array(cell.second_arm.base_pose)))
    for number, entry in enumerate(cell.obstacles):
        name = f"obstacle_{number + 1}"
        link = _link(root, name)
        if isinstance(entry, BoxEntry):
            _shape(link, np.eye(4), "box", size=_numbers(entry.size_m))
            _fixed(root, "branch", name, matrices(np.array(entry.pose)))
        else:
            _shape(link, np.eye(4), "mesh", filename=entry.file, scale=_numbers((entry.scale,) * 3))
            _fixed(root, "branch", name, np.eye(4))
    return _text(root)


def cell_srdf(cell: Cell) -> str:
    """Return the SRDF of a cell: the arm as a group, its home, and links that always touch."""
    root = ElementTree.Element("robot", name=_name(cell))
    group = ElementTree.SubElement(root, "group", name=_GROUP)
    ElementTree.SubElement(group, "chain", base_link="base", tip_link="grasp")
    home = ElementTree.SubElement(root, "group_state", name="home", group=_GROUP)
    for name, angle in zip(joint_names(cell), cell.arm.home, strict=True):
        ElementTree.SubElement(home, "joint", name=name, value=f"{float(angle):.9g}")
    for first, second in pairwise(["base", *link_names(cell.arm), "tool0", "grasp"]):
        ElementTree.SubElement(root, "disable_collisions", link1=first, link2=second,
                               reason="Adjacent")
    return _text(root)


def joint_names(cell: Cell) -> list[str]:
    """Return the names of the arm's joints in ROS, from the base on; of a URDF file, its own."""
    prefix, is_whole = cell.robot.ros.get("prefix", ""), is_file(cell.robot.model)
    names = [name if is_whole or "joint" in name else f"{name}_joint"
             for name in cell.arm.ros_joints]
    return [name if name.startswith(prefix) else prefix + name for name in names]


def link_names(arm: Arm) -> list[str]:
    """Return the names of the links that an arm's joints move, from the base on."""
    return [name.removesuffix("_joint") + "_link" for name in arm.ros_joints]


def _arm(root: Element, arm: Arm, names: list[str]) -> None:
    """Add an arm's links and joints on the link ``base``, up to the flange ``tool0``."""
    zero = np.zeros(len(arm.joint_names))
    flange, slopes = arm.forward(zero), arm.jacobian(zero)
    links, before, place = link_names(arm), "base", np.zeros(3)
    speeds = np.broadcast_to(arm.joint_speed, zero.shape)
    for number, (name, moved) in enumerate(zip(names, _rods_of_links(arm), strict=True)):
        axis = slopes[3:, number]
        # The point of the axis nearest to the flange, in the base's frame.
        at = flange[:3, 3] - np.cross(slopes[:3, number], axis)
        low, high = arm.joint_limits[number]
        is_endless = not np.isfinite([low, high]).all()
        joint = _joint(root, name, "continuous" if is_endless else "revolute", before,
                       links[number], _shifted(at - place))
        ElementTree.SubElement(joint, "axis", xyz=_numbers(axis))
        limit = {"effort": f"{_EFFORT:g}", "velocity": f"{speeds[number]:.9g}"}
        if not is_endless:
            limit |= {"lower": f"{low:.9g}", "upper": f"{high:.9g}"}
        ElementTree.SubElement(joint, "limit", limit)
        link = _link(root, links[number])
        for start, end, radius in moved:
            _capsule(link, start - at, end - at, radius)
        before, place = links[number], at
    _fixed(root, before, "tool0", _shifted(-place) @ flange)


def _rods_of_links(arm: Arm) -> list[list[tuple[np.ndarray, np.ndarray, float]]]:
    """The rods at angles 0 by the last joint that moves them, base frame."""
    zero = np.zeros((1, len(arm.joint_names)))
    still = arm.rods(zero)
    found: list[list[tuple[np.ndarray, np.ndarray, float]]] = [[] for _ in zero[0]]
    last = np.zeros(len(still.radii), int)
    for number in range(len(zero[0])):
        turned = zero.copy()
        turned[0, number] = _STEP
        rods = arm.rods(turned)
        shift = np.maximum(np.abs(rods.starts - still.starts), np.abs(rods.ends - still.ends))
        last[shift[0].max(axis=1) > _MOVES] = number
    for joint, start, end, radius in zip(last, still.starts[0], still.ends[0], still.radii,
                                         strict=True):
        found[joint].append((start, end, float(radius)))
    return found


def _capsule(link: Element, start: np.ndarray, end: np.ndarray, radius: float) -> None:
    """Add a cylinder and its two round ends, in the link's frame."""
    for place in (start, end):
        _shape(link, _shifted(place), "sphere", radius=f"{radius:.9g}")
    if (length := float(np.linalg.norm(end - start))) > 0.0:
        frame = _shifted(0.5 * (start + end))
        frame[:3, :3] = _along((end - start) / length)
        _shape(link, frame, "cylinder", radius=f"{radius:.9g}", length=f"{length:.9g}")


def _along(direction: np.ndarray) -> np.ndarray:
    """A rotation [3, 3] whose z is ``direction`` [3]."""
    side = np.eye(3)[int(np.abs(direction).argmin())]
    x = np.cross(side, direction)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(direction, x), direction])


def _shape(link: Element, frame: np.ndarray, kind: str, **attributes: str) -> None:
    for tag in ("visual", "collision"):
        element = ElementTree.SubElement(link, tag)
        _origin(element, frame)
        geometry = ElementTree.SubElement(element, "geometry")
        ElementTree.SubElement(geometry, kind, attributes)


def _link(root: Element, name: str) -> Element:
    return ElementTree.SubElement(root, "link", name=name)


def _fixed(root: Element, parent: str, child: str, frame: np.ndarray) -> None:
    _joint(root, f"{parent}_{child}", "fixed", parent, child, frame)


def _joint(root: Element, name: str, kind: str, parent: str, child: str, frame: np.ndarray,
           ) -> Element:
    joint = ElementTree.SubElement(root, "joint", name=name, type=kind)
    _origin(joint, frame)
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    return joint


def _origin(element: Element, frame: np.ndarray) -> None:
    ElementTree.SubElement(element, "origin", xyz=_numbers(frame[:3, 3]),
                           rpy=_numbers(_roll_pitch_yaw(frame[:3, :3])))


def _roll_pitch_yaw(turn: np.ndarray) -> np.ndarray:
    """Angles about the fixed axes x, y, z, in that order [rad], of a rotation [3, 3]."""
    level = float(np.hypot(turn[0, 0], turn[1, 0]))
    pitch = np.arctan2(-turn[2, 0], level)
    if level < _UPRIGHT:
        # Only one of the two other angles is determined.
        return np.array([0.0, pitch, np.arctan2(-turn[0, 1], turn[1, 1])])
    return np.array([np.arctan2(turn[2, 1], turn[2, 2]), pitch, np.arctan2(turn[1, 0], turn[0, 0])])


def _shifted(place: np.ndarray) -> np.ndarray:
    frame = np.eye(4)
    frame[:3, 3] = place
    return frame


def _numbers(values: object) -> str:
    # Adding 0 makes a zero of a rounded -0.
    return " ".join(f"{value:.12g}" for value in np.round(np.asarray(values, float), 12) + 0.0)


def _name(cell: Cell) -> str:
    return f"limber_cell_{Path(cell.arm.name).stem}"


def _text(root: Element) -> str:
    ElementTree.indent(root)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"
