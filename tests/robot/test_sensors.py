"""Force sensors: frames, tare, weight, saturation, torn messages."""


import numpy as np
import pytest

from limber.cell.cell_file import Cell
from limber.core.errors import InputError, WorkError
from limber.core.numerics.rigid import matrices
from limber.geometry.rigid_kernels import turned_wrench, weight_wrench
from limber.robot.driver import force_samples
from limber.robot.interface import Sample

TOOL = (0.02, -0.01, 0.15, 0.3, 0.1, -0.2)
BASE = (0.6, 0.1, 0.0, 0.2, 0.1, 1.2)


def cell_with(**sensor) -> Cell:
    return Cell(robot={"model": "ur5e"}, base={"pose": BASE},
                tool={"grasp_pose": TOOL, "mass_kg": 0.9, "centre_of_mass_m": (0, 0, 0.06)},
                sensor=sensor)


def sample_at(pose, wrench=(0.0,) * 6, clock=1.0) -> Sample:
    return Sample(clock, clock, np.zeros(6), np.zeros(6), np.asarray(pose, float), np.zeros(6),
                  np.asarray(wrench, float), 7, 1, 2, 1.0)


def reading_of(wrench) -> force_samples.Reading:
    return force_samples.Reading(np.asarray(wrench, float), 0.0, np.asarray(wrench, float))


@pytest.mark.parametrize("kind", ["controller", "ft300"])
def test_every_sensor_gives_the_wrench_of_the_gripper_on_the_branch(kind):
    """A known wrench on the branch, taken through each sensor's own frame and sign."""
    cell = cell_with(kind=kind, pose=(0.01, 0.02, 0.03, 0.1, -0.4, 0.9))
    chain = force_samples.WrenchChain(cell)
    rng = np.random.default_rng(4)
    pose = np.r_[rng.normal(size=3), 0.8, -0.4, 1.1]
    on_branch = rng.normal(size=6)
    base, tip = matrices(np.array(BASE)), matrices(pose)
    flange = tip @ np.linalg.inv(matrices(np.array(TOOL)))
    if kind == "controller":
        in_base = -np.r_[base[:3, :3].T @ on_branch[:3], base[:3, :3].T @ on_branch[3:]]
        reading = force_samples.ControllerSensor(cell).read(sample_at(pose, in_base))
    else:
        sensor = flange @ matrices(np.array(cell.sensor.pose))
        rotation = (base @ sensor)[:3, :3].T
        force, torque = -rotation @ on_branch[:3], -rotation @ on_branch[3:]
        lever = sensor[:3, :3].T @ (tip[:3, 3] - sensor[:3, 3])
        raw = np.r_[force, torque + np.cross(lever, force)]
        frame = matrices(np.array(cell.sensor.pose))
        at_flange = turned_wrench(frame[:3, :3], raw, frame[:3, 3])
        reading = reading_of(at_flange + weight_wrench(0.9, np.array([0, 0, 0.06]), flange[:3, :3]))
    now, smooth = chain.wrench(sample_at(pose), reading)
    assert now == pytest.approx(on_branch, abs=1e-12)
    assert smooth == pytest.approx(now)


def test_the_tare_takes_the_bias_and_the_weight_goes_with_every_turn():
    """Tared in one orientation, a bare gripper reads nothing in any other."""
    cell = cell_with(kind="ft300")
    chain = force_samples.WrenchChain(cell)
    bias = np.array([3.0, -1.0, 4.0, 0.1, 0.2, -0.1])
    rng = np.random.default_rng(0)

    def reading(pose) -> force_samples.Reading:
        flange = matrices(np.asarray(pose)) @ np.linalg.inv(matrices(np.array(TOOL)))
        weight = weight_wrench(0.9, np.array([0, 0, 0.06]), flange[:3, :3])
        return reading_of(weight + bias + 0.05 * rng.standard_normal(6))
    pose = np.array([0.4, 0.1, 0.5, 0, 3.0, 0])
    chain.start_tare()
    for _ in range(200):
        chain.wrench(sample_at(pose), reading(pose))
    sigma = chain.end_tare()
    assert sigma[:3].max() < 0.01
    for turn in ([0, 3.0, 0], [1.5, 0, 0], [0.3, 0.4, -2.0]):
        turned = np.r_[pose[:3], turn]
        mean = np.mean([chain.wrench(sample_at(turned), reading(turned))[0] for _ in range(300)],
                       axis=0)
        assert mean == pytest.approx(np.zeros(6), abs=0.03)


def test_a_touched_gripper_is_not_tared():
    chain = force_samples.WrenchChain(cell_with())
    chain.start_tare()
    for k in range(100):
        chain.wrench(sample_at(np.zeros(6)), reading_of(np.full(6, 0.1 * k)))
    with pytest.raises(WorkError, match="touched or moved"):
        chain.end_tare()
    with pytest.raises(WorkError, match="readings arrived for the tare"):
        chain.end_tare()


@pytest.mark.slow
def test_a_reading_at_the_end_of_the_range_is_no_number_to_trust():
    chain = force_samples.WrenchChain(cell_with(force_range_n=50.0))
    now, _ = chain.wrench(sample_at(np.zeros(6)), reading_of(np.r_[50.0, np.zeros(5)]))
    assert not np.isfinite(now).any()


def test_the_smoothed_wrench_is_late_by_what_it_says():
    chain = force_samples.WrenchChain(cell_with(), count=5)
    slope = 2.0
    for k in range(50):
        sample = sample_at(np.zeros(6), clock=0.002 * k)
        now, smooth = chain.wrench(sample, reading_of(np.full(6, slope * sample.clock)))
    late = (now[:3] - smooth[:3]) / np.where(now[:3] == 0, 1, now[:3]) * sample.clock
    assert late == pytest.approx(np.full(3, chain.delay(500.0)))


def test_without_a_sensor_nothing_is_moved():
    with pytest.raises(InputError, match="cannot feel"):
        force_samples.open_sensor(cell_with(kind="none"))
    cb3 = Cell(robot={"model": "ur5"}, base={"pose": (0,) * 6})
    with pytest.raises(InputError, match="motor currents"):
        force_samples.open_sensor(cb3)


def test_a_missing_ft300_is_told(own_address):
    cell = Cell(robot={"model": "ur5", "address": own_address}, base={"pose": (0,) * 6},
                sensor={"kind": "ft300"})
    with pytest.raises(WorkError, match="63351"):
        force_samples.open_sensor(cell)
