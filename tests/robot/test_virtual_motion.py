"""The virtual arm's motions against what physics and the commands say."""

import numpy as np
import pytest
from tests.robot.conftest import Registers

from limber.cell.ur_arms import ARMS
from limber.core.numerics.rigid import matrices
from limber.robot.virtual.controller import Controller, RuntimeState, SafetyMode
from limber.robot.virtual.payload import E_SERIES, ForceSensor

SERVO_JOINTS, SERVO_STOP, PAYLOAD, SERVO_POSE, TOOL, WATCHDOG = 11, 16, 17, 24, 29, 35


def moved(registers, *offset: float) -> np.ndarray:
    return registers.controller.pose + np.array(offset)


def turning(registers, speed: float, seconds: float) -> None:
    """Let the first joint be turned by a stream of targets [rad/s]."""
    start = registers.controller.joints.copy()
    for k in range(round(seconds / registers.controller.seconds)):
        registers.servo(SERVO_JOINTS,
                        start + [speed * k * registers.controller.seconds, 0, 0, 0, 0, 0])


def test_a_stop_takes_the_way_that_its_deceleration_needs(registers):
    """From 0.2 rad/s at 0.5 rad/s^2: 0.04 rad; the joint never goes back."""
    controller = registers.controller
    turning(registers, 0.2, 1.0)
    begin, speed = controller.joints[0], controller.speeds[0]
    assert speed == pytest.approx(0.2, rel=5e-3)
    registers.write(SERVO_STOP, 0.5)
    turned = []
    while controller.outputs_int[0] != 2:
        controller.step()
        turned.append(controller.joints[0])
    assert turned[-1] - begin == pytest.approx(speed**2 / (2 * 0.5), rel=0.03)
    assert np.all(np.diff(turned) >= -1e-12)
    assert not np.any(controller.speeds)


@pytest.mark.parametrize("lookahead", [0.03, 0.1])
def test_servo_follows_its_target_a_lookahead_behind(registers, lookahead):
    controller = registers.controller
    for k in range(600):
        target = np.array(ARMS["ur5e"].home) + [0.05 * k * controller.seconds, 0, 0, 0, 0, 0]
        registers.servo(SERVO_JOINTS, target, lookahead)
    assert controller.speeds[0] == pytest.approx(0.05, rel=5e-3)
    assert target[0] - controller.joints[0] == pytest.approx(0.05 * lookahead, rel=0.05)
    registers.run(SERVO_STOP, 10.0)
    assert not np.any(controller.speeds)


def stream(registers, slider, seconds=2.0, speed=0.1, every=1):
    """A stream of joint targets that move steadily; returns how far the arm came [rad]."""
    controller = registers.controller
    controller.slider = slider(0.0) if callable(slider) else slider
    home, target = np.array(ARMS["ur5e"].home), 0.0
    for k in range(round(seconds / controller.seconds)):
        if callable(slider):
            controller.slider = slider(k * controller.seconds)
        if k % every == 0:
            target = speed * (k + every) * controller.seconds
            registers.write(SERVO_JOINTS, *(home + [target, 0, 0, 0, 0, 0]), 0, 0, 0.002, 0.1, 300)
            controller.write_inputs({"input_int_register_0": 0})
        controller.step()
    return controller.joints[0] - home[0]


@pytest.mark.parametrize(("slider", "speed", "every", "way"), [
    (1.0, 0.1, 1, 0.19), (0.5, 0.1, 1, 0.095), (0.0, 0.1, 1, 0.0), (0.25, -0.2, 1, -0.095),
    (0.5, 0.1, 4, 0.095)])
def test_the_slider_slows_a_stream_of_targets(registers, slider, speed, every, way):
    """servoj goes at that fraction of the targets' speed, as the drivers of ROS report."""
    assert stream(registers, slider, speed=speed, every=every) == pytest.approx(
        way, abs=2e-3 if way else 1e-12)


