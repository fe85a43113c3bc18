"""A branch that is lost, other than its model or wrongly felt is noticed, or said not to be."""

import numpy as np
import pytest

from benchmarks.robot_guard import CASES, CELL, followed, path_to
from limber.core.errors import InputError
from limber.robot.motion.trajectory import Trajectory
from limber.stages.paths.execute_path import require_watched


@pytest.mark.parametrize("name", [
    pytest.param(name, marks=() if name in ("empty gripper", "branch breaks") else pytest.mark.slow)
    for name in CASES])
@pytest.mark.parametrize("peak", [1.5, pytest.param(20.0, marks=pytest.mark.slow)])
def test_a_fault_is_noticed_where_that_was_promised(name, peak):
    found = followed(peak, 1, name)
    assert found.is_good, found
    assert name != "branch breaks" or found.stopped_after is not None


def test_of_turned_axes_no_more_is_promised_than_comes():
    """Across a stiff branch a large turn shows less than its sine: it was promised 8 mm early."""
    found = followed(20.0, 6201, "sensor's axes turned by 45 degrees")
    assert found.is_good, found


@pytest.mark.parametrize("peak", [0.5, 5.0])
@pytest.mark.parametrize("seed", [2, *(pytest.param(seed, marks=pytest.mark.slow)
                                       for seed in (3, 10))])
def test_a_branch_that_is_held_raises_no_alarm(peak, seed):
    found = followed(peak, seed, None)
    assert found.stopped_after is None, found


def path_of(peak: float) -> Trajectory:
    return path_to(peak, np.array([0.5, 0.1, 0.4, 2.2, 2.2, 0.0]), 0.02,
                   np.random.default_rng(0))[0]


@pytest.mark.parametrize("peak, noise, refused", [
    (0.0, None, True), (0.2, None, True), (1.5, None, False), (20.0, None, False),
    (1.5, 0.4, True)])
def test_a_path_that_would_not_show_an_empty_gripper_is_refused_before_the_start(
        peak, noise, refused):
    path, told = path_of(peak), []
    if not refused:
        assert require_watched(CELL, path, False, told.append, noise)[0]["after_m"] and not told
        return
    with pytest.raises(InputError, match="measured" if noise else "stated") as error:
        require_watched(CELL, path, False, told.append, noise)
    text = str(error.value)
    assert f"at most {peak:.2g} N" in text and "--unwatched" in text and not told
    require_watched(CELL, path, True, told.append, noise)
    assert len(told) == 1
