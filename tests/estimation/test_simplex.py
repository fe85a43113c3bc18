"""Nelder-Mead on a narrow valley: it begins again where a simplex has collapsed."""

from types import SimpleNamespace

import numpy as np
import pytest

from limber.estimation.fitting import optimise
from limber.estimation.fitting.objective import Evaluation, EvaluationLog, Work
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
    fit = optimise.nelder_mead(valley, valley.space.pack(valley.space.base), evaluation_limit=1500)
    assert fit.converged and ends[0] > ends[-1] + 0.5
    assert fit.evaluation.free[:2] == pytest.approx([16.0, 16.0], abs=0.1)


def test_what_is_known_by_its_prior_alone_is_not_searched():
    """A fourth corner would take twice the simulations and say nothing."""
    valley = _Valley()
    optimise.nelder_mead(valley, valley.space.pack(valley.space.base), evaluation_limit=60)
    assert {float(free[2]) for free in valley.asked} == {FORM}


@pytest.mark.parametrize(("delta", "status", "reason"), [
    (2.7, optimise.FitStatus.converged, "fell below 2.7 m2"),
    (1.0, optimise.FitStatus.misfit, "settled above the requested 1 m2 (--delta-m2)")])
def test_it_ends_below_the_papers_delta(delta, status, reason):
    """The form of the field alone leaves 2.56 here."""
    valley = _Valley()
    start = valley.space.pack(valley.space.base)
    fit = optimise.nelder_mead(valley, start, evaluation_limit=1500, delta_m2=delta)
    assert fit.status is status and reason in fit.reason
    assert (fit.evaluation.loss < delta) == (status is optimise.FitStatus.converged)


def test_no_more_simulations_than_allowed():
    valley = _Valley()
    fit = optimise.nelder_mead(valley, valley.space.pack(valley.space.base), evaluation_limit=30)
    assert not fit.converged and "30 simulations were not enough" in fit.reason
    assert len(valley.asked) <= 32


# A fit ends where nothing that matters is left to gain, however finely simulations repeat.

TRUTH = np.log([2e9, 5e8])


class RoughObjective:
    """Two moduli in 300 readings; each simulation is off a little, another one elsewhere."""

    def __init__(self, roughness):
        self.forwards = [SimpleNamespace(watches_pose=roughness > 0)]
        rng = np.random.default_rng(4)
        self.space = ParameterSpace.separate(Values(np.array([1e9, 1e9]), 0.35, 900.0))
        self.slopes = rng.standard_normal((300, 2)) * [1.0, 0.4]
        self.noise = rng.standard_normal(300)
        self.variance, self.work = 1.0, Work()
        self.ripple = roughness * rng.standard_normal(300)
        self.count = 0

    def evaluate(self, free, *, jacobian=False):
        self.count += 1
        off = self.slopes @ (free - TRUTH) + 0.05 * self.slopes[:, 0] * (free - TRUTH)[1]**2
        residual = off + self.noise + self.ripple * np.sin(1e5 * free.sum())
        slopes = self.slopes + 0.1 * np.outer(self.slopes[:, 0] * (free - TRUTH)[1], [0, 1])
        return Evaluation(np.array(free), residual, slopes if jacobian else None, 0.0, ())

    def follow_forces(self, _evaluation):
        return False


def test_a_fit_does_not_wander_in_what_simulations_do_not_repeat():
    """Few simulations, and next to where the fit on exact ones ends."""
    exact, rough = RoughObjective(0.0), RoughObjective(0.1)
    start = TRUTH + [-0.7, 0.7]
    best = optimise.gauss_newton(exact, start, tolerance=1e-12, shortest=1e-3).evaluation
    found = optimise.gauss_newton(rough, start)
    assert found.converged
    # Until its steps are too short for any, 22.
    assert rough.count <= 18
    left = best.jacobian @ (found.evaluation.free - best.free)
    assert np.linalg.norm(left) < 2 * optimise.SETTLED_STEP


def test_a_settled_fit_has_converged_at_its_limit_too():
    """The last simulation that is allowed leads to the end: no other has to tell so."""
    fit = optimise.gauss_newton(RoughObjective(0.0), TRUTH + [-0.7, 0.7], is_near=True,
                                tolerance=1e-12, evaluation_limit=4)
    assert fit.converged and "standard deviations" in fit.reason