def test_the_slider_in_the_middle_of_a_stream(registers):
    """At 0 the arm stays; at 1 again it makes up for what it lost."""
    halted = stream(registers, lambda now: 1.0 if now < 1.0 else 0.0)
    assert halted == pytest.approx(0.1, abs=2e-3)


def test_a_slowed_arm_makes_up_for_its_lag(registers):
    caught = stream(registers, lambda now: 0.5 if now < 1.0 else 1.0)
    assert caught == pytest.approx(0.19, abs=2e-3)


def test_out_of_reach_is_a_protective_stop_not_a_motion(registers):
    before = registers.controller.pose
    registers.servo(SERVO_POSE, moved(registers, 3.0, 0, 0, 0, 0, 0))
    registers.wait(0.1)
    assert registers.controller.safety_mode == SafetyMode.PROTECTIVE_STOP
    assert registers.controller.runtime_state == RuntimeState.PAUSED
    assert registers.controller.pose == pytest.approx(before)


@pytest.mark.slow
@pytest.mark.parametrize("event", ["protective_stop", "emergency_stop", "local", "stop", "popup"])
def test_every_stop_brings_the_arm_to_rest(registers, event):
    """From 0.1 m/s within 30 ms and 2 mm; nothing moves afterwards, whatever is written."""
    controller = registers.controller
    registers.line(moved(registers, 0, 0.1, 0, 0, 0, 0), settle=0.0)
    begin = controller.pose
    assert np.linalg.norm(controller.tool_speed[:3]) > 0.09
    {"protective_stop": lambda: controller.protective_stop("test"),
     "emergency_stop": controller.emergency_stop,
     "local": lambda: controller.set_remote(False), "popup": lambda: controller.popup("test"),
     "stop": lambda: controller.stop_program("test")}[event]()
    registers.wait(0.03)
    assert not np.any(controller.speeds)
    assert np.linalg.norm(controller.pose - begin) < 2e-3
    rest = controller.pose
    registers.servo(SERVO_POSE, moved(registers, 0, 0.1, 0, 0, 0, 0))
    registers.wait(0.3)
    assert controller.pose == pytest.approx(rest, abs=1e-12)


@pytest.mark.parametrize("model", ["ur5e", "ur5"])
def test_a_hand_leads_the_arm_where_nothing_else_may_move_it(model):
    """An e-Series in local control only; none while a program runs."""
    registers = Registers(controller := Controller(model))
    home, there = controller.joints, controller.joints + [0.3, 0, -0.2, 0, 0, 0.1]
    controller.freedrive(there)
    registers.wait(0.1)
    assert np.array_equal(controller.joints, home)
    controller.stop_program("test")
    controller.freedrive(there)
    registers.wait(0.1)
    assert np.array_equal(controller.joints, home) == (model == "ur5e")
    controller.set_remote(False)
    controller.freedrive(there)
    registers.wait(2.1)
    assert controller.joints == pytest.approx(there) and not controller.speeds.any()


def test_watchdog_stops_the_program_after_its_time(registers):
    """50 Hz: 20 ms without input. A time below one step counts as one step."""
    controller = registers.controller
    registers.run(WATCHDOG, 50.0)
    for _ in range(30):
        controller.write_inputs({"input_int_register_0": 0})
        registers.wait(0.016)
        assert controller.runtime_state == RuntimeState.PLAYING
    registers.wait(0.006)
    assert controller.runtime_state == RuntimeState.STOPPED
    again = Registers(controller)
    again.run(WATCHDOG, 1e6)
    for _ in range(10):
        controller.write_inputs({"input_int_register_0": 0})
        controller.step()
    assert controller.runtime_state == RuntimeState.PLAYING


def test_a_command_that_is_not_there_ends_the_program_and_says_so(registers):
    registers.write(3)
    registers.wait(0.02)
    assert registers.controller.runtime_state == RuntimeState.STOPPED
    assert "virtual controller has no command" in registers.controller.log[-1]


