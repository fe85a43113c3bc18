"""The repairs that fit a skeleton of contracted points to the scan, as an ordered list."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from limber.core.progress import SILENT, Progress
from limber.geometry.cloud.single_view import View
from limber.geometry.skeleton.confidence import assessed, doubted
from limber.geometry.skeleton.radii.axis_fit import AxisFit, fit_axes
from limber.geometry.skeleton.radii.ray_fit import fit_of_rays
from limber.geometry.skeleton.repair.attachment import attached
from limber.geometry.skeleton.repair.duplicate_axes import without_duplicate_axes
from limber.geometry.skeleton.repair.fused_forks import separate_fused_forks
from limber.geometry.skeleton.repair.fused_limbs import with_split_limbs
from limber.geometry.skeleton.repair.kinks import without_kinks
from limber.geometry.skeleton.repair.resampling import PointSpacing, resampled
from limber.geometry.skeleton.repair.run_ends import ends_within, with_full_tips, without_bare_ends
from limber.geometry.skeleton.repair.run_radii import (
    limited,
    steadied,
    unpinched,
)
from limber.geometry.skeleton.repair.spurs import SPUR_REACH, prune_spurs
from limber.geometry.skeleton.skeleton import Skeleton

LEAF_SHARE = 0.4
"""Fraction of points over two radii off their axis from which a scan shows leaves, not branches. Of
eleven bare scans, most with noise as large as their radii, it is at most 0.30; of leaves 0.48 and
0.73.
"""

_COARSE = 1.5  # local radii between the nodes of the first fit
_NOISY = 0.2  # fraction of the median radius
_ROUNDS_NOISY, _ROUNDS_LATE = 18, 6  # rounds of the last fit


@dataclass(frozen=True)
class Repaired:
    """A skeleton between two passes, and the state that they use.

    Attributes:
        skeleton: Its current state.
        points: The scan, thinned [m], shape [m, 3].
        radius_limits: Least and largest radius [m].
        view: The depth camera's view of the points, if they are one's.
        rays: The points are one sensor's, evenly spaced across its sight and scattered along it.
        fit: The last fit.
        pinched: Start of the first fit, where only one side of wood was seen: it may make a stem
            far too thin.
        duplicates: Number of duplicate axes that the last search dropped.
        pruned: Number of twigs dropped.
        progress: Called during a fit.
        apart: How far apart the points are; None: not known yet.
    """

    skeleton: Skeleton
    points: np.ndarray
    radius_limits: tuple[float, float]
    view: View | None = None
    rays: bool = False
    fit: AxisFit | None = None
    pinched: Skeleton | None = None
    duplicates: int = 0
    pruned: int = 0
    progress: Progress = SILENT
    apart: PointSpacing | None = None

    def of(self, skeleton: Skeleton) -> "Repaired":
        """The same with another skeleton."""
        return replace(self, skeleton=skeleton)

    def fitted(self, first: Skeleton, **how: Any) -> "Repaired":
        """The same after a fit that starts from ``first``."""
        fit = fit_axes(first, self.points, along_sight=self.view is not None,
                       progress=self.progress, **how)
        if self.rays:
            fit = fit_of_rays(fit, self.points, certain=True, view=self.view) or fit
        return replace(self, fit=fit, skeleton=fit.skeleton)

    def sampled(self, skeleton: Skeleton, spacing: float = 1.0) -> Skeleton:
        """A skeleton with nodes ``spacing`` local radii apart, where there are points for each."""
        apart = self.apart or PointSpacing.of(self.points)
        return resampled(skeleton, spacing, apart.at(skeleton.nodes))

    @property
    def noise(self) -> float:
        """Standard deviation of the points [m], as the last fit has it."""
        return self.last_fit.noise

    @property
    def off_axis_fraction(self) -> float:
        """Fraction of points farther off their axis than twice its radius, as on leaves."""
        fit = self.last_fit
        return float(np.mean(fit.residual > fit.skeleton.radius[fit.segment]))

    @property
    def last_fit(self) -> AxisFit:
        """The last fit, once there is one."""
        assert self.fit is not None, "the first fit must run before its results are used"
        return self.fit


@dataclass(frozen=True)
class Pass:
    """One repair.

    Attributes:
        name: Its name, for tests and developers.
        repairs: The fault that it repairs, a sentence.
        run: The repair.
        until: Fraction of all passes' work that is done after it; None: it takes hardly any time.
    """

    name: str
    repairs: str
    run: Callable[[Repaired], Repaired]
    until: float | None = None


def _fit_coarsely(now: Repaired) -> Repaired:
    after = now.fitted(now.sampled(now.skeleton, _COARSE), uncertainty=False)
    by_rays = fit_of_rays(after.last_fit, now.points, now.view is not None, now.view)
    if by_rays is not None:
        return replace(after, rays=True, fit=by_rays, skeleton=by_rays.skeleton)
    # For leaves too, unpinched radii would make thick stems that seem to have no leaves.
    may_be = after.last_fit.seen.one_sided and after.off_axis_fraction <= LEAF_SHARE
    return replace(after, pinched=now.skeleton if may_be else None)


def _fit_unpinched(now: Repaired) -> Repaired:
    if now.pinched is None:
        return now
    return now.fitted(now.sampled(unpinched(now.pinched, now.points), _COARSE), uncertainty=False)


def _prune_spurs(now: Repaired) -> Repaired:
    # Noise makes a carrier look thicker, and its outliers look like twigs.
    reach = now.skeleton.radius + 2 * now.noise
    keep, count = prune_spurs(now.skeleton.nodes, now.skeleton.parent, reach, SPUR_REACH)
    return replace(now, skeleton=now.skeleton.subset(keep), pruned=now.pruned + count)


def _drop_duplicate_axes(now: Repaired) -> Repaired:
    skeleton, count = without_duplicate_axes(now.skeleton)
    return replace(now, skeleton=skeleton, duplicates=count, pruned=now.pruned + count)


def _settle(now: Repaired) -> Repaired:
    # Noise leaves little information per round.
    noisy = now.noise > _NOISY * float(np.median(now.skeleton.radius))
    rounds = _ROUNDS_NOISY if noisy else _ROUNDS_LATE if now.duplicates else 0
    return now.fitted(now.skeleton, rounds=rounds, settled=noisy and not now.duplicates,
                      seen=now.last_fit.seen)


def _mend_kinks(now: Repaired) -> Repaired:
    skeleton, count = without_kinks(now.skeleton)
    # Where a folded end carried the run's number, the runs are others now: so is what they state.
    return now.of(doubted(skeleton, now.points, now.noise) if count else skeleton)


STEADY = Pass("steady radii", "Where points are missing, a first radius is far too small.",
              lambda now: now.of(steadied(now.skeleton, now.points)))
DROP_BARE_ENDS = Pass("drop bare ends",
                      "The contraction overshoots an end, beyond the last points.",
                      lambda now: now.of(without_bare_ends(now.skeleton, now.points)))
DROP_DUPLICATE_AXES = Pass("drop duplicate axes",
                           "Where a scan has holes, one branch has two parallel axes.",
                           _drop_duplicate_axes)
LIMIT = Pass("limit radii", "A radius is outside the range for a cloud of this size.",
             lambda now: now.of(limited(now.skeleton, *now.radius_limits)))

PASSES = (
    STEADY,
    Pass("fit coarsely", "The contracted axes lie beside the axes that the points show.",
         _fit_coarsely, until=0.4),
    Pass("fit unpinched",
         "Where most of a stem is hidden, the fit to the visible strip is far too thin.",
         _fit_unpinched, until=0.5),
    Pass("attach twigs", "The contraction pulls a fork towards its twig.",
         lambda now: now.of(attached(now.skeleton))),
    DROP_BARE_ENDS,
    Pass("lengthen ends", "The contraction shortens an end.",
         lambda now: now.of(with_full_tips(now.skeleton, now.points, now.noise))),
    Pass("prune spurs", "A twig hardly extends beyond its parent and the noise.", _prune_spurs),
    DROP_DUPLICATE_AXES,
    STEADY,
    Pass("unpinch radii", "Where only a strip of a stem is visible, the radius is far too small.",
         lambda now: now if now.pinched is None else now.of(unpinched(now.skeleton, now.points))),
    LIMIT,
    Pass("separate fused forks", "Two limbs side by side have one axis, up to a fork too far out.",
         lambda now: now.of(separate_fused_forks(now.skeleton, now.points, now.noise)[0])),
    Pass("split limbs", "Two limbs side by side have one axis up to their tips.",
         lambda now: now.of(with_split_limbs(now.skeleton, now.points, now.noise)[0])),
    Pass("fit finely",
         "Axes and radii come from too few nodes, and from forks that have moved since.",
         lambda now: now.fitted(now.sampled(now.skeleton), uncertainty=False), until=0.8),
    DROP_DUPLICATE_AXES,
    Pass("settle", "Noise, or a duplicate axis that was just dropped, leaves the fit unfinished.",
         _settle, until=1.0),
    DROP_BARE_ENDS,
    Pass("draw ends back", "A fit moves an end along its axis beyond the points.",
         lambda now: now.of(ends_within(now.skeleton, now.points))),
    LIMIT,
    Pass("find the likeliest axes and radii",
         "A radius that few points, the spacing or the noise determine, or that no wood has, is "
         "treated as measured.",
         lambda now: now.of(assessed(
             now.skeleton, now.points, now.noise, rays=now.rays,
             one_sided=now.last_fit.seen.one_sided, view=now.view))),
    Pass("mend kinks", "A branch turns more sharply than wood does.", _mend_kinks),
)
"""In the order in which they run; some run again after a fit."""


def repaired(skeleton: Skeleton, points: np.ndarray, radius_limits: tuple[float, float],
             view: View | None, progress: Progress = SILENT) -> Repaired:
    """Run all passes on the skeleton of the contracted points.

    Args:
        skeleton: With first radii.
        points: The scan, thinned [m], shape [m, 3].
        radius_limits: Least and largest radius [m].
        view: The depth camera's view of the points, if they are one's.
        progress: Called during fits.
    """
    now = Repaired(skeleton, points, radius_limits, view, apart=PointSpacing.of(points))
    done = 0.0
    for each in PASSES:
        until = done if each.until is None else each.until
        now = each.run(replace(now, progress=progress.part(done, until)))
        done = until
    return now
