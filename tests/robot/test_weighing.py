"""A sensor that is wrong is named by the weight of a tilted gripper, before anything is pulled."""

from itertools import pairwise

import numpy as np
import pytest

from limber.cell.cell_file import Cell
from limber.cell.reach_and_collision import ArmSurroundings
from limber.cli.commands.robot.moves import log_move
from limber.cli.commands.robot.weigh import Weigh, compared, tilted_joints, weighed, weightless
from limber.core.errors import InputError
from limber.core.numerics.rigid import matrices, pose_vectors
from limber.robot.motion.joint_path import to_joints
from limber.robot.robot_state import require_weighed, unweighed, weighed_as

MASS = 0.9
SWAPPED = np.eye(3)[[1, 2, 0]]


def tilted(sensor: np.ndarray, *, mass: float = MASS, tilt: float = 0.23, seed: int = 0,
           axes=((1, 0, 0), (0, 1, 0))) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directions down, readings and times: start, two axes both ways, start; bias and drift."""
    rng = np.random.default_rng(seed)
    start = matrices(np.array([0, 0, 0, 2.2, 0.4, 0.1]))[:3, :3]
    turns = [np.zeros(3), *(sign * tilt * np.array(axis) for axis in axes for sign in (1, -1)),
             np.zeros(3)]
    downs = np.array([(start @ matrices(np.r_[0, 0, 0, turn])[:3, :3]).T @ [0, 0, -1.0]
                      for turn in turns])
    times = 4.0 * np.arange(len(turns))
    forces = 9.81 * mass * downs @ sensor.T + [3.0, -2.0, 5.0]
    forces += np.outer(times, [0, 0, 0.8 / 60]) + 0.02 * rng.standard_normal(forces.shape)
    return downs, forces, times


@pytest.mark.parametrize("sensor, told", [
    (np.eye(3), None), (-np.eye(3), "sign is wrong"), (SWAPPED, "axes are wrong"),
    (np.diag([1.0, -1.0, -1.0]), "axes are wrong"), (0.1019 * np.eye(3), "kilograms-force"),
    (0.2248 * np.eye(3), "pounds-force"), (0.5 * np.eye(3), "scale is wrong"),
    (np.zeros((3, 3)), "does not notice")])
def test_sign_axes_and_unit_are_named(sensor, told):
    for seed in range(5):
        found = compared(*tilted(sensor, seed=seed), MASS)
        assert (told is None and not found.faults) or (told and told in found.faults[0])
    if told is None:
        assert abs(found.mass - MASS) < 4 * found.sigma < 0.05


def test_a_mass_that_is_off_by_a_third_of_a_kilogram_is_named():
    found = compared(*tilted(np.eye(3), mass=MASS + 0.3), MASS)
    assert "tool.mass_kg" in found.faults[0] and found.mass == pytest.approx(1.2, abs=0.03)


def test_one_axis_or_no_mass_tell_nothing():
    with pytest.raises(InputError, match="is not tilted about two axes"):
        compared(*tilted(np.eye(3), axes=((1, 0, 0), (1, 0, 0))), MASS)
    with pytest.raises(InputError, match=r"no tool\.mass_kg above 0"):
        compared(*tilted(np.eye(3)), 0.0)


class Link:
    """A robot that stands where a motion ends, with a sensor of its own and a true mass."""

    def __init__(self, cell, joints, rows, sensor):
        self._cell, self._rows, self._sensor = cell, rows, sensor
        self._joints, self._clock = joints, 0.0
        self._rng = np.random.default_rng(0)

    def wait_for_samples(self):
        """It stands."""

    def tare(self, seconds):
        """The bias is fitted."""

    def follow(self, way):
        self._joints = way.joints[-1]
        return {"event": "reached"}

    def read(self, seconds):
        self._clock += seconds
        base = matrices(np.array(self._cell.base.pose))
        flange = self._cell.arm.forward(self._joints)
        raw = self._sensor @ (flange[:3, :3].T @ [0, 0, -9.81 * MASS]) + [1.0, 2.0, 3.0]
        rows = np.full((100, 37), np.nan)
        rows[:, 0] = self._clock
        rows[:, 1:7] = pose_vectors(base @ flange @ matrices(np.array(self._cell.tool.grasp_pose)))
        rows[:, 7:10] = -(base[:3, :3] @ flange[:3, :3] @ raw) + 0.1 * self._rng.standard_normal(
            (100, 3))
        self._rows.append(rows)


@pytest.mark.parametrize("sensor, told", [(np.eye(3), None), (-np.eye(3), "sign"),
                                          (SWAPPED, "axes"), (0.1019 * np.eye(3), "unit")])
def test_an_arm_weighs_its_gripper_by_small_tilts(sensor, told, monkeypatch):
    """By what the driver tells, in the branch's frame; the changes stay below 2 N."""
    cell = Cell(robot={"model": "ur5e"}, base={"pose": (0.6, 0.1, 0, 0, 0, 1.2)},
                tool={"grasp_pose": (0, 0, 0.15, 0, 0, 0.4), "mass_kg": MASS})
    assert weightless(cell).tool.mass_kg == 0.0
    joints = np.array(cell.arm.home) + [0, 0, 0, 0.4, 0.3, 0]
    wanted = tilted_joints(joints, MASS)
    downs = -cell.arm.forward(wanted)[:, 2, :3]
    assert np.linalg.norm(9.81 * MASS * (downs - downs[0]), axis=1).max() < 2.05
    around = ArmSurroundings(cell, (), None)
    ways = [to_joints(cell, *pair, around) for pair in pairwise(wanted)]
    rows = []
    link = Link(cell, joints, rows, sensor)
    monkeypatch.setattr("limber.cli.commands.robot.weigh.time.sleep", link.read)
    found = weighed(cell, link, ways, rows)
    assert (told is None and not found.faults) or told in found.faults[0]
    assert told is not None or found.mass == pytest.approx(MASS, abs=0.05)


def test_a_gripper_is_weighed_before_the_branch_is_held(monkeypatch, tmp_path):
    """Refused until it was weighed without a fault, and for another mass with both values."""
    monkeypatch.setenv("LIMBER_STATE", str(tmp_path))
    cell = Cell(robot={"model": "ur5e", "address": "192.0.2.5"}, base={"pose": (0,) * 6},
                tool={"mass_kg": MASS, "grasp_pose": (0, 0, 0.15, 0, 0, 0)})
    path, weighed_mass = tmp_path / "cell.toml", {"mass_kg": MASS + 0.01, "mass_sigma_kg": 0.01}
    with pytest.raises(InputError, match="was never weighed"):
        require_weighed(cell)
    require_weighed(weightless(cell))
    asked = Weigh(cell_file=path)
    log_move(asked, weighed_mass | {"faults": ["the sensor's sign"]} | weighed_as(cell))
    with pytest.raises(InputError, match="The last weighing found that the sensor's sign"):
        require_weighed(cell)
    log_move(asked, weighed_mass | {"faults": []} | weighed_as(cell))
    require_weighed(cell)
    for stated in (MASS + 0.3, MASS - 0.3, 0.0):
        other = cell.model_copy(update={"tool": cell.tool.model_copy(update={"mass_kg": stated})})
        told = rf"weighed {MASS + 0.01:.3f} kg .* tool\.mass_kg is {stated:g}"
        with pytest.raises(InputError, match=told):
            require_weighed(other)
    sensor = cell.sensor.model_copy(update={"pose": (0, 0, 0.04, 0, 0, 0)})
    assert "never weighed" in unweighed(cell.model_copy(update={"sensor": sensor}))
