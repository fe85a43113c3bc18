"""Intervals of wide moduli, by the likelihood itself."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from benchmarks.paper_branches import measured
from limber.core.progress import Progress
from limber.estimation.fitting.objective import Evaluation
from limber.estimation.parameters import LINK_DEVIATION, ParameterSpace, Values
from limber.estimation.settings import FitSpec
from limber.estimation.uncertainty.covariance import Uncertainty, bend_of, limit_of, profiled

SETTINGS = FitSpec(poisson=0.36, hold_out=False, key_frames=6)
NOISE = 40.0
"""Variance over the stated, for wide intervals of a pull that tells its moduli well."""


class TwoPieces:
    """A firm piece and a soft one in a row, each bent by its compliance; two readings of that."""

    bends = np.array([[1.0, 0.0], [1.0, 1.0]])
    noise, variance = np.array([0.03, 0.35]), 1.0
    """With both compliances 1, the second is told to a third of itself."""
    space = ParameterSpace.separate(Values(np.array([1e8, 1e8]), 0.35, 900.0))

    def __init__(self, readings):
        self.readings = readings

    def on_copies(self):
        return self

    def evaluate(self, free, *, jacobian):
        compliance = 1e8 * np.exp(-free)
        slopes = -self.bends * compliance / self.noise[:, None]
        return Evaluation(free, (self.bends @ compliance - self.readings) / self.noise, slopes,
                          0.0, ())

    def best(self):
        compliance = np.linalg.solve(self.bends, self.readings)
        return self.evaluate(-np.log(compliance / 1e8), jacobian=True)

    def sure(self, best):
        covariance = np.linalg.inv(best.jacobian.T @ best.jacobian)
        sides = 1.96 * np.sqrt(np.diag(covariance))[:, None] * [-1, 1]
        return Uncertainty(covariance, np.exp(best.free[:, None] + sides), 1.0, covariance)


def missed(interval, truth):
    """Whether each interval lies below the truth, and above it."""
    return interval[1] < truth, interval[0] > truth


@pytest.mark.slow
def test_a_soft_piece_is_missed_as_often_to_one_side_as_to_the_other():
    """Of 1,500 draws 2.5 % each; by the curvature twice as often, all of them too soft."""
    rng, plain, found = np.random.default_rng(1), [], []
    for _ in range(1500):
        drawn = TwoPieces(TwoPieces.bends @ [1.0, 1.0] + TwoPieces.noise * rng.standard_normal(2))
        if np.linalg.solve(TwoPieces.bends, drawn.readings)[1] < 0.05:
            continue
        best = drawn.best()
        sure = drawn.sure(best)
        plain.append(missed(sure.young_interval[1], 1e8))
        found.append(missed(profiled(sure, best, drawn)[0].young_interval[1], 1e8))
    too_soft, too_stiff = 100 * np.mean(plain, axis=0)
    assert too_soft > 4.5 and too_stiff < 0.2
    too_soft, too_stiff = 100 * np.mean(found, axis=0)
    assert 1.5 < too_soft < 3.5 and 1.5 < too_stiff < 3.5


def test_a_profile_that_meets_a_lower_loss_tells_where():
    """There was no end of the fit; at its end there is no lower one."""
    drawn = TwoPieces(np.array([1.0, 2.0]))
    early = drawn.evaluate(drawn.best().free + [0.0, 1.5], jacobian=True)
    _, lower, _ = profiled(drawn.sure(early), early, drawn)
    assert lower.objective < early.objective - 0.1
    assert profiled(drawn.sure(lower), drawn.best(), drawn)[1] is None


def test_where_any_stiffness_fits_neighbours_end_the_interval():
    """A compliance of nothing within its deviation: up to what neighbours differ by, and said."""
    drawn = TwoPieces(np.array([1.0, 1.6]))
    best = drawn.best()
    told = []
    found, _, _ = profiled(drawn.sure(best), best, drawn, Progress(on_warning=told.append))
    assert found.young_interval[1, 1] == pytest.approx(1e8 * np.exp(1.96 * LINK_DEVIATION))
    assert "E2" in told[0] and len(told) == 1
    # The firm one's is narrow: it stays.
    assert np.array_equal(found.young_interval[0], drawn.sure(best).young_interval[0])


@pytest.mark.slow
def test_limits_of_a_pull_are_where_the_squares_have_risen(small_bench, small_pull):
    """With more noise than there is: at both limits of a wide modulus, all else fitted anew by
    scipy; and the objective is left as it was.
    """
    pull = measured(small_pull, 3, points=5e-4, force=0.01)
    fitted = small_bench.fit([pull], SETTINGS)
    objective, best = fitted.objective, fitted.fit.evaluation
    deviation = np.sqrt(NOISE * np.diag(np.linalg.inv(best.jacobian.T @ best.jacobian)))
    sure = replace(fitted.uncertainty, variance_factor=NOISE, repetition=1.0,
                   covariance=np.diag(deviation**2))
    before = objective.evaluate(best.free, jacobian=True)
    widest = int(np.argmax(deviation[:4]))
    limits = np.log(profiled(sure, best, objective)[0].young_interval[widest])
    assert objective.evaluate(best.free) is before
    assert limits.mean() > best.free[widest]
    others = np.arange(len(best.free)) != widest
    tried = objective.on_copies()
    for limit in limits:
        def held(rest, limit=limit):
            free = np.empty(len(best.free))
            free[widest], free[others] = limit, rest
            return tried.evaluate(free, jacobian=True)

        end = least_squares(lambda rest: held(rest).residual, best.free[others],
                            jac=lambda rest: held(rest).jacobian[:, others], xtol=1e-4)
        rise = 2 * (end.cost - best.objective) / NOISE
        assert np.sqrt(rise) == pytest.approx(sure.quantile, rel=0.1)


def test_a_bend_leads_to_its_limit():
    """Through the point that it was taken from; straight at none; open where it never gets."""
    for bend in (-0.6, 0.0, 0.3, 0.5):
        for at in (-1.5, 0.8):
            root = at if bend == 0 else -np.expm1(-bend * at) / bend
            assert bend_of(at, root) == pytest.approx(bend, abs=1e-5)
            assert limit_of(bend, root) == pytest.approx(at)
    assert limit_of(0.6, 1.96) == np.inf and limit_of(-0.6, -1.96) == -np.inf
