"""The way that was followed, on disk: whole after a crash, and only for the arm that went it."""

import numpy as np
import pytest
from tests.robot.test_start import ARM, POSE, led, line, sample_at

from limber.cell.cell_file import Cell
from limber.core.errors import InputError
from limber.robot.motion.retreat import (
    FollowedPathFile,
    RetreatPath,
    followed_path,
    followed_path_file,
    read_followed_path,
)
from limber.robot.motion.trajectory import Trajectory, along

CELL = Cell(robot={"model": "ur5e", "address": "127.0.0.9"}, base={"pose": (0,) * 6})


@pytest.fixture(autouse=True)
def _own_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("LIMBER_STATE", str(tmp_path))


def followed(bias=None) -> np.ndarray:
    """Follow 50 mm with a tare before; returns the last pose."""
    kept = FollowedPathFile(CELL)
    if bias is not None:
        kept.tared(np.array(bias))
    way = RetreatPath(ARM.joint_names, None, kept)
    out = line(0.05)
    way.begin(sample_at(POSE), Trajectory(along(out, 0.03, 0.3), out))
    led(way, out)
    kept.close()
    return out[-1]


def test_another_program_goes_the_same_way_back():
    """Poses, speeds, tare: what the first would have gone, the next goes."""
    end = followed(bias=[1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    found = read_followed_path(CELL)
    assert found.bias == pytest.approx([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    assert found.gripper_closed is None
    # As after `limber robot weigh`, which tares without the gripper's weight.
    lighter = CELL.model_copy(update={"tool": CELL.tool.model_copy(update={"mass_kg": 0.5})})
    assert read_followed_path(lighter).bias is None
    back = RetreatPath(ARM.joint_names, found).from_here(sample_at(end), 0.3)
    assert back.poses[-1] == pytest.approx(POSE) and back.greatest_speeds[0] <= 0.015 * (1 + 1e-6)
    # A new way forgets the old one, but not tare and gripper.
    kept = FollowedPathFile(CELL)
    kept.tared(np.ones(6))
    kept.gripped(True)
    RetreatPath(ARM.joint_names, found, kept).begin(
        sample_at(end), Trajectory(np.array([0.0, 1.0]), np.array([end, POSE])))
    kept.close()
    found = read_followed_path(CELL)
    assert len(found.poses) == 1 and found.poses[0] == pytest.approx(end)
    assert found.gripper_closed is True and found.bias == pytest.approx(np.ones(6))


def test_a_torn_line_is_left_out_and_nonsense_is_no_way():
    followed()
    path = followed_path_file(CELL)
    whole = path.read_text()
    path.write_text(whole[:-30])
    assert len(read_followed_path(CELL).poses) == whole.count('"pose"') - 1
    for spoilt in ("", "nonsense", whole.replace('"joints": [', '"joints": [1.0, '),
                   whole.replace('"pose": [', '"pose": [null, ')):
        path.write_text(spoilt)
        assert read_followed_path(CELL) is None
    path.unlink()
    assert read_followed_path(CELL) is None
    with pytest.raises(InputError, match=r"No path that the robot at .*by hand"):
        followed_path(CELL, "Free the branch by hand.")


def test_the_way_of_another_arm_or_tool_is_none():
    followed()
    assert read_followed_path(CELL) is not None
    assert read_followed_path(CELL.model_copy(update={"tool": CELL.tool.model_copy(update={
        "grasp_pose": (0, 0, 0.1, 0, 0, 0)})})) is None
    assert read_followed_path(CELL.model_copy(update={"robot": CELL.robot.model_copy(update={
        "model": "ur3e"})})) is None


@pytest.mark.parametrize("gone", [2e-3, 2e-4, 2e-5])
def test_a_short_way_back_does_not_take_forever(gone):
    """Stopped at once against something stiff, the way has two places: it took half an hour."""
    way = RetreatPath(ARM.joint_names)
    way.begin(sample_at(POSE), Trajectory(along(line(0.05), 0.03, 0.3), line(0.05)))
    here = sample_at(POSE + np.r_[0.0, gone, np.zeros(4)])
    back = way.from_here(here, 0.3)
    assert len(back.times) == 2 and back.duration < 0.5
    assert back.greatest_speeds[0] <= 0.015 * (1 + 1e-6)
