"""An arm that Limber does not have: all that it takes is in this file.

Six joints: base about z, shoulder and elbow about y, and a wrist whose three axes (x, y, x) meet
in a point. Its links, inverse kinematics and controller have nothing of a UR's.
"""

import os
import subprocess
import sys
from dataclasses import dataclass

import numpy as np
import pytest
from tests.robot.conftest import Registers, dry_run

from benchmarks.robot_cells import standing_at
from limber.cell.arm import Rods
from limber.cell.cell_file import Cell
from limber.cell.known_arms import arm_named, register_arm
from limber.core.errors import InputError
from limber.core.numerics.rigid import inverted, matrices, pose_vectors
from limber.robot.driver.controls import control_of, register_control
from limber.robot.motion.joint_path import follow
from limber.robot.motion.trajectory import densely
from limber.robot.virtual.controller import Controller
from limber.store import Branch

UPPER, FORE, FOOT, FLANGE = 0.45, 0.42, 0.35, 0.09
_AXES = "zyyxyx"
_WAYS = np.array([[0, 0, 0], [0, 0, FOOT], [UPPER, 0, 0], [FORE, 0, 0], [0, 0, 0], [0, 0, 0]])


def _turned(axis: str, angles: np.ndarray) -> np.ndarray:
    return matrices(np.multiply.outer(angles, np.r_[0, 0, 0, np.eye(3)["xyz".index(axis)]]))


def _moved(*way: float) -> np.ndarray:
    frame = np.eye(4)
    frame[:3, 3] = way
    return frame


_TIP = _moved(FLANGE, 0, 0) @ _turned("y", np.array(np.pi / 2))


@dataclass(frozen=True)
class PieperArm:
    """As limber.cell.arm.Arm asks for it."""

    name: str = "pieper-6"
    controller: str = "pieper"
    rate: float = 250.0
    measures_force: bool = True
    payload: float = 4.0
    joint_names: tuple[str, ...] = ("waist", "shoulder", "elbow", "roll", "pitch", "screw")
    ros_joints: tuple[str, ...] = tuple(f"pieper_joint_{number}" for number in range(6))
    joint_speed: tuple[float, ...] = (2.0,) * 6
    home: tuple[float, ...] = (0.0, -1.0, 1.6, 0.0, 0.9, 0.0)
    reach: float = UPPER + FORE
    link_radius: float = 0.04
    singularity_names: tuple[str, ...] = ("wrist", "elbow", "waist")

    joint_limits = np.tile([-3.0, 3.0], (6, 1))
    shoulder = np.array([0.0, 0.0, FOOT])

    def link_frames(self, joints):
        frame, frames = np.broadcast_to(np.eye(4), (*np.shape(joints)[:-1], 4, 4)), []
        for number, axis in enumerate(_AXES):
            frame = frame @ _moved(*_WAYS[number]) @ _turned(axis, np.asarray(joints)[..., number])
            frames.append(frame)
        return np.stack([*frames, frame @ _TIP], axis=-3)

    def forward(self, joints):
        return self.link_frames(joints)[..., -1, :, :]

    def jacobian(self, joints):
        frames = self.link_frames(joints)
        axes = np.stack([frames[..., number, :3, "xyz".index(axis)]
                         for number, axis in enumerate(_AXES)], axis=-1)
        levers = frames[..., -1:, :3, 3] - frames[..., :-1, :3, 3]
        moved = np.cross(np.swapaxes(axes, -1, -2), levers)
        return np.concatenate([np.swapaxes(moved, -1, -2), axes], axis=-2)

    def inverse(self, frames, near=None):
        frames = np.asarray(frames) @ inverted(_TIP)
        waist = np.arctan2(frames[..., 1, 3], frames[..., 0, 3])
        across = np.hypot(frames[..., 0, 3], frames[..., 1, 3])
        down = FOOT - frames[..., 2, 3]
        cosine = (across**2 + down**2 - UPPER**2 - FORE**2) / (2 * UPPER * FORE)
        found = []
        for side in (1.0, -1.0):
            elbow = side * np.arccos(np.where(np.abs(cosine) <= 1.0, cosine, np.nan))
            shoulder = np.arctan2(down, across) - np.arctan2(
                FORE * np.sin(elbow), UPPER + FORE * np.cos(elbow))
            arm = _turned("z", waist) @ _turned("y", np.nan_to_num(shoulder + elbow))
            hand = inverted(arm) @ frames
            for flip in (1.0, -1.0):
                pitch = np.arctan2(flip * np.hypot(hand[..., 1, 0], hand[..., 2, 0]),
                                   hand[..., 0, 0])
                roll = np.arctan2(flip * hand[..., 1, 0], -flip * hand[..., 2, 0])
                screw = np.arctan2(flip * hand[..., 0, 1], flip * hand[..., 0, 2])
                joints = np.stack([waist, shoulder, elbow, roll, pitch, screw], axis=-1)
                joints[np.isnan(joints).any(axis=-1)] = np.nan
                found.append(joints)
        return np.stack(found, axis=-2)

    def configurations(self, frames, near=None):
        return np.moveaxis(self.inverse(frames, near), -2, 0)

    def singularity_distance(self, joints):
        wrist = self.link_frames(joints)[..., 3, :2, 3]
        return np.stack([np.abs(np.sin(joints[..., 4])), np.abs(np.sin(joints[..., 2])),
                         np.linalg.norm(wrist, axis=-1) / self.reach], axis=-1)

    def rods(self, joints):
        places = self.link_frames(joints)[..., :3, 3]
        return Rods(("upper arm", "forearm"), places[:, 1:3], places[:, 2:4], np.array([0.06] * 2))


