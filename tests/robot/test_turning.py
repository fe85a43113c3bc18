"""The gripper turned beyond the branch's own rotation, and the torque that it takes."""

import numpy as np
import pytest

from limber.cell.cell_file import Cell
from limber.core.errors import NoPathError
from limber.core.numerics.rigid import angle_between, pose_vectors, turn_between
from limber.planning.plan_file import PlanTurning
from limber.robot.motion import execution as turning
from limber.robot.motion.execution import TurnCost, turned, turned_motion
from limber.robot.motion.trajectory import Predicted
from limber.stages.paths.execute_path import offsets_along

CELL = Cell(robot={"model": "ur5e"}, base={"pose": (0.55, 0.1, 0.0, 0, 0, 0.4)},
            tool={"grasp_pose": (0, 0, 0.15, 0, 0, 0)}, approach={"distance_m": 0.02})
SHARE = np.linspace(0.0, 1.0, 6)[:, None]
PLACES = np.array([0.0, 0.0, 0.5]) + SHARE * [0.03, 0.01, -0.01]
NATURAL = SHARE * [0.0, 0.0, 0.6]  # the branch turns by as much
STIFFNESS = np.diag([2.0, 3.0, 0.5])  # [N m/rad]
AXIS, GRIP = np.array([0, 0, 1.0]), np.array([0.0, -np.pi / 2, 0.0])


@pytest.fixture(autouse=True)
def few_axes(monkeypatch):
    """Six of the 26: each that is tried takes a motion of the arm."""
    monkeypatch.setattr(turning, "_AXES", np.vstack([np.eye(3), -np.eye(3)]))


def cost_of(along):
    slopes = np.zeros((len(along), 6, 3))
    slopes[:, 3:] = STIFFNESS
    return TurnCost(along, np.zeros((len(along), 6)), slopes)


def within(most):
    """An obstacle to every gripper that turns by more than ``most`` [rad] on its way."""
    def blocked(flange, _joints):
        vectors = pose_vectors(flange)[:, 3:]
        turned_by = max(angle_between(vectors[0], one) for one in vectors)
        return NoPathError("Turned too far.", "", "") if turned_by > most else None
    return blocked


def asked(slack, most, limits=(np.inf, np.inf)):
    along = np.linalg.norm(PLACES - PLACES[0], axis=1)
    predicted = Predicted.of_forces(np.hstack([PLACES, NATURAL]), 0.0 * PLACES)
    return turned_motion(CELL, predicted, AXIS, cost_of(along), slack, limits, speed=0.03,
                         rotation=GRIP, blocked=within(most))


def test_the_gripper_lags_behind_the_branch_where_it_may_not_turn_with_it():
    """From nothing at the grasp, about the axis that it needs, hardly farther than it needs; its
    energy and torque are those of a spring."""
    found = asked(0.5, 0.4)
    assert not found.offsets[0].any()
    last = found.offsets[-1]
    assert last[2] < 0.0 and abs(last[2]) > 0.9 * np.linalg.norm(last)
    assert 0.19 < np.linalg.norm(last) < 0.26
    assert found.energies[-1] == pytest.approx(0.5 * last @ STIFFNESS @ last)
    assert found.torques[-1] == pytest.approx(np.linalg.norm(STIFFNESS @ last))
    held = found.motion.path.poses
    assert angle_between(held[0, 3:], held[-1, 3:]) <= 0.4 + 1e-9


@pytest.mark.parametrize(("slack", "limits"), [(0.1, (np.inf, np.inf)), (0.5, (np.inf, 0.05))])
def test_what_the_slack_or_the_torque_does_not_allow_is_refused(slack, limits):
    """With the reason of the motion without it, and how far was looked."""
    with pytest.raises(NoPathError, match=r"Turned too far.* No rotation of the gripper within"):
        asked(slack, 0.4, limits)


def test_an_arm_that_does_not_come_to_the_branch_is_refused_at_once(monkeypatch):
    """Turning the gripper later cannot help: no offset is tried."""
    monkeypatch.setattr(turning, "_offsets", lambda *_: pytest.fail("an offset was tried"))
    with pytest.raises(NoPathError, match="Turned too far"):
        asked(0.5, -1.0)


def test_an_executed_plan_turns_as_planned():
    """Interpolated by the length of the way; of a plan that turns with the branch not at all."""
    offsets = offsets_along({"along_m": [0.0, 0.1, 0.2], "offsets_rad": [
        [0, 0, 0], [0, 0, 0.1], [0, 0, 0.3]]}, np.array([[0.0, 0, 0], [0.15, 0, 0], [0.2, 0, 0]]))
    assert offsets[:, 2] == pytest.approx([0.0, 0.2, 0.3])
    assert not offsets_along(None, PLACES).any()
    poses = turned(np.hstack([PLACES, NATURAL]), -0.5 * NATURAL)
    assert turn_between(poses[0, 3:], poses[-1, 3:]) == pytest.approx([0, 0, 0.3])
    with pytest.raises(ValueError, match="a row for each"):
        PlanTurning(along_m=[0.0, 0.1], offsets_rad=[(0, 0, 0)])
