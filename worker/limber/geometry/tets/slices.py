"""Slices of a run: one for each of its twigs, and even ones between."""

import itertools
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from limber.geometry.tets.run_axis import RunAxis

_CLAMP_SLICES = (1.0, 3.0)  # ends of the first slices, in root radii
_SHARED = 0.5  # cosine between twigs of one slice below which they leave through different sides
_TAPERED, _THINNEST = 2.5, 0.06  # radius ratio above which rings are graded; smallest ratio


@dataclass
class Window:
    """A slice of a carrier that a twig grows out of.

    Attributes:
        run: The twig.
        low, high: Start and end of the slice along the carrier [m].
        outward: Direction in which the twig leaves, a unit vector, shape [3].
    """

    run: int
    low: float
    high: float
    outward: np.ndarray

    @classmethod
    def of(cls, axis: RunAxis, twig: RunAxis, run: int) -> "Window | None":
        """The slice of a carrier's ``axis`` that a ``twig`` leaves through; None: it stays inside.
        """
        where = np.linspace(0, twig.length, 200)
        distance, foot = axis.nearest(twig.at(where))
        out = np.flatnonzero(distance > axis.radius_at(foot))
        if len(out) == 0:
            return None
        exit_point, foot_arc = twig.at(where[out[0]]), foot[out[0]]
        outward = exit_point - axis.at(foot_arc)
        outward /= max(np.linalg.norm(outward), 1e-300)
        half = 1.25 * float(twig.radius_at(where[out[0]]))
        return cls(run, foot_arc - half, foot_arc + half, outward)


def without_overlap(windows: Iterable[Window], axis: RunAxis, start: float) -> list[Window]:
    """Move slices along an axis from ``start`` [m] so that none overlap, as little as possible.

    Twigs that leave through different sides may share a slice, as those of a whorl do.
    """
    end = axis.length + 1e-12
    slices: list[list[Window]] = []
    free = start + 0.3 * float(axis.radius_at(start))
    for window in sorted(windows, key=lambda w: w.low + w.high):
        length, middle = window.high - window.low, (window.low + window.high) / 2
        low = max(min(window.low, axis.length - length), free)
        high = min(low + length, end)
        own = abs((low + high) / 2 - middle) if low + 0.5 * length <= end else np.inf
        moves = {k: abs((one[0].low + one[0].high) / 2 - middle) for k, one in enumerate(slices)
                 if all(window.outward @ other.outward < _SHARED for other in one)}
        best = min(moves, key=moves.__getitem__, default=None)
        if best is not None and moves[best] < own:
            one = slices[best]
            one.append(Window(window.run, one[0].low, one[0].high, window.outward))
        elif np.isfinite(own):
            slices.append([Window(window.run, low, high, window.outward)])
            free = high + 0.25 * length
    return [window for one in slices for window in one]


def ring_positions(axis: RunAxis, start: float, windows: list[Window],
                   spacing: float) -> np.ndarray:
    """Positions of rings along an axis from ``start`` [m], ``spacing`` radii apart, shape [r].
    """
    fixed = sorted({round(v, 12) for w in windows for v in (w.low, w.high)})
    marks = [start, *[v for v in fixed if start < v < axis.length], axis.length]
    inside = {(round(w.low, 12), round(w.high, 12)) for w in windows}
    positions = [start]
    if start == 0.0 and len(marks) > 1:
        # Short slices at the clamp, which keeps the section from narrowing under tension: long ones
        # there made a cantilever 0.4 % too stiff, at any length elsewhere.
        near = [g * float(axis.radius[0]) for g in _CLAMP_SLICES]
        positions += [v for v in near if v + near[0] < marks[1]]
        marks[0] = positions[-1]
    for low, high in itertools.pairwise(marks):
        size = spacing * float(axis.radius_at((low + high) / 2))
        within = any(a <= low + 1e-9 and high <= b + 1e-9 for a, b in inside)
        count = 1 if within else max(round((high - low) / size), 1)
        between = np.linspace(low, high, count + 1)
        if not within and _is_tapered(axis, low, high):
            between = _graded(axis, low, high, spacing)
        positions += list(between[1:])
    if len(positions) < 3:
        positions = list(np.linspace(start, axis.length, 3))
    return np.array(positions)


def _is_tapered(axis: RunAxis, low: float, high: float) -> bool:
    radii = axis.radius_at(np.linspace(low, high, 20))
    return bool(radii.max() > _TAPERED * radii.min())


def _graded(axis: RunAxis, low: float, high: float, spacing: float) -> np.ndarray:
    """Positions of rings where the radius changes much: closer where it is thin.

    Slices sized for the middle would be needles at a thin end, which look as if folded over.
    """
    along = np.linspace(low, high, 400)
    radii = axis.radius_at(along)
    pitch = spacing * np.maximum(radii, _THINNEST * radii.max())
    rings = np.concatenate([[0.0], np.cumsum((1 / pitch[1:] + 1 / pitch[:-1]) / 2
                                             * np.diff(along))])
    count = max(round(float(rings[-1])), 1)
    return np.interp(np.linspace(0, rings[-1], count + 1), rings, along)
