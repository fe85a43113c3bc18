"""The guard's test of the force: names, scales and false alarms."""

from dataclasses import replace

import numpy as np
import pytest

from limber.robot.driver.force_test import FALSE_ALARMS, Block, ForceErrors, ForceTest
from limber.robot.motion.trajectory import ExpectedWrench, Trajectory, along, densely

ERRORS = ForceErrors(noise=0.05, drift=0.8 / 60.0, mass=0.0)
WAY_M, SPEED = 0.04, 0.02
DIRECTION = np.array([0.6, 0.0, 0.8])
YOUNG = 0.1


def path_to(peak: float, young: float = YOUNG, speed: float = SPEED, way: float = WAY_M,
            turn: float = 0.5) -> Trajectory:
    """A path whose force grows in proportion to ``peak`` [N], while the gripper turns."""
    poses = densely(np.array([[0, 0, 0, np.pi, 0, 0],
                              [*(way * DIRECTION), np.pi + turn, 0, 0]], float))
    count = len(poses)
    wrenches, covariance = np.zeros((count, 6)), np.zeros((count, 6, 6))
    wrenches[:, :3] = poses[:, :3] / way * peak
    covariance[:, :3, :3] = young**2 * np.einsum("ni,nj->nij", wrenches[:, :3], wrenches[:, :3])
    return Trajectory(along(poses, speed, 0.3), poses, ExpectedWrench(
        wrenches, np.zeros((count, 6, 6)), covariance, poses[0], np.zeros((count, 3, 6))))


def ended(path: Trajectory, felt, seed: int, errors: ForceErrors = ERRORS,
          ) -> tuple[str | None, float]:
    """The alarm of a path on which ``felt`` gives the force at a time [s], predicted force [3] and
    gripper's turn [3, 3]; and after which travel [m] it came."""
    from limber.robot.driver.force_test import _blocks

    rng, test, travel = np.random.default_rng(seed), ForceTest(errors), 0.0
    for number, block in enumerate(_blocks(path, np.eye(3))):
        travel += block.travel
        force = felt(0.02 * number, block.predicted, block.turn, travel)
        test.take(replace(block, off=force - block.predicted
                          + errors.noise * rng.standard_normal(3)))
        if (alarm := test.alarm()) is not None:
            return alarm, travel
    return None, travel


def turned(turn: np.ndarray, force: np.ndarray, angle: float) -> np.ndarray:
    """The force as a sensor shows it whose axes are turned about the gripper's z."""
    c, s = np.cos(angle), np.sin(angle)
    return turn @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ turn.T @ force


FIRST = np.diag([1.0, -1.0, -1.0])
CAUSES = {
    "nothing is held": lambda t, p, turn, x: 0.0 * p,
    "softer": lambda t, p, turn, x: 0.35 * p,
    "a fraction": lambda t, p, turn, x: 0.1 * p,
    "sign is wrong": lambda t, p, turn, x: -p,
    "stiffer": lambda t, p, turn, x: 3.0 * p,
    "broke or came out": lambda t, p, turn, x: p if x < 0.5 * WAY_M else 0.0 * p,
    "slip": lambda t, p, turn, x: p * np.exp(-max(t - 0.7, 0.0)),
    "another load": lambda t, p, turn, x: p + 9.81 * (turn @ FIRST.T @ [0, 0, 1.0] - [0, 0, 1.0]),
    "axes are turned": lambda t, p, turn, x: turned(turn, p, 0.9),
    "drifts": lambda t, p, turn, x: p + [0, 1.5 * t, 0],
    "something else pushes": lambda t, p, turn, x: p + [0, 1.5 * (x > 0.02), 0]}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", CAUSES)
def test_a_cause_is_noticed_and_named(name, seed):
    text, _ = ended(path_to(5.0, 0.03), CAUSES[name], seed)
    assert text is not None and name in text


@pytest.mark.parametrize("peak", [0.3, 5.0, 100.0])
def test_it_scales_with_the_force(peak):
    """With noise in proportion the same is noticed after the same travel: no newton is built in."""
    scaled = replace(ERRORS, noise=0.01 * peak, drift=1e-3 * peak)
    text, travel = ended(path_to(peak), CAUSES["broke or came out"], 1, scaled)
    _, other = ended(path_to(5.0), CAUSES["broke or came out"], 1,
                     replace(ERRORS, noise=0.05, drift=5e-3))
    assert "broke" in text and travel == pytest.approx(other, abs=1e-9)


@pytest.mark.parametrize("peak", [0.5, 5.0, 20.0])
def test_what_is_as_uncertain_as_stated_raises_no_alarm(peak):
    """E off within its interval, a gain, drift and noise: 150 motions, none is stopped."""
    for seed in range(150):
        rng = np.random.default_rng(1000 + seed)
        factor = np.exp(YOUNG * rng.standard_normal()) * (1 + 0.02 * rng.standard_normal())
        drift = ERRORS.drift * rng.standard_normal(3)
        text, _ = ended(path_to(peak, speed=0.03), lambda t, p, turn, x, factor=factor, drift=drift:
                        factor * p + drift * t, seed)
        assert text is None, (seed, factor, text)


def test_the_noise_is_that_of_blocks_at_rest():
    rng = np.random.default_rng(4)
    white = 0.15 * rng.standard_normal((4000, 3)) + 5.0
    assert ERRORS.measured(white, 10).noise == pytest.approx(0.15 / np.sqrt(10), rel=0.05)
    # Readings that are repeated five times, as those of a slow sensor, average less.
    assert ERRORS.measured(np.repeat(white, 5, axis=0), 10).noise > 0.09
    assert ERRORS.measured(None, 10) == ERRORS


def test_an_old_onset_goes_where_its_neighbours_are_near():
    """A path of minutes keeps a bounded number of them, old and new."""
    test = ForceTest(ERRORS)
    block = Block(np.zeros(3), np.ones(3), 0.01 * np.eye(3), np.eye(3), np.zeros(3), 1e-4, 0.02)
    for _ in range(3000):
        test.take(block)
        assert test.alarm() is None
    ages = 60.0 - test._onsets[:, 1]
    assert len(ages) == 24 and ages[0] > 50.0 and ages[-1] < 0.2
    assert np.all(np.diff(ages) < 0.0)
    assert FALSE_ALARMS < 1e-3
