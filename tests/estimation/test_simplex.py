"""Nelder-Mead on a narrow valley: it begins again where a simplex has collapsed."""

import numpy as np
import pytest

from limber.estimation.fitting import optimise
from limber.estimation.fitting.objective import Evaluation, EvaluationLog
from limber.estimation.fitting.optimise import SETTLED_FALL, FitStatus, _Settling, nelder_mead
from limber.estimation.parameters import ParameterSpace, Values

FORM = 0.4


class _Valley:
    """Rosenbrock's function of two log moduli; the form of the field has a slope of its own."""

    forwards = ()

    def __init__(self):
        base = Values(np.exp([14.0, 16.0]), 0.35, 900.0, form=(FORM,))
        self.space = ParameterSpace(base, (0, 1), ("form 1",), priors=(("form 1", 0.0, 1.0),))
        self.log, self.asked = EvaluationLog(None, ""), []

    def evaluate(self, free, *, jacobian=False):
        self.asked.append(free)
        x, y = free[:2] - 15.0
        residual = np.array([10 * (y - x**2), 1 - x, free[2] - 2.0])
        return Evaluation(free, residual, None, float(residual @ residual), ())


def test_it_begins_again_where_a_simplex_ended_too_early(monkeypatch):
    """Each search is cut off long before the minimum, as by a simplex that has collapsed."""
    search, ends = optimise._simplex_search, []

    def collapsing(cost, begin, steps, bounds, rule, tolerance, limit):
        found = search(cost, begin, steps, bounds, rule, tolerance, min(limit, 40))
        found.success = True
        ends.append(found.fun)
        return found

    monkeypatch.setattr(optimise, "_simplex_search", collapsing)
    valley = _Valley()
    fit = nelder_mead(valley, valley.space.pack(valley.space.base), evaluation_limit=1500)
    assert fit.converged and ends[0] > ends[-1] + 0.5
    assert fit.evaluation.free[:2] == pytest.approx([16.0, 16.0], abs=0.1)


def test_what_is_known_by_its_prior_alone_is_not_searched():
    """A fourth corner would take twice the simulations and say nothing."""
    valley = _Valley()
    nelder_mead(valley, valley.space.pack(valley.space.base), evaluation_limit=60)
    assert {float(free[2]) for free in valley.asked} == {FORM}


@pytest.mark.parametrize(("delta", "status", "reason"), [
    (2.7, FitStatus.converged, "fell below 2.7 m2"),
    (1.0, FitStatus.misfit, "settled above the requested 1 m2 (--delta-m2)")])
def test_it_ends_below_the_papers_delta(delta, status, reason):
    """The form of the field alone leaves 2.56 here."""
    valley = _Valley()
    start = valley.space.pack(valley.space.base)
    fit = nelder_mead(valley, start, evaluation_limit=1500, delta_m2=delta)
    assert fit.status is status and reason in fit.reason
    assert (fit.evaluation.loss < delta) == (status is FitStatus.converged)


def test_no_more_simulations_than_allowed():
    valley = _Valley()
    fit = nelder_mead(valley, valley.space.pack(valley.space.base), evaluation_limit=30)
    assert not fit.converged and "30 simulations were not enough" in fit.reason
    assert "It would take more than" in fit.reason or "would settle after about" in fit.reason
    assert len(valley.asked) <= 32


def test_it_says_after_how_many_simulations_it_would_settle():
    """A fall that shrinks by half every 20 iterations of 2 simulations each."""
    rule = _Settling(_Valley())
    for number in range(40):
        rule.count += 2
        rule.seen(100 * 0.5**(number / 20) + 50, 1.0)
        rule.after_iteration(np.zeros(3))
    reason = rule.verdict(False, 80)[1]
    about = float(reason.split("about ")[1].split(".")[0])
    # 25 are left to fall; a hundredth after 11 halvings, of 40 simulations each.
    assert about == pytest.approx(80 + 40 * np.log2(25 / SETTLED_FALL), rel=0.15)
