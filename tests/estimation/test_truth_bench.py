"""How close estimates of the truth bench can come."""

import numpy as np
import pytest

from benchmarks.paper_branches import measured
from benchmarks.truth import _efficient
from benchmarks.truth_branch import drawn_truth, exact_pull
from benchmarks.truth_trials import FIRST_PULL, FIRST_TURN, SETTINGS, bounds, fitting_subject
from limber.estimation.fit_preparation import forwards_of, parameter_space
from limber.estimation.fitting.objective import Objective


def test_moduli_that_err_together_count_as_one():
    """A tenth off all alike: the median of a normal's size is .67 of its deviation."""
    together = np.full((4, 4), 0.01) + 1e-12 * np.eye(4)
    assert abs(_efficient([together, together]) - 0.068) < 0.004
    assert _efficient([0.01 * np.eye(4)]) > 0.14
    nothing = np.full((4, 4), None)
    assert _efficient([together, nothing]) == _efficient([together])


@pytest.mark.slow
def test_a_known_form_leaves_less_open():
    """Of one drawn branch and pull; less of each modulus and of any mixture of them."""
    truth = drawn_truth(np.random.default_rng(3))
    subject = fitting_subject(truth)
    pull = measured(exact_pull(truth, 0, FIRST_PULL, FIRST_TURN), 4)
    forwards = forwards_of([pull], subject, SETTINGS)
    objective = Objective(forwards, parameter_space(subject, forwards, SETTINGS))
    as_fitted, of_known_form = bounds(truth, objective, subject)
    assert np.all(np.linalg.eigvalsh(as_fitted - of_known_form) > -1e-9)
    assert np.all(np.diag(of_known_form) < 0.8 * np.diag(as_fitted))
