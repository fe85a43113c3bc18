"""The base from touched points: by the controller's own pose, and no mirrored frame passes."""

import socket
import struct
import threading
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from tests.subjects.commands import robot_answer

from limber.cell.cell_file import Cell, read_cell, write_cell
from limber.cell.ur_arms import ARMS
from limber.core.errors import InputError
from limber.core.numerics.rigid import matrices, pose_vectors
from limber.geometry.rigid_kernels import pose_of
from limber.robot.calibration import fit_base, gripper_pose
from limber.robot.controller_settings import differences
from limber.robot.interface import Sample
from limber.robot.ur import factory_calibration as factory

GRASP = (0.01, 0.0, 0.15, 0.0, 0.0, 0.3)
BASE = np.array([0.6, -0.2, 0.1, 0.3, -0.4, 1.2])
ON_BRANCH = np.array([[0.1, 0, 0], [-0.1, 0.08, 0], [-0.05, -0.1, 0], [0, 0, 0.3], [0.02, 0, 0.5]])


def touched_at(on_branch: np.ndarray) -> np.ndarray:
    frame = matrices(BASE)
    return (on_branch - frame[:3, 3]) @ frame[:3, :3]


def sample_with(tool: tuple[float, ...], joints: np.ndarray, *, tells_it: bool = False) -> Sample:
    """What the controller of an arm says whose links are millimetres off their nominal measures."""
    arm = Cell(robot={"model": "ur5e"}, base={"pose": (0,) * 6}).arm
    true = replace(arm, a=tuple(np.array(arm.a) * 1.004), d=tuple(np.array(arm.d) * 1.01))
    pose = pose_of(true.forward(joints) @ matrices(np.array(tool)))
    nothing = np.zeros(6)
    return Sample(1.0, 1.0, joints, nothing, pose, nothing, nothing, 7, 1, 2, 1.0,
                  np.array(tool) if tells_it else None)


@pytest.mark.parametrize("tool, tells_it", [(GRASP, False), ((0,) * 6, False),
                                            ((0.03, 0, 0.05, 0.4, 0, 0), True)])
def test_a_touched_place_is_the_controllers_own(tool, tells_it):
    """Links 2 to 4 mm longer than nominal: not a micrometre of that is left."""
    cell = Cell(robot={"model": "ur5e"}, base={"pose": (0,) * 6}, tool={"grasp_pose": GRASP})
    joints = np.array(cell.arm.home) + 0.1
    true = sample_with(GRASP, joints).pose[:3]
    sample = sample_with(tool, joints, tells_it=tells_it)
    assert gripper_pose(cell, sample)[:3] == pytest.approx(true, abs=1e-9)
    nominal = (cell.arm.forward(joints) @ matrices(np.array(GRASP)))[:3, 3]
    assert np.linalg.norm(nominal - true) > 2e-3


def test_a_pose_of_another_tool_is_refused():
    cell = Cell(robot={"model": "ur5e"}, base={"pose": (0,) * 6}, tool={"grasp_pose": GRASP})
    with pytest.raises(InputError, match=r"tool.grasp_pose is at \(10, 0, 150\) mm"):
        gripper_pose(cell, sample_with((0.0, 0.0, 0.2, 0, 0, 0), np.array(cell.arm.home)))


@pytest.mark.parametrize("on_branch, told", [
    (ON_BRANCH[:3], "3 points on the branch. Four or more"),
    (np.vstack([ON_BRANCH[:3], [[0.02, 0.05, 0.0]]]), r"spread by 0\.0 mm out of.*5 mm are needed"),
    (np.vstack([ON_BRANCH[:3], [[0.02, 0.05, 0.008]]]), "lie in a plane"),
    (ON_BRANCH[[0, 1, 2, 3, 3]], r"Points 4 and 5 are 0\.0 mm apart"),
    (np.vstack([ON_BRANCH, ON_BRANCH[:1] + 0.003]), r"Points 1 and 6 are 5\.2 mm apart"),
    (np.outer(np.arange(5), [0.1, 0.02, 0.05]), "across their line"),
])
def test_points_that_leave_a_frame_open_are_refused(on_branch, told):
    with pytest.raises(InputError, match=told):
        fit_base(touched_at(on_branch), on_branch)


def test_points_touched_in_one_place_are_refused():
    with pytest.raises(InputError, match=r"Points rim-1 and rim-2 are 0\.0 mm apart as they were"):
        fit_base(np.zeros((5, 3)), ON_BRANCH, names=[f"rim-{k + 1}" for k in range(5)])


@pytest.mark.parametrize("mirror", [np.diag([1, -1, 1]), np.eye(3)[[1, 0, 2]]])
def test_mirrored_points_are_named_as_such(mirror):
    """A y axis with the wrong sign; two columns that were swapped."""
    with pytest.raises(InputError, match="fit only when mirrored"):
        fit_base(touched_at(ON_BRANCH), ON_BRANCH @ mirror)
    # As flat as is accepted at all, they are off by more than is allowed.
    flat = np.vstack([ON_BRANCH[:3], [[0.02, 0.05, 0.0132]]])
    assert fit_base(touched_at(flat), flat).residual < 1e-9
    with pytest.raises(InputError, match="fit only when mirrored"):
        fit_base(touched_at(flat), flat @ mirror)


@pytest.mark.parametrize("factor", [1000.0, 1.03])
def test_points_in_another_unit_are_named_as_such(factor):
    """Millimetres, and a scan that is 3 % too large."""
    with pytest.raises(InputError, match=rf"multiplied by {1 / factor:.4g}\."):
        fit_base(factor * touched_at(ON_BRANCH), ON_BRANCH, largest_residual=0.002)


