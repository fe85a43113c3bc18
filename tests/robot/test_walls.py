"""Contact with something stiff: the force stays below the hard limit plus a tenth."""

from contextlib import contextmanager, nullcontext

import numpy as np
import pytest

from benchmarks.robot_stepped import SteppedRobot, Wall
from limber.cell.cell_file import Cell
from limber.core.errors import InputError
from limber.core.numerics.rigid import matrices
from limber.robot.driver.link import RobotLink
from limber.robot.motion import trajectory
from limber.robot.operator_decisions import _force_left
from limber.robot.virtual.controller import Controller
from limber.stages.pulls.record_path import there_and_back

TOOL = np.array([0.0, 0.0, 0.15])
CELL = Cell(robot={"model": "ur5e"}, base={"pose": (0,) * 6},
            tool={"grasp_pose": (*TOOL, 0, 0, 0), "mass_kg": 0.0})


def facing_a_wall(speed: float, stiffness: float, *, predicted: bool,
                  ) -> tuple[SteppedRobot, Wall, trajectory.Trajectory]:
    """A way of 60 mm at ``speed`` and a wall 30 mm away: the robot, the wall, the way."""
    controller = Controller("ur5e", seed=1)
    controller.set_tool(np.r_[TOOL, 0, 0, 0])
    start = controller.pose.copy()
    wall = Wall(TOOL, np.array([0, -1.0, 0]), start[:3] + [0, 0.03, 0], stiffness)
    controller.load = wall
    poses = trajectory.densely(np.array([start, start + [0, 0.06, 0, 0, 0, 0]]))
    path = trajectory.Trajectory(trajectory.along(poses, speed, 0.3), poses,
                      trajectory.ExpectedWrench.nothing(poses) if predicted else None)
    return SteppedRobot(controller), wall, path


def against_a_wall(*arguments, cell: Cell = CELL, **named) -> tuple[SteppedRobot, Wall, dict]:
    """Go it: the robot, the wall, and how it ended."""
    robot, wall, path = facing_a_wall(*arguments, **named)
    with robot.here(), RobotLink(cell) as link:
        link.wait_for_samples()
        link.tare(0.1)
        event = link.follow(path)
        robot.rest(0.3)
        assert np.abs(robot.controller.speeds).max() < 1e-3
    return robot, wall, event


@pytest.mark.parametrize("predicted", [True, False])
def test_a_wall_at_full_speed_stays_below_the_hard_limit(predicted):
    """20 N/mm at 50 mm/s: without a prediction the soft limit pauses, and brakes for it."""
    _, wall, event = against_a_wall(0.05, 2e4, predicted=predicted)
    assert event["event"] in ("paused", "stopped")
    assert wall.peak > 5.0
    assert wall.peak <= 1.1 * CELL.limits.hard_force_n


def stating(stiffness: float) -> Cell:
    return CELL.model_copy(update={"limits": CELL.limits.model_copy(update={
        "contact_n_per_m": stiffness})})


@pytest.mark.parametrize("predicted", [True, False])
@pytest.mark.parametrize("stiffness", [5e3, *(pytest.param(stiffness, marks=pytest.mark.slow)
                                              for stiffness in (1e5, None))])
def test_at_the_speed_that_is_chosen_a_contact_stays_below_the_hard_limit(stiffness, predicted):
    """A soft one needs no less than the cell's speed; a rigid one, the default, is met slowly."""
    cell, told = CELL if stiffness is None else stating(stiffness), []
    speed = trajectory.speed_within(cell, 0.05, told.append)
    assert (speed == 0.05) == (stiffness == 5e3) == (not told)
    assert speed == min(0.05, trajectory.contact_speed(cell)) > 0.005
    if told:
        assert f"at {1e3 * speed:.1f} mm/s instead of 50.0 mm/s" in told[0]
        assert "state limits.contact_n_per_m" in told[0]
    _, wall, event = against_a_wall(speed, stiffness or 2e5, predicted=predicted, cell=cell)
    assert event["event"] in ("paused", "stopped")
    assert 3.0 < wall.peak <= 1.1 * CELL.limits.hard_force_n


def test_a_motion_of_a_cell_that_states_no_stiffness_meets_rigid_things_slowly():
    """Pulls, paths and motions of the arm alone keep to it, whatever speed is asked."""
    frames = np.tile(CELL.arm.forward(np.array(CELL.arm.home)) @ matrices(
        np.array(CELL.tool.grasp_pose)), (2, 1, 1))
    frames[1, :3, 3] += [0, 0.03, 0]
    most = trajectory.contact_speed(CELL)
    assert 0.005 < most < 0.01
    for cell, speed in ((CELL, most), (stating(1e3), 0.05)):
        pull = there_and_back(cell, frames, speed=0.05, cycles=1, pause=0.1)
        assert pull.greatest_speeds[0] == pytest.approx(speed, rel=0.01)


def test_a_contact_that_no_speed_is_slow_enough_for_is_refused():
    with pytest.raises(InputError, match="even at 1 mm/s"):
        trajectory.contact_speed(stating(1e7))
    slow = CELL.model_copy(update={"robot": CELL.robot.model_copy(update={"model": "ur5"}),
                                   "sensor": CELL.sensor.model_copy(update={"kind": "ft300"})})
    assert trajectory.contact_speed(slow) < trajectory.contact_speed(CELL)


@contextmanager
def paused_at_a_wall(take=None):
    """The robot, the wall and the driver's link, at the soft limit."""
    robot, wall, path = facing_a_wall(0.05, 2e4, predicted=False)
    with robot.here(), RobotLink(CELL, take) as link:
        link.wait_for_samples()
        link.tare(0.2)
        assert link.follow(path)["event"] == "paused"
        yield robot, wall, link


@pytest.mark.slow
def test_after_a_pause_it_goes_on_from_where_it_braked():
    """The wall is taken away; nothing jumps, and the end of the path is reached."""
    rows = []
    with paused_at_a_wall(rows.append) as (robot, wall, link):
        robot.rest(0.3)
        wall.stiffness, stood = 0.0, robot.controller.pose[:3].copy()
        assert link.resume()["event"] == "reached"
    places = np.concatenate(rows)[:, 1:4]
    assert np.linalg.norm(np.diff(places, axis=0), axis=1).max() < 0.05 * 0.002 * 1.5
    assert np.linalg.norm(places[-1] - stood) > 0.02


@pytest.mark.slow
def test_from_a_pause_at_something_stiff_it_goes_back_until_no_force_is_left():
    with paused_at_a_wall() as (robot, wall, link):
        assert link.retreat()["event"] == "reached"
    assert wall.peak > CELL.limits.soft_force_n and wall.now == 0.0
    assert np.allclose(robot.controller.flange, Controller("ur5e").flange, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("anew", [False, True])
def test_a_sensor_zeroed_against_a_wall_is_known_on_the_way_back(anew):
    """An e-Series zeroes it as a program starts anew, here or of another driver."""
    with paused_at_a_wall() as (robot, wall, first):
        robot.controller.stop_program("pendant")
        robot.rest(0.2)
        assert wall.now > 8.0
        if anew:
            first.process.kill()
        with RobotLink(CELL) if anew else nullcontext(first) as link:
            assert link.retreat()["event"] == "reached"
            assert wall.now == 0.0 and _force_left(link) < 0.5