def mean_force(controller: Controller) -> np.ndarray:
    readings = []
    for _ in range(400):
        controller.step()
        readings.append(controller.outputs()["actual_TCP_force"])
    return np.mean(readings, axis=0)


def test_the_gripper_weighs_what_the_payload_does_not_say():
    """A 0.8 kg gripper with payload 0.8 weighs nothing, with payload 0 it weighs 7.85 N."""
    controller = Controller("ur5e", mass=0.8, centre=(0, 0, 0.06))
    registers = Registers(controller)
    traits = controller.sensor.traits
    controller.sensor._bias[:] = 0

    noise = 5 * traits.force_sigma / np.sqrt(400) + 0.02
    told = -0.8 * 9.80665 * controller.sensor.gain
    assert mean_force(controller)[:3] == pytest.approx([0, 0, told], abs=noise)
    registers.run(PAYLOAD, 0.8, 0, 0, 0.06)
    assert mean_force(controller)[:3] == pytest.approx([0, 0, 0], abs=noise)


def test_force_is_reported_in_the_bases_axes_about_the_tools_centre():
    """A pull at the flange along the base's x, with the tool's centre 0.1 m before it."""
    class Pull:
        def wrench(self, flange, seconds):
            return np.r_[flange[:3, :3].T @ [10.0, 0, 0], 0, 0, 0]

    controller = Controller("ur5e", load=Pull())
    controller.set_tool(np.array([0, 0, 0.1, 0, 0, 0]))
    controller.sensor._bias[:] = 0
    lever = -(controller.flange[:3, :3] @ [0, 0, 0.1])
    expected = controller.sensor.gain * np.r_[10.0, 0, 0, np.cross(lever, [10.0, 0, 0])]
    assert mean_force(controller) == pytest.approx(expected, abs=0.04)


def test_a_sensors_gain_is_off_by_some_hundredths_and_stays():
    load = np.array([0, 0, 50.0, 0, 0, 0])
    gains = []
    for seed in range(200):
        sensor = ForceSensor(E_SERIES, np.random.default_rng(seed))
        gains.append(sensor.gain)
        if seed < 5:
            empty, loaded = (np.mean([sensor.read(each, 0.002) for _ in range(500)], axis=0)
                             for each in (np.zeros(6), load))
            assert loaded[2] - empty[2] == pytest.approx(50 * sensor.gain, abs=0.06)
    assert np.std(gains) == pytest.approx(E_SERIES.gain_sigma, rel=0.15)


def test_sensor_noise_drift_and_saturation():
    sensor = ForceSensor(E_SERIES, np.random.default_rng(0))
    nothing = np.zeros(6)
    readings = np.array([sensor.read(nothing, 0.002) for _ in range(500)])
    assert readings[:, :3].std(axis=0) == pytest.approx(np.full(3, E_SERIES.force_sigma), rel=0.15)
    assert np.abs(readings.mean(axis=0)[:3]).max() > 0.3
    later = np.array([sensor.read(nothing, 300 / 500) for _ in range(500)])
    assert later[-1, 2] - readings[:, 2].mean() == pytest.approx(
        5 * E_SERIES.drift_n_per_minute, abs=0.7)
    far = sensor.read(np.array([1e4, 0, 0, 0, -1e3, 0]), 0.002)
    assert far[0] == E_SERIES.force_range and far[4] == -E_SERIES.torque_range


def test_tool_pose_is_flange_times_tool(registers):
    controller = registers.controller
    flange = controller.flange.copy()
    registers.run(TOOL, 0.01, 0.02, 0.1, 0.1, 0.2, 0.3)
    assert matrices(controller.pose) == pytest.approx(
        flange @ matrices(np.array([0.01, 0.02, 0.1, 0.1, 0.2, 0.3])))
