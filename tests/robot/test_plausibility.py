"""A pull whose force cannot be the branch's: noticed in its first ten millimetres."""

import numpy as np
import pytest

from limber.cell.cell_file import Cell
from limber.core.errors import NoPathError
from limber.core.numerics.rigid import matrices, pose_vectors
from limber.robot import recorder
from limber.robot.motion.trajectory import Trajectory
from limber.stages.pulls.record_nudge import nudge

CELL = Cell(robot={"model": "ur5e"}, base={"pose": (0,) * 6})
WAY = np.array([1.0, 0.0, 0.0])
STIFF = np.array([200.0, 40.0, 0.0])  # N/m: it pulls a little askew


def rows(response: np.ndarray, *, bias=(0.0, 0.0, 0.0), seed: int = 0) -> np.ndarray:
    """15 mm out at 10 mm/s and 500 Hz; ``response`` [3, 3] is the sensor's."""
    rng = np.random.default_rng(seed)
    ways = np.arange(0, 0.015, 0.01 / 500)
    samples = np.full((len(ways), 37), np.nan)
    samples[:, 0] = 5.0 + np.arange(len(ways)) / 500
    samples[:, 1:4] = [0.1, 0.2, 0.3] + ways[:, None] * WAY
    felt = ways[:, None] * STIFF @ response.T + bias
    samples[:, 7:10] = felt + 0.15 * rng.standard_normal((len(ways), 3))
    samples[:, 13:16] = felt + 0.07 * rng.standard_normal((len(ways), 3))
    return samples


def judged(samples: np.ndarray, factor: float | None, farthest: float = 0.01,
           ) -> tuple[str | None, float]:
    """The doubt, and after which way [m] it came."""
    ways = np.array([0.0, 0.0035, 0.007, farthest])
    pull = recorder.PredictedPull(ways, ways[:, None] * STIFF, factor)
    doubt = recorder.PullPlausibility(CELL, pull)
    for batch in np.array_split(samples, len(samples) // 10):
        if doubt.take(batch):
            return doubt.reason, float(np.linalg.norm(batch[-1, 1:4] - samples[0, 1:4]))
    return None, np.nan


def slipping(share: float, after: float, speed: float, seed: int) -> np.ndarray:
    """25 mm out; the force grows by ``share`` of what it should after ``after`` [m]."""
    rng = np.random.default_rng(seed)
    ways = np.arange(0, 0.025, speed / 500)
    held = np.minimum(ways, after) + share * np.maximum(ways - after, 0)
    samples = np.full((len(ways), 37), np.nan)
    samples[:, 0] = np.arange(len(ways)) / 500
    samples[:, 1:4] = ways[:, None] * WAY
    single = held[:, None] * STIFF + 0.15 * rng.standard_normal((len(ways), 3))
    samples[:, 7:10] = single
    smooth = np.array([single[max(k - 4, 0):k + 1].mean(axis=0) for k in range(len(single))])
    samples[:, 13:16] = smooth
    return samples


@pytest.mark.parametrize("after", [0.004, 0.012])
@pytest.mark.parametrize("speed", [0.01, 0.03])
def test_a_slow_slip_is_noticed_within_ten_millimetres_of_it(after, speed):
    """The moduli are not known: the force alone would do, but it stops to follow the model."""
    for seed in range(5):
        reason, way = judged(slipping(0.1, after, speed, seed), None, farthest=0.025)
        assert reason is not None and "slips slowly" in reason
        assert after < way <= after + recorder.LOOKED_M


@pytest.mark.parametrize("share, speed", [(1.0, 0.03), (0.8, 0.01), (1.3, 0.03)])
def test_a_branch_that_yields_or_stiffens_a_little_does_not_slip(share, speed):
    for seed in range(8):
        samples = slipping(share, 0.008, speed, seed)
        back = samples[::-1].copy()
        assert judged(np.vstack([samples, back]), None, farthest=0.025)[0] is None


SWAPPED = np.eye(3)[[1, 2, 0]]


@pytest.mark.parametrize("response, factor, told", [
    (-np.eye(3), None, "against the predicted one"),
    (SWAPPED, None, "across the predicted one"),
    (0.1 * np.eye(3), 3.0, "smaller than the known moduli allow"),
    (10.0 * np.eye(3), 3.0, "larger than the known moduli allow"),
    (np.zeros((3, 3)), 2.0, "is not held"),
])
def test_a_wrong_sensor_is_noticed_in_the_first_ten_millimetres(response, factor, told):
    for seed in range(5):
        reason, way = judged(rows(response, seed=seed), factor)
        assert reason is not None and told in reason
        assert way <= recorder.LOOKED_M + 3e-4


@pytest.mark.parametrize("factor", [None, 2.0])
def test_a_right_sensor_is_not_doubted(factor):
    """Noise, 15 degrees of a wrong base and half a newton of drift are no faults."""
    turn = np.radians(15)
    askew = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0],
                      [0, 0, 1.0]])
    for seed in range(20):
        assert judged(rows(np.eye(3), seed=seed), factor) == (None, pytest.approx(
            np.nan, nan_ok=True))
        assert judged(rows(askew, bias=(0.0, 0.0, 0.3), seed=seed), factor)[0] is None


