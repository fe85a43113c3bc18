"""How long a piece the gripper holds, carried to the moduli."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.paper_branches import FRACTIONS
from limber.estimation.estimated_branch import Subject, forwards_of, parameter_space
from limber.estimation.fitting.objective import Objective
from limber.estimation.parameters import Values
from limber.estimation.settings import FitSpec, PullSpec
from limber.estimation.simulated_pull import TrueBranch, simulate_pull
from limber.estimation.uncertainty.shape_error import grip_error
from limber.geometry.skeleton.skeleton import control_points
from limber.recordings.recording import EXACT

SETTINGS = FitSpec(hold_out=False, poisson=0.36, key_frames=4)
SIGMA, STEP = 1e-3, 5e-4


@pytest.fixture(scope="module")
def clamped(small):
    truth = TrueBranch(small.mesh(slice_length=2.6, sides=6), small.skeleton,
                       control_points(small.skeleton, FRACTIONS), FRACTIONS,
                       np.array(small.young), is_weightless=True)
    return simulate_pull(truth, "pull-1", PullSpec(
        young=small.young, poisson=0.36, frames=8, mode="rigid", grasp_fraction=0.85, phase=0.5,
        seed=2, reach=0.2, position_noise=0.0, force_noise=0.0, torque_noise=0.0))[0]


def evaluated(pull, small, bench, **of_grasp):
    """Objective and evaluation at the truth, of a gripper that holds another piece perhaps."""
    grasp = pull.entry.grasp.model_copy(update=of_grasp)
    calibration = EXACT.model_copy(update={"held_length_sigma_m": SIGMA})
    entry = pull.entry.model_copy(update={"grasp": grasp, "calibration": calibration})
    values = Values(np.array(small.young), 0.36, 900.0)
    subject = Subject(bench.mesh, small.skeleton, bench.points, bench.weights, bench.model, values)
    forwards = forwards_of([replace(pull, entry=entry)], subject, SETTINGS)
    objective = Objective(forwards, parameter_space(subject, forwards, SETTINGS),
                          force_sigma=[pull.entry.sensor.force_sigma_n])
    return objective, objective.evaluate(objective.space.pack(values), jacobian=True)


def test_the_length_in_the_gripper_enters_the_interval(clamped, small, small_bench):
    """As by pulls of a gripper that holds a little more; most at the modulus beside it."""
    # No node lies just there.
    radius = clamped.entry.grasp.radius_m + 3e-4
    objective, evaluation = evaluated(clamped, small, small_bench, radius_m=radius)
    longer = evaluated(clamped, small, small_bench, radius_m=radius + STEP)[1]
    step = np.linalg.lstsq(evaluation.jacobian, evaluation.residual - longer.residual,
                           rcond=None)[0] * SIGMA / STEP
    found = grip_error(evaluation, objective)
    assert found == pytest.approx(np.abs(step[:4]), rel=0.1, abs=5e-3)
    assert 0.01 < found[3] < 0.3


def test_a_pinned_grasp_has_no_length(clamped, small, small_bench):
    objective, evaluation = evaluated(clamped, small, small_bench, mode="point")
    assert grip_error(evaluation, objective) is None
