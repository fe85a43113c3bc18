"""Result of the search for a skeleton: the skeleton and the report on it."""

import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from limber.core.errors import InputError, Option
from limber.core.files.reading import checked_as, json_content, read_arrays, require_shapes
from limber.core.json_values import plain
from limber.geometry.cloud.leaves import Leaf
from limber.geometry.skeleton.alternatives import SearchDoubts
from limber.geometry.skeleton.confidence import shares
from limber.geometry.skeleton.contraction import Contraction, ContractionStatus
from limber.geometry.skeleton.plausibility import warnings
from limber.geometry.skeleton.radii.fit_kernels import nearest_cylinders
from limber.geometry.skeleton.skeleton import STATES, Skeleton
from limber.geometry.skeleton.totals import totals

_PLACES = ("from", "to", "at", "rival_from", "rival_to")  # positions in the report's entries


@dataclass(frozen=True)
class SkeletonResult:
    """A skeleton in the cloud's frame, and the report on its search.

    Attributes:
        node_of_point: Skeleton node of each point, shape [m].
        residual: Distance of each point from its cylinder [m], shape [m].
        noise: Robust standard deviation of the residuals [m].
        bridges: Gaps closed, as in
            :class:`~limber.geometry.skeleton.curve_graph.CurveGraph`.
        split_off: Discarded pieces: ``points``, ``distance`` [m], ``at``.
        loops: Lengths [m] of closed loops that were opened.
        pruned: Number of spurs pruned.
        second_base: Where the plant seems to reach the ground a second time [m], shape [3].
        root_ends: The likeliest ends, as in
            :class:`~limber.geometry.skeleton.root_end.RootChoice`.
        unlikely: Dropped twigs, more likely absent than not, as
            :func:`~limber.geometry.skeleton.confidence.likely` returns them.
        leafy: Points show leaves, and axes were placed in their middle.
        length_spread: Standard deviation of the logarithm of the length of the likeliest tree of a
            thin scan, or of axes from which leaves were cut off; None of others.
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
    length_spread: float | None = None

    @property
    def root_probability(self) -> float:
        """That the chosen end is the root, among all ends; 1 if the user stated it."""
        return self.root_ends[0]["probability"] if self.root_ends else 1.0

    @property
    def warnings(self) -> list[str]:
        """Warnings for the user, with positions in the result's frame."""
        return warnings(self)

    @property
    def doubts(self) -> SearchDoubts:
        """What the search left open."""
        return SearchDoubts(self.bridges, self.unlikely, self.root_ends, self.length_spread)

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
                "root_probability": self.root_probability, "length_spread": self.length_spread,
                "loop_lengths_m": self.loops, "pruned_spur_count": self.pruned}


def result_of_skeleton(skeleton: Skeleton, points: np.ndarray) -> SkeletonResult:
    """Wrap a user's own skeleton, in the cloud's frame; it is not changed."""
    segment, residual = nearest_cylinders(skeleton, points)
    noise = float(1.4826 * np.median(np.abs(residual - np.median(residual))))
    nothing = Contraction(points[:0], np.empty(0), 0, ContractionStatus.given)
    return SkeletonResult(skeleton, nothing, segment, residual, noise)


# File of the found skeleton and its search report; a stopped run resumes from it.
#
# Every number comes back to its last bit, so that the surface and the mesh made of it are those of
# an undisturbed run.

_WHAT = "a skeleton stored by reconstruct"
_SKELETON: dict[str, tuple[int | str, ...]] = {
    "nodes": ("n", 3), "parent": ("n",), "radius": ("n",), "radius_sigma": ("n",),
    "branch": ("n",), "order": ("n",), "radius_state": ("n",), "probability": ("n",)}
_POINTS: dict[str, tuple[int | str, ...]] = {
    "node_of_point": ("m",), "residual": ("m",), "contracted": ("c", 3), "linearity": ("c",),
    "leaf_points": ("l",)}
_FARTHEST = 1e6
"""Largest length [m]; a radius is at least one over it."""
_Place = tuple[float, float, float]


@dataclass(frozen=True)
class FoundSkeleton:
    """A skeleton in the frame of the prepared cloud, from which the ``leaves`` were removed
    first."""

    result: SkeletonResult
    leaves: list[Leaf]

    def fits(self, count: int) -> bool:
        """Whether it is of a prepared cloud of ``count`` points."""
        return len(self.result.node_of_point) + sum(
            len(leaf.points) for leaf in self.leaves) == count

    def write(self, path: Path) -> None:
        """Write an NPZ file."""
        result = self.result
        values = {name: getattr(result, name) for name in (
            "noise", "bridges", "split_off", "loops", "pruned", "second_base", "root_ends",
            "leafy", "unlikely", "length_spread")} | {
            "iterations": result.contraction.iterations, "status": result.contraction.status,
            "leaves": [{"count": len(leaf.points), "area": leaf.area} for leaf in self.leaves]}
        np.savez(path, told=np.array(json.dumps(plain(values))),
                 **{name: getattr(result.skeleton, name) for name in _SKELETON},
                 node_of_point=result.node_of_point, residual=result.residual,
                 contracted=result.contraction.points, linearity=result.contraction.linearity,
                 leaf_points=np.concatenate([np.zeros(0, np.int64), *(
                     leaf.points for leaf in self.leaves)]))

    @classmethod
    def read(cls, path: Path) -> "FoundSkeleton":
        """Read a file that :meth:`write` has written; InputError if it is damaged."""
        arrays = read_arrays(path, _WHAT)
        require_shapes(path, arrays, _SKELETON | _POINTS, _WHAT)
        skeleton = Skeleton(**dict[str, Any]({name: arrays[name] for name in _SKELETON}))
        stored = _stored(path, arrays)
        if not _is_tree(skeleton.parent) or not _are_below(
                arrays["node_of_point"], skeleton.node_count):
            raise _damaged(path, "Its nodes do not form a tree.")
        if not _are_runs(skeleton):
            raise _damaged(path, "Its nodes are not on unforked runs.")
        if not _is_possible(skeleton):
            raise _damaged(path, "Its axes have an impossible length, thickness or probability.")
        contraction = Contraction(arrays["contracted"], arrays["linearity"], stored.iterations,
                                  stored.status)
        return cls(SkeletonResult(
            skeleton, contraction, arrays["node_of_point"], arrays["residual"], stored.noise,
            [bridge.found() for bridge in stored.bridges],
            [piece.found() for piece in stored.split_off], stored.loops, stored.pruned,
            None if (base := stored.second_base) is None else np.array(base),
            [end.found() for end in stored.root_ends],
            stored.leafy, [twig.found() for twig in stored.unlikely], stored.length_spread),
                   _leaves(path, arrays, stored))


