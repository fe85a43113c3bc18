"""A fit ends where nothing that matters is left to gain, however finely simulations repeat."""

from types import SimpleNamespace

import numpy as np

from limber.estimation.fitting.objective import Evaluation
from limber.estimation.fitting.optimise import WANDERING_STEP, gauss_newton
from limber.estimation.parameters import ParameterSpace, Values

TRUTH = np.log([2e9, 5e8])


class RoughObjective:
    """Two moduli in 300 readings; each simulation is off a little, another one elsewhere."""

    def __init__(self, roughness):
        self.forwards = [SimpleNamespace(watches_pose=roughness > 0)]
        rng = np.random.default_rng(4)
        self.space = ParameterSpace.separate(Values(np.array([1e9, 1e9]), 0.35, 900.0))
        self.slopes = rng.standard_normal((300, 2)) * [1.0, 0.4]
        self.noise = rng.standard_normal(300)
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
    best = gauss_newton(exact, start, tolerance=1e-12).evaluation
    found = gauss_newton(rough, start)
    assert found.converged
    # Until its steps are too short for any, 22.
    assert rough.count <= 18
    left = best.jacobian @ (found.evaluation.free - best.free)
    assert np.linalg.norm(left) < 2 * WANDERING_STEP


def test_a_settled_fit_has_converged_at_its_limit_too():
    """The last simulation that is allowed leads to the end: no other has to tell so."""
    fit = gauss_newton(RoughObjective(0.0), TRUTH + [-0.7, 0.7], robust=False, evaluation_limit=3)
    assert fit.converged and "standard deviations" in fit.reason
