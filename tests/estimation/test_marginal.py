"""Moduli with the form of their field integrated out, against the integral itself."""

import numpy as np
import pytest
from scipy.optimize import least_squares, minimize

from limber.estimation.fitting.objective import Evaluation
from limber.estimation.parameters import ParameterSpace, Values, YoungField
from limber.estimation.uncertainty.covariance import marginal_step

FORMS = np.linspace(-4, 4, 17)


def two_moduli():
    """Four pieces between two control points, and readings of sums of their log E."""
    straight = np.array([[1.0, 0.0], [0.7, 0.3], [0.3, 0.7], [0.0, 1.0]])
    field = YoungField(
        np.array([[0.9, 0.1], [0.6, 0.4], [0.4, 0.6], [0.1, 0.9]]), straight,
        np.array([[0.2], [1.0], [1.0], [0.2]]), np.array([0.1]), np.array([[-0.15, 0.15]]),
        ("form", "form at 0.5"))
    base = Values(np.array([1.0, 0.2]), 0.35, 900.0)
    priors = tuple((name, 0.0, 1.0) for name in field.names)
    space = ParameterSpace(base, (0, 1), field.names, priors=priors)
    readings = np.array([[1.0, 0.0, 0.0, 0.0], [0.3, 0.4, 0.3, 0.0], [0.0, 0.3, 0.4, 0.3],
                         [0.0, 0.0, 0.0, 1.0]]) / 0.06
    wanted = readings @ np.log(field.young(
        Values(base.young, 0.35, 900.0, form=(0.4, 0.8)))) + [0.5, -0.8, 0.3, 0.6]
    return field, space, readings, wanted


@pytest.mark.slow
def test_the_step_leads_to_the_mode_of_the_integral():
    """Nearly there, and to a smaller step of the moduli than where all are likeliest together."""
    field, space, readings, wanted = two_moduli()

    def residual(free):
        values = space.unpack(free)
        return np.r_[readings @ np.log(field.young(values)) - wanted, free[2:]]

    def left(log_young):
        """Minus the logarithm of the density with all forms summed."""
        each = [residual(np.r_[log_young, one, other]) for one in FORMS for other in FORMS]
        halves = 0.5 * np.sum(np.square(each), axis=1)
        return halves.min() - np.log(np.sum(np.exp(halves.min() - halves)))

    mode = least_squares(residual, np.r_[np.log(space.base.young), 0.0, 0.0], xtol=1e-12).x
    true = minimize(left, mode[:2], method="Nelder-Mead",
                    options={"xatol": 1e-5, "fatol": 1e-9}).x
    values = space.unpack(mode)
    slopes = np.vstack([readings @ field.shares(values, space.extra).T,
                        np.eye(4)[2:]])
    step = marginal_step(Evaluation(mode, residual(mode), slopes, 0.0, ()), space, field)
    off, still_off = true - mode[:2], true - mode[:2] - step[:2]
    assert np.linalg.norm(off) > 5e-3
    assert np.linalg.norm(still_off) < 0.4 * np.linalg.norm(off)
    assert abs(np.diff(true)[0]) < abs(np.diff(mode[:2])[0])


def test_growth_equals_differences():
    """Of the mixture and of a bump, by steps of each modulus."""
    field, space, _, _ = two_moduli()
    values = space.base

    def sizes(log_young):
        shares = field.shares(Values(np.exp(log_young), 0.35, 900.0), space.extra)[2:]
        return np.log(np.linalg.norm(shares, axis=1))

    found, centre = field.growth(values), np.log(values.young)
    for modulus in range(2):
        step = 1e-5 * np.eye(2)[modulus]
        slope = (sizes(centre + step) - sizes(centre - step)) / 2e-5
        assert np.allclose(found[:, modulus], slope, rtol=1e-5, atol=1e-8)
