"""Result of the search for a skeleton: the skeleton and the report on it."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from limber.geometry.skeleton.alternatives import SearchDoubts
from limber.geometry.skeleton.confidence import shares
from limber.geometry.skeleton.contraction.laplacian_contraction import (
    Contraction,
    ContractionStatus,
)
from limber.geometry.skeleton.plausibility import Where, warnings
from limber.geometry.skeleton.radii.cylinders import nearest_cylinders
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.skeleton.totals import totals

_PLACES = ("from", "to", "at", "rival_from", "rival_to")  # positions in the report's entries


@dataclass(frozen=True)
class SkeletonResult:
    """A skeleton, and the report on its search.

    Attributes:
        skeleton: Axes and radii [m] in the cloud's frame.
        contraction: Contracted points and history.
        node_of_point: Skeleton node of each point, shape [m].
        residual: Distance of each point from its cylinder [m], shape [m].
        noise: Robust standard deviation of the residuals [m].
        bridges: Gaps closed, as in
            :class:`~limber.geometry.skeleton.contraction.curve_graph.CurveGraph`.
        split_off: Discarded pieces: ``points``, ``distance`` [m], ``at``.
        loops: Lengths [m] of closed loops that were opened.
        pruned: Number of spurs pruned.
        second_base: Position where the plant seems to reach the ground a second time [m], shape
        [3].
        root_ends: The likeliest ends, as in
            :class:`~limber.geometry.skeleton.contraction.root_end.RootChoice`.
        unlikely: Dropped twigs, more likely absent than not, as
            :func:`~limber.geometry.skeleton.confidence.likely` returns them.
        leafy: Most points were on no cylinder, and axes were placed in the middle of leaves.
    """

    skeleton: Skeleton
    contraction: Contraction
    node_of_point: np.ndarray
    residual: np.ndarray
    noise: float
    bridges: list[dict] = field(default_factory=list)
    split_off: list[dict] = field(default_factory=list)
    loops: list[float] = field(default_factory=list)
    pruned: int = 0
    second_base: np.ndarray | None = None
    root_ends: list[dict] = field(default_factory=list)
    leafy: bool = False
    unlikely: list[dict] = field(default_factory=list)

    @property
    def root_probability(self) -> float:
        """That the chosen end is the root, among all ends; 1 if the user stated it."""
        return self.root_ends[0]["probability"] if self.root_ends else 1.0

    @property
    def other_root(self) -> np.ndarray | None:
        """The next likely end [m], shape [3]; None where the root is sure."""
        return self.root_ends[1]["at"] if len(self.root_ends) > 1 else None

    @property
    def warnings(self) -> list[str]:
        """Warnings for the user, with positions in the cloud's frame."""
        return self.warnings_at(lambda place: place)

    def warnings_at(self, where: Where) -> list[str]:
        """Warnings for the user, with positions transformed by ``where`` to other coordinates."""
        return warnings(self, where)

    @property
    def doubts(self) -> SearchDoubts:
        """What the search left open."""
        return SearchDoubts(self.bridges, self.unlikely, self.other_root, self.root_probability)

    def moved(self, move: Callable[[np.ndarray], np.ndarray]) -> "SkeletonResult":
        """Return the result in another frame; ``move`` transforms points [n, 3] to it."""
        bridges, split_off, unlikely, ends = (
            [part | {name: move(part[name][None])[0] for name in _PLACES
                     if part.get(name) is not None} for part in parts]
            for parts in (self.bridges, self.split_off, self.unlikely, self.root_ends))
        base = None if self.second_base is None else move(self.second_base[None])[0]
        return replace(self, skeleton=self.skeleton.moved(move(self.skeleton.nodes)),
                       bridges=bridges, split_off=split_off, unlikely=unlikely, second_base=base,
                       root_ends=ends)

    def report(self) -> dict[str, Any]:
        """Numbers for the stage's result."""
        return totals(self.skeleton, self.doubts) | {
                "contraction_iterations": self.contraction.iterations,
                "contraction_status": self.contraction.status, "noise_m": self.noise,
                "bridges": self.bridges, "length_shares": shares(self.skeleton),
                "doubtful_run_count": len({int(run) for run in self.skeleton.branch[
                    self.skeleton.probability < 0.5]}), "split_off": self.split_off,
                "unlikely_twigs": self.unlikely, "root_ends": self.root_ends,
                "other_root": self.other_root,
                "root_probability": self.root_probability,
                "loop_lengths_m": self.loops, "pruned_spur_count": self.pruned}


def result_of_skeleton(skeleton: Skeleton, points: np.ndarray) -> SkeletonResult:
    """Wrap a user's own skeleton, in the cloud's frame; it is not changed."""
    segment, residual = nearest_cylinders(skeleton, points)
    noise = float(1.4826 * np.median(np.abs(residual - np.median(residual))))
    nothing = Contraction(points[:0], np.empty(0), 0, ContractionStatus.given)
    return SkeletonResult(skeleton, nothing, segment, residual, noise)