ARM = PieperArm()
register_arm(ARM)


def random_joints(count: int) -> np.ndarray:
    return np.random.default_rng(4).uniform(-1.4, 1.4, (count, 6)) + [0, 0, 0, 0, 1.5, 0]


def test_it_is_known_by_its_name_and_no_other_arm_is():
    assert arm_named("Pieper 6") is ARM
    with pytest.raises(InputError, match="An arm named 'pieper-6' is already registered"):
        register_arm(PieperArm())


_PLUGGED = """
from dataclasses import replace
from limber.cell.known_arms import register_arm
from limber.cell.ur_arms import ARMS
register_arm(replace(ARMS["ur5"], name="plugged-6"))
"""
_ASKED = "from limber.cell.known_arms import arm_named; print(arm_named('plugged 6').name)"


@pytest.mark.slow
@pytest.mark.parametrize("module, told", [("plugged", "plugged-6"),
                                          ("gone", "The arm 'six' from gone cannot be imported")])
def test_an_installed_package_has_its_arm_known_in_every_process(tmp_path, module, told):
    (tmp_path / "plugged.py").write_text(_PLUGGED, encoding="utf-8")
    (tmp_path / "plugged-1.0.dist-info").mkdir()
    (tmp_path / "plugged-1.0.dist-info" / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: plugged\nVersion: 1.0\n", encoding="utf-8")
    (tmp_path / "plugged-1.0.dist-info" / "entry_points.txt").write_text(
        f"[limber.arms]\nsix = {module}\n", encoding="utf-8")
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    asked = subprocess.run([sys.executable, "-c", _ASKED], capture_output=True, text=True,
                           check=False, env={**os.environ, "PYTHONPATH": path})
    assert told in asked.stdout + asked.stderr


def test_its_kinematics_agree_with_each_other():
    joints = random_joints(200)
    frames = ARM.forward(joints)
    solutions = ARM.inverse(frames)
    exist = np.isfinite(solutions).all(axis=-1)
    assert exist.any(axis=1).mean() > 0.5
    reached = ARM.forward(np.nan_to_num(solutions))
    assert np.abs(reached - frames[:, None])[exist].max() < 1e-9
    step = 1e-6
    for number in range(6):
        moved = joints.copy()
        moved[:, number] += step
        slopes = (ARM.forward(moved)[:, :3, 3] - frames[:, :3, 3]) / step
        assert ARM.jacobian(joints)[:, :3, number] == pytest.approx(slopes, abs=1e-5)


def test_a_path_is_followed_in_each_of_its_own_configurations():
    start = pose_vectors(ARM.forward(np.array(ARM.home)))
    frames = matrices(densely(np.array([start, start + [0.05, 0.05, 0.02, 0, 0, 0.2]])))
    paths, refusals = follow(ARM, frames)
    assert len(paths) + len(refusals) == 4 and len(paths) >= 2
    for path in paths:
        assert np.abs(ARM.forward(path.joints) - frames).max() < 1e-9
        assert np.abs(np.diff(path.joints, axis=0)).max() < 0.1
    away = frames.copy()
    away[-1, 0, 3] += 3.0
    assert {refusal.reason for refusal in follow(ARM, away)[1]} == {"out of the arm's reach"}


@pytest.mark.slow
def test_a_plan_is_checked_for_it_and_its_dry_run_written(planned_folder, tmp_path):
    """Its joints bring the gripper to where the table has it; an obstacle is held against it."""
    cell = standing_at(Branch.open(planned_folder), "127.0.0.97", model="pieper-6")
    far = {"kind": "box", "name": "wall", "size_m": (0.1, 0.1, 0.1), "pose": (5, 5, 0, 0, 0, 0)}
    cell = Cell.model_validate(cell.model_dump() | {"obstacles": [far]})
    assert dry_run(planned_folder, cell, tmp_path)[
        "singularity_distance"] >= cell.limits.singularity


def cell_of(name: str) -> Cell:
    return Cell(robot={"model": name}, base={"pose": (0,) * 6})


def test_it_is_not_moved_until_its_controller_has_a_driver():
    with pytest.raises(InputError, match=r"No driver is registered for controller 'pieper'.*"
                                         r"register_control"):
        control_of(cell_of("pieper-6"))
    opened = object()
    register_control("pieper", lambda cell: opened)
    assert control_of(cell_of("pieper-6")) is opened


def test_the_cell_knows_its_payload_and_joints():
    with pytest.raises(ValueError, match="but a pieper-6 carries at most 4 kg"):
        Cell(robot={"model": "pieper-6"}, base={"pose": (0,) * 6}, tool={"mass_kg": 4.5})
    with pytest.raises(ValueError, match="joint_limits_rad has 5 rows, but a pieper-6 has 6"):
        Cell(robot={"model": "pieper-6", "joint_limits_rad": [(-1, 1)] * 5},
             base={"pose": (0,) * 6})


def test_the_virtual_controller_moves_it_on_a_line():
    registers = Registers(Controller("pieper-6", seed=3))
    start = registers.controller.pose.copy()
    target = start + [0.05, 0.03, -0.02, 0, 0, 0.1]
    poses = registers.line(target)
    assert poses[-1] == pytest.approx(target, abs=1e-6)
    way = target[:3] - start[:3]
    off = np.cross(poses[:, :3] - start[:3], way) / np.linalg.norm(way)
    assert np.linalg.norm(off, axis=1).max() < 1e-4
    assert ARM.forward(registers.controller.joints) == pytest.approx(
        registers.controller.flange, abs=1e-12)