class _Part(BaseModel):
    """Return an entry of the search report as a dict of numbers and positions."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    def found(self) -> dict[str, Any]:
        return {name: np.array(value) if isinstance(value, tuple) else value
                for name, value in self.model_dump(by_alias=True, exclude_unset=True).items()}


class _Bridge(_Part):
    start: _Place = Field(alias="from")
    to: _Place
    length: float
    price: float
    thickness: float | None = None
    probability: float | None = Field(None, ge=0, le=1)
    rival_from: _Place | None = None
    rival_to: _Place | None = None
    rival_price: float | None = None


class _Piece(_Part):
    points: int
    distance: float
    at: _Place


class _Twig(_Part):
    start: _Place | None = Field(None, alias="from")
    radius: float | None = Field(None, gt=0)
    length: float
    at: _Place
    probability: float


class _End(_Part):
    at: _Place
    probability: float = Field(ge=0, le=1)


class _Leaf(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    count: int = Field(ge=1)
    area: float


class _Stored(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    noise: float
    bridges: list[_Bridge]
    split_off: list[_Piece]
    loops: list[float]
    pruned: int
    second_base: _Place | None
    root_ends: list[_End]
    leafy: bool
    unlikely: list[_Twig]
    length_spread: float | None
    iterations: int
    status: ContractionStatus
    leaves: list[_Leaf]


def _stored(path: Path, arrays: dict[str, np.ndarray]) -> _Stored:
    text = arrays.get("told", np.zeros(0))
    if text.dtype.kind != "U" or text.ndim != 0:
        raise _damaged(path, "The report of the search is missing.")
    return checked_as(path, _Stored, json_content(str(text), path, _WHAT), _WHAT, strict=True)


def _leaves(path: Path, arrays: dict[str, np.ndarray], stored: _Stored) -> list[Leaf]:
    points = arrays["leaf_points"]
    ends = np.cumsum([leaf.count for leaf in stored.leaves], dtype=np.int64)
    total = int(ends[-1]) if len(ends) else 0
    if len(points) != total or len(np.unique(points)) != total or not _are_below(
            points, len(arrays["node_of_point"]) + total):
        raise _damaged(path, "Its leaves are not part of the scan.")
    return [Leaf(own, leaf.area) for own, leaf in zip(
        np.split(points, ends[:-1]), stored.leaves, strict=True)] if total else []


def _is_tree(parent: np.ndarray) -> bool:
    """Whether the first node is the root and every other node follows its parent."""
    return (parent.dtype.kind == "i" and len(parent) > 1 and parent[0] == -1
            and bool(((parent[1:] >= 0) & (parent[1:] < np.arange(1, len(parent)))).all()))


def _are_runs(skeleton: Skeleton) -> bool:
    """Whether each run is a chain of nodes, and the first of it is the root or forks off another.
    """
    branch, parent = skeleton.branch, skeleton.parent
    if branch.dtype.kind != "i" or skeleton.order.dtype.kind != "i":
        return False
    found, first = np.unique(branch, return_index=True)
    if not np.array_equal(found, np.arange(len(found))):
        return False
    # The node before, in the same run; every node but the first of a run has it as its parent.
    by_run = np.argsort(branch, kind="stable")
    before = np.empty(len(branch), np.int64)
    before[by_run[1:]] = by_run[:-1]
    before[first] = parent[first]
    return bool((parent == before).all() and (branch[parent[first[1:]]] != found[1:]).all()
                and branch[0] == 0 and (branch == 0).sum() > 1 and (skeleton.order >= 0).all())


def _is_possible(skeleton: Skeleton) -> bool:
    """Whether lengths [m], radii [m] with their deviations, and probabilities make sense."""
    radius, sigma, probability = skeleton.radius, skeleton.radius_sigma, skeleton.probability
    return bool(((radius >= 1 / _FARTHEST) & (radius <= _FARTHEST)).all()
                and ((sigma >= 0) & (sigma <= _FARTHEST)).all()
                and ((probability >= 0) & (probability <= 1)).all()
                and (np.abs(skeleton.nodes) <= _FARTHEST).all() and skeleton.length > 0
                and np.isin(skeleton.radius_state, list(STATES.values())).all())


def _are_below(index: np.ndarray, count: int) -> bool:
    return index.dtype.kind == "i" and bool(((index >= 0) & (index < count)).all())


def _damaged(path: Path, why: str) -> InputError:
    return InputError(f"{path} cannot be used.", why, "Reconstruct again with ",
                      Option("force", True), ".")
