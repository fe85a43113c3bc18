"""Slips in a cell file: numbers impossible for an arm or a bench, and the probable slip.

A number in millimetres, degrees, grams or millinewtons is valid TOML and often still within the
range of one entry. Compared with the arm and with each other most of them show.
"""

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from limber.core.numerics.rigid import matrices
from limber.robot.load_ratings import greatest_force, greatest_torque

if TYPE_CHECKING:
    from limber.robot.cell.cell import Cell, SensorEntry

FAR = 20.0
"""Greatest distance from the branch [m] of any object that an arm works with."""
_FAR_FROM_ARM = 10.0  # m; distance of the branch's origin beyond the arm's reach
_AT_FLANGE = 1.0  # m; a tool is nearer to the flange
_WHOLE_TURN = 2 * math.pi + 1e-6
_DEGREES = 4 * math.pi  # no joint limit is beyond; in degrees nearly all are
_LARGEST_RANGE = {"force": 1e4, "torque": 1e3}  # [N], [N m]


def slips(cell: "Cell") -> Iterator[str]:
    """Yield contradictions of a cell with individually valid entries: "limits.hard_force_n is ...".
    """
    yield from _joint_slips(cell)
    yield from _pose_slips(cell)
    yield from _tool_slips(cell)
    yield from _limit_slips(cell)
    if cell.sensor.kind != "none":
        yield from _sensor_slips(cell.sensor, cell.limits.hard_force_n, cell.limits.hard_torque_nm)
    yield from _camera_slips(cell)
    yield from _position_slips(cell)


def _joint_slips(cell: "Cell") -> Iterator[str]:
    own = cell.robot.joint_limits_rad
    if own is None:
        return
    for number, (low, high) in enumerate(own):
        where = f"robot.joint_limits_rad, row {number + 1},"
        if max(abs(low), abs(high)) > _DEGREES:
            yield (f"{where} has {low:g} to {high:g} rad, which is over two turns; was it given in "
                   "degrees?")
        elif low >= high:
            yield f"{where} has {low:g} to {high:g} rad; the lower limit comes first"
        elif (np.diff(cell.joint_limits[number]) <= 2 * cell.limits.joint_margin_rad).any():
            yield (f"{where} has {low:g} to {high:g} rad, which leaves the joint no angle within "
                   f"the arm's own limits and the margin of {cell.limits.joint_margin_rad:g} rad")


def _pose_slips(cell: "Cell") -> Iterator[str]:
    reach = cell.arm.reach + _FAR_FROM_ARM
    poses: list[tuple[str, Any, float]] = [
        ("base.pose", cell.base.pose, reach), ("tool.grasp_pose", cell.tool.grasp_pose, _AT_FLANGE),
        ("sensor.pose", cell.sensor.pose, _AT_FLANGE)]
    if cell.camera is not None:
        most = _AT_FLANGE if cell.camera.mount == "flange" else FAR
        poses.append(("camera.pose", cell.camera.pose, most))
    if cell.second_arm is not None:
        poses += [("second_arm.base_pose", cell.second_arm.base_pose, reach),
                  ("second_arm.grasp_pose", cell.second_arm.grasp_pose, _AT_FLANGE)]
    poses += [(f"obstacles.{number}.pose", one.pose, FAR)
              for number, one in enumerate(cell.obstacles) if one.kind == "box"]
    for name, pose, most in poses:
        yield from _far(name, pose[:3], most)
        turn = math.hypot(*pose[3:])
        if turn > _WHOLE_TURN:
            yield (f"{name} is turned by {turn:g} rad, more than a whole turn; was the rotation "
                   "given in degrees?")
    yield from _far("tool.centre_of_mass_m", cell.tool.centre_of_mass_m, _AT_FLANGE)
    for number, part in enumerate(cell.tool.parts):
        for end in ("start_m", "end_m"):
            yield from _far(f"tool.parts.{number}.{end}", getattr(part, end), _AT_FLANGE)


def _tool_slips(cell: "Cell") -> Iterator[str]:
    """Values of the gripper that are those of a bare flange."""
    tool = cell.tool
    is_driven = tool.gripper in ("digital_output", "robotiq")
    if not any(tool.grasp_pose[:3]) and tool.gripper != "none" and (is_driven or tool.mass_kg):
        yield (f"tool.grasp_pose is at the flange, where the gripper (tool.gripper = "
               f'"{tool.gripper}") is screwed on; the flange would go where the fingers should be. '
               "State where the branch lies between the fingers, in the flange's frame, such as "
               "[0, 0, 0.15, 0, 0, 0] for fingers 0.15 m before it")
    if is_driven and tool.mass_kg == 0 and not cell.robot.address.startswith("127."):
        yield ("tool.mass_kg is 0, the mass of a bare flange, but tool.gripper is "
               f'"{tool.gripper}"; its weight would be taken for a force on the '
               "branch. State what the flange carries (`limber robot weigh` compares it)")