def test_two_points_that_were_swapped_are_named():
    names = ["rim", "twig", "pot", "fork", "tip"]
    touched = touched_at(ON_BRANCH)[[0, 1, 3, 2, 4]]
    with pytest.raises(InputError, match="only when pot and fork are swapped"):
        fit_base(touched, ON_BRANCH, names=names)
    moved = touched_at(ON_BRANCH) + [[0.05, 0, 0], *np.zeros((4, 3))]
    with pytest.raises(InputError, match=r"Point rim is 50\.0 mm from where the other points"):
        fit_base(moved, ON_BRANCH, names=names)


def test_one_point_beside_its_place_is_named_and_rough_touching_is_not():
    """8 mm off among five: the fit bends to it, and shows half of that."""
    random, sound = np.random.default_rng(5), 0
    for way in random.normal(size=(40, 3)):
        touched = touched_at(ON_BRANCH) + random.normal(0, 7e-4, ON_BRANCH.shape)
        with suppress(InputError):
            sound += fit_base(touched, ON_BRANCH).residual < 2e-3
        touched[2] += 8e-3 * way / np.linalg.norm(way)
        with pytest.raises(InputError, match=r"Point 3 is \d+\.\d mm from|may also be 3"):
            fit_base(touched, ON_BRANCH)
        # All of them touched roughly, and said so: that deviation means nothing then.
        assert fit_base(touched, ON_BRANCH, largest_residual=0.04).residual > 1e-3
    assert sound >= 39


def test_the_command_states_each_points_residual(branch_folder, tmp_path, capfd):
    """And refuses three points before anything is touched."""
    write_cell(tmp_path / "cell.toml", Cell(robot={"model": "ur5e"}, base={"pose": (0,) * 6}))
    touched = touched_at(ON_BRANCH) + [[0.001, 0, 0], *np.zeros((4, 3))]

    def run(count: int) -> tuple[int, dict]:
        rows = np.hstack([ON_BRANCH, touched, np.zeros((5, 3))])[:count]
        (tmp_path / "points.csv").write_text("".join(
            ",".join([f"p{k}", *map(str, row)]) + "\n" for k, row in enumerate(rows)))
        return robot_answer(capfd, "calibrate", tmp_path / "cell.toml", branch_folder, "--points",
                            tmp_path / "points.csv")
    code, told = run(5)
    assert code == 0 and [point["name"] for point in told["points"]] == [f"p{k}" for k in range(5)]
    off = np.array([point["residual_m"] for point in told["points"]])
    assert off.argmax() == 0 and np.sqrt(np.mean(off**2)) == pytest.approx(told["residual_m"])
    held = matrices(np.array(read_cell(tmp_path / "cell.toml").base.pose))
    assert pose_vectors(held) == pytest.approx(BASE, abs=5e-3)
    code, told = run(3)
    assert code == 2 and "Four or more" in told["error"]


def test_the_arms_own_dimensions_are_read_from_its_controller(own_address):
    """In a thread: bytes as a controller sends them, between others and cut anywhere."""
    arm = factory.one_arm(ARMS["ur5e"], 0.004, np.random.default_rng(3))
    sent = factory.FactoryCalibration.of(arm)
    other = struct.pack(">iB", 12, 0) + bytes(7)
    inner = factory.kinematics_message(sent)[5:]
    state = struct.pack(">iB", 5 + len(other) + len(inner), 16) + other + inner
    stream = struct.pack(">iBi", 9, 20, 1) + struct.pack(">iB", 17, 16) + other + state
    with socket.create_server((own_address, factory.PRIMARY_PORT)) as server:
        def serve() -> None:
            for end in (len(stream), 40, 0):
                theirs, _ = server.accept()
                with theirs:
                    for part in (stream[:end // 2], stream[end // 2:end]):
                        theirs.sendall(part)
        threading.Thread(target=serve, daemon=True).start()
        found = factory.read_calibration(own_address)
        assert [factory.read_calibration(own_address) for _ in range(2)] == [None, None]
    assert found.checksums == sent.checksums
    joints = np.array([0.3, -1.2, 1.4, -1.0, -1.5, 0.4])
    assert found.forward(joints) == pytest.approx(arm.forward(joints), abs=1e-12)
    off, turned = found.off_nominal(ARMS["ur5e"], joints)
    assert 1e-3 < off < 0.02 and turned < 1e-6
    assert factory.read_calibration(own_address) is None


def test_a_tool_off_by_five_millimetres_shows_in_an_older_controller_too():
    """Nominal dimensions explain a centimetre; those that the controller reports, nothing."""
    own = factory.one_arm(ARMS["ur5"], 0.004, np.random.default_rng(1))
    joints = np.array([0.3, -1.2, 1.4, -1.0, -1.5, 0.4])
    cell = Cell(robot={"model": "ur5"}, base={"pose": (0,) * 6},
                tool={"grasp_pose": (0, 0, 0.15, 0, 0, 0)}, sensor={"kind": "ft300"})

    def told(tool: tuple) -> list[str]:
        pose = pose_vectors(own.forward(joints) @ matrices(np.array(tool)))
        sample = Sample(0.0, 0.0, joints, np.zeros(6), pose, np.zeros(6), np.zeros(6), 7, 1, 1, 1.0)
        return [each.what for each in differences(cell, sample, factory.FactoryCalibration.of(own))]
    assert told((0, 0, 0.15, 0, 0, 0)) == []
    assert told((0.005, 0, 0.15, 0, 0, 0)) == ["tool centre point"]
