"""A branch that is lost, softer or wrongly felt is noticed also on paths with small forces."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.robot_stepped import Spring, SteppedRobot
from limber.cell.cell_file import Cell
from limber.core.errors import InputError
from limber.robot.driver.guard import ForceErrors, noise_at_rest, not_seen, white_noise
from limber.robot.driver.link import RobotLink
from limber.robot.motion.trajectory import ExpectedWrench, Trajectory, along, densely
from limber.robot.virtual.controller import Controller
from limber.robot.virtual.payload import Load
from limber.stages.paths.execute_path import require_watched

TOOL = np.array([0.0, 0.0, 0.15])
CELL = Cell(robot={"model": "ur5e"}, base={"pose": (0,) * 6},
            tool={"grasp_pose": (*TOOL, 0, 0, 0), "mass_kg": 0.0, "gripper": "digital_output"})
WAY_M = 0.03
FAULTS = ("nothing held", "broken", "slip", "three times softer", "sensor a tenth")


class OffSpring(Spring):
    """A spring that the closed fingers press aside: an offset of force on all of the path."""

    aside = np.array([0.0, 0.0, 0.6])

    def wrench(self, flange: np.ndarray, seconds: float) -> np.ndarray:
        force = flange[:3, :3].T @ self.aside
        return super().wrench(flange, seconds) + np.r_[force, np.cross(TOOL, force)]


def followed_with(fault: str, peak: float, seed: int = 1, **cell: object) -> dict:
    """Follow a path whose predicted force grows to ``peak`` [N]; return how that ended."""
    controller = Controller("ur5e", seed=seed)
    controller.set_tool(np.r_[TOOL, 0, 0, 0])
    start = controller.pose.copy()
    softness = np.diag([1.0, 1.0, 20.0])  # stiff along its axis
    stiffness = peak / WAY_M * softness
    kind = OffSpring if fault == "pressed aside" else Spring
    load = kind(TOOL, start[:3].copy(), stiffness / (3 if "softer" in fault else 1))
    controller.load = Load() if fault == "nothing held" else load
    if fault == "sensor a tenth":
        traits = controller.sensor.traits
        controller.sensor.gain *= 0.1
        controller.sensor.traits = replace(traits, force_sigma=0.1 * traits.force_sigma,
                                           drift_n_per_minute=0.1 * traits.drift_n_per_minute)
    poses = densely(np.array([start, start + [0, WAY_M, 0, 0, 0, 0]]))
    path = Trajectory(along(poses, 0.05, 0.3), poses, expected_at(poses, stiffness))

    robot = SteppedRobot(controller)

    def on_the_way() -> None:
        if controller.pose[1] - start[1] > 0.6 * WAY_M:
            if fault == "broken":
                load.stiffness = np.zeros((3, 3))
            elif fault == "slip" and not load._rest[1] > start[1]:
                load._rest[1] = controller.pose[1]
    robot.each_step = on_the_way
    with robot.here(), RobotLink(CELL.model_copy(update=cell)) as link:
        link.wait_for_samples()
        tared = link.tare(0.1)
        return link.follow(path) | {"noise_n": tared["noise_n"]}


def expected_at(poses: np.ndarray, stiffness: np.ndarray, young: float = 0.0) -> ExpectedWrench:
    """A spring's prediction, with Young's modulus known to a fraction ``young``."""
    count = len(poses)
    wrenches, slopes, covariance = (np.zeros((count, 6)), np.zeros((count, 6, 6)),
                                    np.zeros((count, 6, 6)))
    wrenches[:, :3] = (poses[:, :3] - poses[0, :3]) @ stiffness
    slopes[:, :3, :3] = stiffness
    sigma = 5e-5 * stiffness
    covariance[:, :3, :3] = sigma @ sigma + young**2 * np.einsum(
        "ni,nj->nij", wrenches[:, :3], wrenches[:, :3])
    return ExpectedWrench(wrenches, slopes, covariance, poses[0])


@pytest.mark.parametrize("peak", [1.5, pytest.param(4.0, marks=pytest.mark.slow)])
@pytest.mark.parametrize("fault", FAULTS)
def test_a_lost_branch_stops_a_path_of_small_forces(fault, peak):
    """On the way, far below 3 N: with each of these a path of 1.67 N once ran to its end."""
    event = followed_with(fault, peak)
    assert event["event"] == "stopped", event
    assert "branch slipped, broke" in event["reason"] or "differs" in event["reason"]


@pytest.mark.parametrize("peak", [0.5, 1.5, 4.0])
@pytest.mark.parametrize("seed", [2, *(pytest.param(seed, marks=pytest.mark.slow)
                                       for seed in (3, 10))])
def test_a_branch_that_is_held_raises_no_alarm(peak, seed):
    event = followed_with("none", peak, seed)
    assert event["event"] == "reached", event
    # Of single readings it is 0.15 N.
    assert event["noise_n"] == pytest.approx(white_noise(0.15, np.exp(-0.2)), rel=0.3)


def test_what_the_fingers_press_aside_is_no_alarm():
    assert followed_with("pressed aside", 1.5)["event"] == "reached"


def path_to(peak: float, young: float = 0.0, seconds: float = 5.0) -> Trajectory:
    poses = np.zeros((40, 6))
    poses[:, 1] = np.linspace(0, WAY_M, 40)
    return Trajectory(np.linspace(0, seconds, 40), poses,
                      expected_at(poses, peak / WAY_M * np.eye(3), young))


@pytest.mark.parametrize("peak, young, seconds, count", [
    (0.3, 0.0, 5.0, 3), (0.5, 0.0, 5.0, 1), (0.7, 0.0, 5.0, 0), (1.67, 0.0, 20.0, 0),
    (1.67, 0.1, 20.0, 0), (0.8, 0.0, 60.0, 3), (1.67, 0.3, 5.0, 1), (0.0, 0.0, 5.0, 3)])
def test_what_could_not_be_seen_is_refused_before_the_start_without_an_option(
        peak, young, seconds, count):
    """By the peak, the sensor's noise and drift, and the prediction's own error."""
    path, told = path_to(peak, young, seconds), []
    errors = ForceErrors(white_noise(0.15, np.exp(-0.2)), 0.8 / 60, 0.0)
    unseen = not_seen(path.times, path.expected.wrenches[:, :3],
                      path.expected.covariance[:, :3, :3], errors, 10.0)
    assert len(unseen) == count
    if not count:
        require_watched(CELL, path, False, told.append)
        assert not told
        return
    with pytest.raises(InputError) as refused:
        require_watched(CELL, path, False, told.append)
    text = str(refused.value)
    assert f"at most {peak:.2g} N" in text and "--unwatched" in text and not told
    require_watched(CELL, path, True, told.append)
    assert len(told) == 1
    if young == 0.0 and peak:
        # As said: from that force on they would be seen.
        least = max(unseen.values())
        assert f"From about {least:.2g} N on" in text
        for share, seen in ((1.05, True), (0.95, False)):
            other = path_to(share * least, young, seconds)
            found = not_seen(other.times, other.expected.wrenches[:, :3],
                             other.expected.covariance[:, :3, :3], errors, 10.0)
            assert (not found) == seen


def test_a_noisier_sensor_and_a_heavier_gripper_are_allowed_for():
    path = path_to(1.0)
    for tool, noise in (({}, 0.2), ({"mass_kg": 3.0}, None)):
        cell = Cell.model_validate(CELL.model_dump() | {"tool": CELL.tool.model_dump() | tool})
        with pytest.raises(InputError, match=f"noise .{'measured' if noise else 'stated'}"):
            require_watched(cell, path, False, print, noise)
    require_watched(CELL, path, False, print)


def test_noise_at_rest_is_that_of_the_filtered_force():
    rng = np.random.default_rng(4)
    kept = float(np.exp(-0.2))
    white = 0.15 * rng.standard_normal((4000, 3))
    assert noise_at_rest(white + 5.0, kept) == pytest.approx(white_noise(0.15, kept), rel=0.05)
    # Readings that are repeated five times, as those of a slow sensor, average less.
    assert noise_at_rest(np.repeat(white, 5, axis=0), kept) > 1.5 * white_noise(0.15, kept)