def _far(name: str, position: Any, most: float) -> Iterator[str]:
    distance = math.hypot(*position)
    if distance > most:
        yield (f"{name} is {distance:g} m away, farther than the {most:g} m that are possible; "
               f"{distance / 1000:g} m? Was it given in millimetres?")


def _limit_slips(cell: "Cell") -> Iterator[str]:
    limits, arm = cell.limits, cell.arm
    for name, value, most, unit in (
            ("hard_force_n", limits.hard_force_n, greatest_force(arm), "N"),
            ("unexpected_force_n", limits.unexpected_force_n, greatest_force(arm), "N"),
            ("hard_torque_nm", limits.hard_torque_nm, greatest_torque(arm), "N m")):
        if value > most:
            yield (f"limits.{name} is {value:g}, but a {arm.name} may exert at most {most:.3g} "
                   f"{unit}; {value / 1000:g} {unit}?")


def _sensor_slips(sensor: "SensorEntry", hard_force: float, hard_torque: float) -> Iterator[str]:
    for what, unit, hard, spread, span in (
            ("force", "n", hard_force, sensor.force_sigma_n, sensor.force_range_n),
            ("torque", "nm", hard_torque, sensor.torque_sigma_nm, sensor.torque_range_nm)):
        if hard < spread:
            yield (f"sensor.{what}_sigma_{unit} is {spread:g}, so that limits.hard_{what}_{unit} "
                   f"({hard:g}) is within its noise; was one of them given in another unit?")
        if span <= hard:
            yield (f"sensor.{what}_range_{unit} is {span:g}, but limits.hard_{what}_{unit} is "
                   f"{hard:g}: the sensor would be at the end of its range before the motion "
                   "stops")
        if span > _LARGEST_RANGE[what]:
            yield (f"sensor.{what}_range_{unit} is {span:g}, which no sensor at a flange has; "
                   f"{span / 1000:g}?")
    if sensor.drift_n_per_minute > sensor.force_range_n:
        yield (f"sensor.drift_n_per_minute is {sensor.drift_n_per_minute:g}, more than the "
               f"sensor's range ({sensor.force_range_n:g} N) in a minute")


def _camera_slips(cell: "Cell") -> Iterator[str]:
    camera = cell.camera
    if camera is None:
        return
    near, far = camera.range_m
    if not 0 <= near < far <= FAR:
        yield (f"camera.range_m is {near:g} to {far:g} m; it must rise, from 0 to at most {FAR:g} "
               "m. Was it given in millimetres?")
    if not all(0.1 * size < focal < 100 * size for focal, size in
               zip(camera.focal_px, (camera.width, camera.height), strict=True)):
        yield (f"camera.focal_px is {camera.focal_px}, which is no focal length of an image of "
               f"{camera.width} x {camera.height} pixels; was it given in millimetres?")
    if not all(0 <= at <= size for at, size in
               zip(camera.centre_px, (camera.width, camera.height), strict=True)):
        yield (f"camera.centre_px is {camera.centre_px}, outside the image of {camera.width} x "
               f"{camera.height} pixels")


def _position_slips(cell: "Cell") -> Iterator[str]:
    """Distances that the arm is to reach, compared with its reach from the base."""
    if cell.workspace is None:
        return
    low, high = np.array(cell.workspace.low_m), np.array(cell.workspace.high_m)
    shoulder = matrices(np.array(cell.base.pose)) @ np.r_[cell.arm.shoulder, 1.0]
    away = float(np.linalg.norm(shoulder[:3] - np.clip(shoulder[:3], low, high)))
    grasp = math.hypot(*cell.tool.grasp_pose[:3])
    # The distance from wrist to flange is less than the reach of any arm.
    most = 1.5 * cell.arm.reach + grasp
    if away > most:
        yield (f"workspace is {away:.3g} m from the arm's shoulder, but a {cell.arm.name} reaches "
               f"{most:.3g} m at most; are base.pose and workspace both in the branch's frame?")
