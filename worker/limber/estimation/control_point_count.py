"""The number of control points of Young's modulus that the pulls support, by their evidence.

More control points always fit as well or better; whether the data ask for them is told by the
evidence, the probability of the data under all moduli that the prior allows. Here it is Laplace's
approximation (MacKay, Information Theory, 2003, ch. 28) about one finished fit: with its bumps, its
modulus is piecewise linear in the logarithm between stations twice as dense as the control points.
Every other number of control points is a linear model of the values there, so no pull is simulated
again.
"""

from dataclasses import dataclass, replace

import numpy as np

from limber.core.errors import InputError, Option
from limber.estimation.fit_assessment import Estimate
from limber.estimation.parameters import LINK_DEVIATION, Values, bump_deviations, hats, stations_of
from limber.estimation.settings import FitSpec
from limber.estimation.uncertainty.covariance import repeated, scaled_rows
from limber.geometry.skeleton.skeleton import FRACTIONS

MOST = 6
"""Largest number of control points that is considered."""
LEVEL_DEVIATION = 3.0
"""Prior deviation of the mean log E: a factor of 20."""
LINK_DISTANCE = 0.2
"""Distance of control points, over the path's length, to which ``LINK_DEVIATION`` belongs."""
LIKELIER = 3.0
"""Difference of log evidences above which the number of control points is changed: below it the
pulls do not tell, and fewer moduli would only look better known.
"""
ALIKE = 1.0
"""Difference of log evidences below which the smaller of two numbers is taken."""


@dataclass(frozen=True)
class Support:
    """What one fit says about the number of control points: their positions on the main path, log
    evidence by number, and values near the solution with them."""

    fractions: tuple[float, ...]
    evidence: dict[int, float]
    start: Values


def is_open(settings: FitSpec) -> bool:
    """Whether the number of control points is to be chosen: it is not given, and can be.
    Nelder-Mead has no derivatives; the paper's field and a reduced model have no bumps."""
    return (not settings.fractions and settings.method == "gauss-newton"
            and settings.forward == "full" and settings.field == "open")


def equal_fractions(count: int) -> tuple[float, ...]:
    """Return control points at equal distances from each other and from base and tip."""
    return tuple((k + 1) / (count + 1) for k in range(count))


def supported(found: Estimate) -> Support:
    """Return as many control points as the pulls support, by a fit with those at ``FRACTIONS``.
    InputError if it has no derivatives, or its field no bumps."""
    problem = _Problem.of(found)
    parts = {count: problem.posterior(equal_fractions(count)) for count in range(1, MOST + 1)}
    evidence = {count: part[0] for count, part in parts.items()}
    best, used = max(evidence.values()), len(FRACTIONS)
    count = used if evidence[used] > best - LIKELIER else min(
        count for count, value in evidence.items() if value > best - ALIKE)
    return Support(FRACTIONS if count == used else equal_fractions(count), evidence,
                   replace(found.values, young=np.exp(parts[count][1]), form=()))


@dataclass(frozen=True)
class _Problem:
    """A fit as linear in log E at stations [S], ascending, and q other unknowns: residual [r] over
    deviations, with the others' priors, and its derivatives [r, S] and [r, q]."""

    stations: np.ndarray
    log_young: np.ndarray
    residual: np.ndarray
    by_young: np.ndarray
    by_others: np.ndarray

    @classmethod
    def of(cls, found: Estimate) -> "_Problem":
        evaluation, space = found.fit.evaluation, found.objective.space
        field = getattr(found.objective.forwards[0].full, "field", None)
        if evaluation.jacobian is None or field is None or field.straight is None:
            raise InputError("The evidence of control points needs derivatives and an open field.",
                             "Only a Gauss-Newton fit with the full model has both.",
                             "Give the control points (", Option("fractions"), ").")
        noise = evaluation.mean_square * repeated(found.objective.standardised(evaluation))
        residual, slopes = (scaled_rows(rows, space.own_row_count, noise) for rows in (
            evaluation.residual[:, None], evaluation.slopes))
        stations = stations_of(FRACTIONS)
        bumps = [number for number, place in enumerate(stations)
                 if not np.isclose(place, FRACTIONS).any()]
        # Log E at the stations by log E at the control points and by the bumps.
        moved = np.zeros((len(stations), space.size))
        moved[:, :space.group_count] = hats(stations, np.array(FRACTIONS)) @ space.membership
        first = space.names.index(field.names[1])
        moved[bumps, np.arange(first, first + len(bumps))] = field.deviations(
            found.values)[:len(bumps)]
        chosen = np.r_[:space.group_count, first:first + len(bumps)]
        others = np.setdiff1d(np.arange(space.size), [*chosen, space.names.index(field.names[0])])
        # Their own prior is that of each model; links and the mixture belong to the fit's field.
        kept = np.r_[:len(residual) - space.own_row_count,
                     [len(residual) - space.own_row_count + number
                      for number, (name, _, _) in enumerate(space.priors)
                      if space.names.index(name) in others]].astype(int)
        return cls(stations, moved @ evaluation.free, residual[kept, 0],
                   slopes[np.ix_(kept, chosen)] @ np.linalg.inv(moved[:, chosen]),
                   slopes[np.ix_(kept, others)])

    def posterior(self, fractions: tuple[float, ...]) -> tuple[float, np.ndarray]:
        """Log evidence of control points, less a constant, and log E there, shape [K]."""
        positions, count = np.array(fractions), len(fractions)
        guess = np.interp(positions, self.stations, self.log_young)
        places, deviations = bump_deviations(fractions, guess)
        # Log E at the stations by log E at these control points, and by the bumps between them.
        of_bumps = hats(self.stations, stations_of(fractions))[:, places] * deviations
        shape = np.hstack([hats(self.stations, positions), of_bumps])
        prior = np.vstack([np.full(count, 1 / (count * LEVEL_DEVIATION)),
                           np.diff(np.eye(count), axis=0) / (
                               LINK_DEVIATION * (1 / (count + 1) / LINK_DISTANCE)**0.5)])
        level = np.interp(FRACTIONS, self.stations, self.log_young).mean()
        unknowns = shape.shape[1] + self.by_others.shape[1]
        own = np.eye(shape.shape[1], unknowns)
        own[:count, :count] = prior
        rows = np.vstack([np.hstack([self.by_young @ shape, self.by_others]), own])
        # The level of the prior is that of the fit, about which all models agree.
        target = np.r_[self.by_young @ self.log_young - self.residual,
                       prior @ np.full(count, level), np.zeros(len(places))]
        known = np.linalg.lstsq(rows, target, rcond=None)[0]
        off = rows @ known - target
        information = np.linalg.slogdet(rows.T @ rows)[1]
        return (float(-0.5 * off @ off + np.linalg.slogdet(prior)[1] - 0.5 * information),
                known[:count])

