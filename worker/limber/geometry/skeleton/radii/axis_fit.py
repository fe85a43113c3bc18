"""Axes and radii fitted to the scan together: one robust least-squares problem for the tree.

The contraction finds the branches. Their axes and radii are fitted to the scanned points. Each
point should lie at the radius from the axis of its nearest cylinder; axes and radii vary smoothly
along a run. The fit is right where only one side was seen: a circle follows from its arc, and the
neighbours along the branch determine what the arc leaves open.
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from limber.core.progress import SILENT, Progress
from limber.geometry.skeleton.radii.cylinders import Match, cylinders_around, match_cylinders
from limber.geometry.skeleton.radii.noisy_rings import (
    TargetDistances,
    held_across,
    mean_positions,
    position_uncertainty,
    weighted_target_distances,
)
from limber.geometry.skeleton.radii.normal_equations import normal_equations, radius_deviations
from limber.geometry.skeleton.radii.robust_noise import (
    residual_limit,
    robust_sigma,
    settled_weights,
    tukey,
)
from limber.geometry.skeleton.radii.visible_sides import (
    SCATTERED_ALONG_SIGHT,
    SeenSides,
    across_sight,
    evenly_seen,
    fit_seen_side,
    seen_sides,
    side_uncertainty,
)
from limber.geometry.skeleton.skeleton import INTERPOLATED, MEASURED, Skeleton

# Grid from which each round starts, as a fraction of the median radius. It is a fifth of the step
# that ends a fit, and far coarser than rounding differences between libraries.
_GRID = 1e-5
_MOVED = 0.2  # fraction of the radius; nodes that moved less keep their points' cylinders
_REACH = 2.0  # largest distance of an axis from its contracted position, in radii
_HELD = 2  # trusted rounds in which the limit keeps that of most sensors


@dataclass(frozen=True)
class AxisFit:
    """A fitted skeleton and the evidence of the points.

    Attributes:
        skeleton: Axes, radii, their standard deviations and states.
        segment: The node whose cylinder (to its parent) each point belongs to, shape [m].
        residual: Distance of each point from that cylinder [m], positive outside, shape [m].
        noise: Robust standard deviation of the residuals [m].
        seen: From which side the branches were seen.
    """

    skeleton: Skeleton
    segment: np.ndarray
    residual: np.ndarray
    noise: float
    seen: SeenSides


def fit_axes(skeleton: Skeleton, points: np.ndarray, *, rounds: int = 12,
             settled: bool = False, along_sight: bool = False, uncertainty: bool = True,
             seen: SeenSides | None = None, progress: Progress = SILENT) -> AxisFit:
    """Fit axes and radii of a skeleton's runs to points.

    Args:
        skeleton: Approximate axes, with first radii; its topology is kept.
        points: Scanned points [m], shape [m, 3].
        rounds: Gauss-Newton rounds; points choose their cylinder again in each.
        settled: The axes are already near their final positions; only fine changes remain.
        along_sight: The points are a depth camera's: they scatter only along its sight.
        uncertainty: Compute each radius's standard deviation too; otherwise it and the states are
            unchanged.
        seen: The sides that an earlier fit found; None: estimated again in each round. Where noise
            hides the rings, an estimate repeated in each round follows the axes of the last one,
            and radii shrink from round to round.
        progress: Called each round.
    """
    fit = _Rounds(skeleton, points, rounds, settled, along_sight, seen)
    for number in range(rounds):
        size = fit.step(number)
        progress((number + 1) / rounds, "fitting axes", noise_m=fit.noise)
        if number > rounds // 2 + 1 and fit.has_settled(size):
            break
    return fit.result(uncertainty)


class _Rounds:
    """Axes and radii from round to round of a fit, and the evidence of the points so far."""

    def __init__(self, skeleton: Skeleton, points: np.ndarray, rounds: int, settled: bool,
                 along_sight: bool, seen: SeenSides | None) -> None:
        # Leaves, which lie on no axis, mislead a fit. A difference in the last digit then grows
        # from round to round until other cylinders are chosen. On a grid it does not outlast its
        # round.
        self._grid = 2.0**np.floor(np.log2(_GRID * float(np.median(skeleton.radius))))
        nodes, radius = self._on_grid(skeleton.nodes, skeleton.radius)
        self._start = replace(skeleton, nodes=nodes, radius=radius)
        self._nodes, self._radius, self._points = nodes, radius, points
        self._rounds, self._settled, self._along_sight = rounds, settled, along_sight
        self._spread = 0.35 * float(np.median(radius))
        self._floor = 0.05 * float(np.median(radius))
        # Once a fit is too thin, scatter along the sight is no longer recognisable: prior knowledge
        # is used.
        self._known = SCATTERED_ALONG_SIGHT if along_sight else seen
        self._near: np.ndarray | None = None
        self._found_at = nodes
        self._even: np.ndarray | None = None
        self._fitted_side: SeenSides | None = None
        self._side_fit_count = 0
        self.noise = 0.0

    def step(self, number: int) -> float:
        """Move axes and radii by one round; returns the longest step of a node [m]."""
        match = self._match()
        # Wide at first, since a one-sided scan starts with its axis far off; later as wide as the
        # noise.
        noise = max(robust_sigma(match.residual, match.thick), 1e-4 * self._floor)
        self.noise = noise
        self._spread = noise if self._settled else max(noise, 0.6 * self._spread)
        # While axes are still far off, the misfit is not noise that smoothing could reduce.
        trusted = noise if self._settled or number > self._rounds // 2 else 0.0
        limit = partial(residual_limit, self._spread, noise, 0.0 if self._along_sight else trusted)
        weight = tukey(match.residual, limit(match.thick))
        asked = self._asked(match, weight, limit) if trusted else (
            match.normal, TargetDistances(match.thick, match.thick), None)
        step = normal_equations(self._start, self._nodes, self._radius, match, weight, trusted,
                                *asked).solve()
        size = np.linalg.norm(step[:, :3], axis=1)
        self._move(step, size)
        return float(size.max())

    def has_settled(self, size: float) -> bool:
        """Whether a round's longest step [m] is negligible, and all noise is trusted."""
        return size < 1e-3 * self._floor and self._spread <= 1.01 * self.noise

    def result(self, uncertainty: bool) -> AxisFit:
        """Result of the fit; with ``uncertainty`` each radius's standard deviation too."""
        nodes, radius, start = self._nodes, self._radius, self._start
        match = match_cylinders(start.parent, start.order, nodes, radius, self._points)
        noise = robust_sigma(match.residual, match.thick)
        weight = settled_weights(match.residual, noise)
        seen, *_ = self._sides(match, weight, noise)
        if self._fitted_side is not None and seen.one_sided:
            seen = self._fitted_side
        sigma, state = start.radius_sigma, start.radius_state
        if uncertainty:
            sigma, pooled = radius_deviations(start, nodes, radius, match, weight,
                                              max(noise, 1e-12))
            sigma = np.hypot(sigma * position_uncertainty(seen, radius, noise),
                             side_uncertainty(seen, radius, noise))
            state = np.where(pooled, MEASURED, INTERPOLATED).astype(np.int8)
        fitted = replace(start, nodes=nodes, radius=np.maximum(radius, 0.1 * self._floor),
                         radius_sigma=sigma, radius_state=state)
        return AxisFit(fitted, match.segment, match.residual, noise, seen)

    def _on_grid(self, nodes: np.ndarray, radius: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions and radii [m] rounded to the grid, no radius to zero."""
        nodes, radius = (np.round(values / self._grid) * self._grid for values in (nodes, radius))
        return nodes, np.maximum(radius, self._grid)

    def _match(self) -> Match:
        """The cylinder of each point; candidates are searched again once axes have moved."""
        start, nodes = self._start, self._nodes
        moved = np.linalg.norm(nodes - self._found_at, axis=1)
        if self._near is None or (moved > _MOVED * self._radius).any():
            self._near = cylinders_around(start.parent, nodes, self._points)
            self._found_at = nodes
        return match_cylinders(start.parent, start.order, nodes, self._radius, self._points,
                               self._near)

    def _sides(self, match: Match, weight: np.ndarray, noise: float,
               ) -> tuple[SeenSides, np.ndarray, np.ndarray, np.ndarray]:
        """The sides seen; for each point the axis [m, 3], ``sharpness`` and ``stout``.
        """
        axis = self._nodes[match.segment] - self._nodes[self._start.parent[match.segment]]
        axis /= np.maximum(np.linalg.norm(axis, axis=1), 1e-300)[:, None]
        sharpness = match.thick * (match.residual + match.thick) / max(noise, 1e-12)**2
        stout = (match.thick / max(noise, 1e-12))**2
        seen = self._known or seen_sides(match.normal, axis, match.residual, sharpness, stout,
                                         weight)
        return seen, axis, sharpness, stout

    def _asked(self, match: Match, weight: np.ndarray, limit: partial,
               ) -> tuple[np.ndarray, TargetDistances, np.ndarray | None]:
        """Where noise hides positions: each point's mean position, how far out it should lie, and
        how firmly it holds the axis across.
        """
        now, axis, sharpness, stout = self._sides(match, weight, self.noise)
        if now.one_sided and self._known is None:
            shown_weight = weight if self._even is None else weight * self._even[match.segment]
            self._fitted_side = now = fit_seen_side(
                match.normal, axis, sharpness, shown_weight, now.view, self._fitted_side or now,
                limit_free=self._side_fit_count >= _HELD)
            self._side_fit_count += 1
        positions = mean_positions(match.normal, axis, sharpness, stout, now)
        targets = TargetDistances(match.thick, match.thick)
        if not now.along_sight:
            targets, nearest = weighted_target_distances(match.thick, self.noise, limit)
        if now.one_sided:
            if self._even is None:
                # Estimated once, from axes fitted to the nearest positions: a strip makes a thin
                # cylinder of its own and seems to show all of its side.
                self._even = evenly_seen(self._start, self._nodes, self._radius, match, weight,
                                         across_sight(match.normal, axis, now), self.noise)
            whole = self._even[match.segment]
            positions = np.where(whole[:, None], positions, match.normal)
            targets = TargetDistances(np.where(whole, targets.axis, nearest.axis),
                                      np.where(whole, targets.radius, nearest.radius))
        return positions, targets, None if now.along_sight else held_across(
            match.normal, axis, positions, stout)

    def _move(self, step: np.ndarray, size: np.ndarray) -> None:
        """Take a round's step [n, 4], limited for lengths ``size`` [n]."""
        shrink = np.minimum(1.0, 0.5 * self._radius / np.maximum(size, 1e-300))
        nodes = self._nodes + step[:, :3] * shrink[:, None]
        radius = self._radius + np.clip(step[:, 3], -0.4 * self._radius, 0.8 * self._radius)
        self._nodes, self._radius = self._on_grid(*_near_start(self._start, nodes, radius))


def _near_start(skeleton: Skeleton, nodes: np.ndarray, radius: np.ndarray,
                ) -> tuple[np.ndarray, np.ndarray]:
    """Keep axes within reach of the contracted ones, which are inside the branch or on its skin.

    Without that limit, a run with few points may drift off and take other runs' points with it.
    """
    moved = nodes - skeleton.nodes
    size = np.linalg.norm(moved, axis=1)
    reach = _REACH * skeleton.radius
    moved *= np.minimum(1.0, reach / np.maximum(size, 1e-300))[:, None]
    return skeleton.nodes + moved, np.clip(
        radius, skeleton.radius / (2 * _REACH), 2 * _REACH * skeleton.radius)