def test_a_force_along_the_branch_itself_makes_no_size_wrong():
    """A model a few degrees off predicts one where there is none; what is across it still counts.
    """
    ways = np.array([0.0, 0.0035, 0.007, 0.01])
    askew = recorder.PredictedPull(ways, ways[:, None] * (STIFF + [0.0, 0.0, 400.0]), 2.0,
                          np.diag([1.0, 1.0, 0.0]))
    for seed in range(5):
        assert recorder.PullPlausibility(CELL, askew).take(rows(np.eye(3), seed=seed)) is None
        told = recorder.PullPlausibility(CELL, askew).take(rows(0.1 * np.eye(3), seed=seed))
        assert told is not None and "smaller" in told


def test_moduli_that_are_not_known_make_no_size_wrong():
    assert judged(rows(0.1 * np.eye(3)), None)[0] is None
    assert judged(rows(10.0 * np.eye(3)), None)[0] is None


def test_a_force_that_is_left_at_the_end_is_told():
    """Three newtons of drift; what noise and the branch leave is not told."""
    ways = np.array([0.0, 0.01])
    pull = recorder.PredictedPull(ways, ways[:, None] * STIFF, None)
    doubt = recorder.PullPlausibility(CELL, pull)
    out = rows(np.eye(3))
    doubt.take(out)
    back = out[:20].copy()
    back[:, 0] = out[-1, 0] + 2.0
    assert doubt.left_at_end(back) is None
    back[:, 15] += 3.0
    assert "A force of 3 N is left" in doubt.left_at_end(back)


def test_a_tool_off_by_five_millimetres_is_told_before_a_pull():
    """Where the base is known to a millimetre; one known to 5 mm explains as much."""
    place = np.array([0.5, 0.0, 0.3])
    good = Cell(robot={"model": "ur5e"}, base={
        "pose": (0,) * 6, "position_sigma_m": 6e-4, "rotation_sigma_rad": 1e-3})
    assert "5.0 mm off the branch's axis; the calibration explains 3.7" in recorder.off_axis(
        good, place, 0.005)
    assert recorder.off_axis(good, place, 0.003) is None
    assert recorder.off_axis(CELL, place, 0.005) is None


def seen_along(way: np.ndarray, response: np.ndarray, farthest: float, seed: int) -> str | None:
    """The doubt of a branch of 60 N/m that is moved along ``way`` [3] and read by ``response``."""
    rng = np.random.default_rng(seed)
    ways = np.r_[np.zeros(50), np.arange(0, farthest, 0.01 / 500), np.full(250, farthest)]
    samples = np.full((len(ways), 37), np.nan)
    samples[:, 0] = np.arange(len(ways)) / 500
    samples[:, 1:4] = ways[:, None] * way
    samples[:, 7:10] = 60.0 * samples[:, 1:4] @ response.T + 0.15 * rng.standard_normal(
        (len(ways), 3))
    samples[:, 13:16] = samples[:, 7:10]
    places = np.array([0.0, farthest])
    pull = recorder.PredictedPull(places, 60.0 * places[:, None] * way, None)
    doubt = recorder.PullPlausibility(CELL, pull)
    for batch in np.array_split(samples, len(samples) // 10):
        doubt.take(batch)
    return doubt.reason


def test_axes_exchanged_about_the_pull_itself_show_in_a_nudge_across_it():
    """Along the diagonal the pull's force is right; so is the nudge's of a right sensor."""
    diagonal = np.ones(3) / np.sqrt(3)
    for seed in range(10):
        axis = np.cross(diagonal, np.random.default_rng(100 + seed).standard_normal(3))
        stiffness = np.eye(3) + 99 * np.outer(axis, axis) / (axis @ axis)
        side = recorder.nudge_direction(diagonal, stiffness)
        # Across the pull, and not along the branch, which is stiff.
        assert side @ diagonal == pytest.approx(0, abs=1e-12)
        assert side @ axis == pytest.approx(0, abs=1e-12)
        assert seen_along(diagonal, SWAPPED, 0.01, seed) is None
        assert "predicted one: the sensor's" in seen_along(side, SWAPPED, recorder.NUDGE_M, seed)
        assert seen_along(side, np.eye(3), recorder.NUDGE_M, seed) is None


def test_a_nudge_goes_across_and_back_on_the_side_that_is_free():
    tool = matrices(np.array(CELL.tool.grasp_pose))
    joints = np.array(CELL.arm.home)
    start = pose_vectors(CELL.arm.forward(joints) @ tool)
    pull = Trajectory(np.array([0.0, 1.0]), np.array([start, start + [0.006, 0, 0, 0, 0, 0]]))
    def ended(blocked) -> np.ndarray:
        motion = nudge(CELL, np.diag([200.0, 100.0, 9e3]), start, joints, pull, blocked)
        assert motion.poses[-1] == pytest.approx(motion.poses[0])
        gone = motion.poses[:, :3] - start[:3]
        return gone[np.linalg.norm(gone, axis=1).argmax()]
    # No more than half of a short pull.
    first = ended(None)
    assert np.abs(first) == pytest.approx([0, 0.003, 0], abs=1e-9)
    other = ended(lambda flange, _: NoPathError("a wall", "", "") if (
        (flange[:, :3, 3] - flange[0, :3, 3]) @ first > 1e-6).any() else None)
    assert other == pytest.approx(-first, abs=1e-9)
    assert nudge(CELL, np.eye(3), start, joints, pull,
                 lambda *_: NoPathError("walls", "", "")) is None
