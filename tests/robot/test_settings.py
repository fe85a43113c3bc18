"""A controller beside its cell: what differs is named with both values; doubtful sensors too."""

from dataclasses import replace

import numpy as np
import pytest

from limber.cell.cell_file import Cell
from limber.core.numerics.rigid import matrices
from limber.geometry.rigid_kernels import pose_of
from limber.robot.controller_settings import differences
from limber.robot.interface import Sample
from limber.robot.robot_state import Observed

GRASP = (0.01, 0.0, 0.15, 0.0, 0.0, 0.3)
CELL = Cell(robot={"model": "ur5e"}, base={"pose": (0,) * 6},
            tool={"grasp_pose": GRASP, "mass_kg": 1.2, "centre_of_mass_m": (0, 0, 0.05)})
JOINTS = np.array(CELL.arm.home)
NOTHING = np.zeros(6)


def sample_of(true=GRASP, **changes) -> Sample:
    pose = pose_of(CELL.arm.forward(JOINTS) @ matrices(np.array(true)))
    return Sample(1.0, 1.0, JOINTS, NOTHING, pose, NOTHING, NOTHING, 7, 1, 1, 1.0, **changes)


def test_a_controller_that_is_set_as_the_cell_states_differs_in_nothing():
    assert differences(CELL, sample_of(payload=1.2, payload_centre=np.array([0, 0, 0.05]), )) == []
    assert differences(CELL, sample_of()) == []


@pytest.mark.parametrize("sample, told", [
    (sample_of(payload=0.9), "payload: 0.900 kg in the controller, 1.200 kg in the cell file"),
    (sample_of(payload_centre=np.array([0, 0.03, 0.05])),
     "centre of the payload: (0, 30, 50) mm in the controller, (0, 0, 50) mm in the cell file"),
    # A tool that the controller does not tell is known to some millimetres.
    (sample_of((0.01, 0, 0.2, 0, 0, 0.3)),
     "tool centre point: about (10, 0, 200) mm, turned by (0.0, 0.0, 17.2) degrees"),
    # One that it tells is known exactly: 5 mm count.
    (sample_of((0.01, 0, 0.155, 0, 0, 0.3), tool=np.array([0.01, 0, 0.155, 0, 0, 0.3])),
     "tool centre point: (10, 0, 155) mm"),
    (replace(sample_of(), slider=0.3), "speed slider: 30 % in the controller"),
])
def test_each_difference_is_named_with_both_values(sample, told):
    found = differences(CELL, sample)
    assert len(found) == 1 and told in str(found[0])
    assert found[0].is_set == ("slider" not in found[0].what)


def observed(readings: np.ndarray) -> Observed:
    return Observed({}, [sample_of()] * len(readings), readings, [])


def test_a_sensor_that_stands_still_is_plausible_or_named():
    """Bias is no fault before the tare; a frozen, shaken or saturated sensor is one."""
    noise = np.random.default_rng(0).standard_normal((50, 6)) * np.r_[[0.15] * 3, [0.02] * 3]
    bias = np.array([4.0, -3.0, 8.0, 0.1, 0.2, 0.0])
    assert observed(bias + noise).implausible(CELL) == []
    for readings, told in (
            (np.tile(bias, (50, 1)), "repeats one reading"),
            (bias + noise * np.r_[[30.0] * 3, [1.0] * 3], "the force varies by"),
            (bias + noise * np.r_[[1.0] * 3, [1000.0] * 3], "the torque varies by"),
            (bias + noise + np.r_[100.0, np.zeros(5)], "at the end of the sensor's range (100 N)"),
            (np.full((50, 6), np.nan), "are no numbers")):
        assert told in "; ".join(observed(readings).implausible(CELL)), told


def test_the_arms_own_calibration_is_stated():
    """A controller whose arm is 4 mm longer than nominal; another tool says nothing of it."""
    away = sample_of()
    longer = replace(away, pose=away.pose + [0, 0, 0.004, 0, 0, 0])
    seen = Observed({}, [longer], np.zeros((1, 6)), differences(CELL, longer))
    assert seen.nominal_off(CELL) == pytest.approx(0.004)
    other = sample_of((0.01, 0, 0.2, 0, 0, 0.3))
    assert Observed({}, [other], np.zeros((1, 6)),
                    differences(CELL, other)).nominal_off(CELL) is None
