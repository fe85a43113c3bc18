"""Fits the probabilities that skeletons state to the outcomes on generated scans with truth.

``python -m benchmarks.scan_probabilities --first SEED --count N --out DIR`` reconstructs N scans of
each kind of the bench `scans` with no twig dropped, keeps the skeletons in DIR (a stopped run
continues), and fits the logistic coefficients of :mod:`limber.geometry.skeleton.confidence`: by
likelihood, slopes held to their sign and weakly to 0. The fit to each half of the scans is compared
with the other half in tenths of the stated probability, as the bench does.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from benchmarks.scan_cases import ScanCase
from benchmarks.scan_runs import KINDS, case_source
from benchmarks.scan_scores import Dense, doubled, fork_matches, seen_part
from benchmarks.trial_log import keep, read_trials
from limber.core.errors import LimberError
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.cloud.preparation import prepare
from limber.geometry.io.skeletons import read_cylinders, write_cylinders
from limber.geometry.leaf_removal import without_leaves
from limber.geometry.reconstruction import seen_skeleton
from limber.geometry.settings import ReconstructSettings
from limber.geometry.skeleton.confidence import evidence
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.skeleton.skeletonise import skeletonise

TWIG_SIGNS = (1, 1, -1, -1, -1)
NODE_SIGNS = (-1, -1, -1)
_RIDGE = 0.002  # of a slope's square, against the mean loss: weak
_FIT_KINDS = tuple(kind for kind in KINDS if kind != "leafy")


@dataclass
class Skeletonised:
    """A case's skeleton is in ``KIND_SEED.csv``; this holds the rest of its evidence."""

    kind: str
    seed: int
    source: str
    noise: float = 0.0
    failure: str = ""
    seconds: float = 0.0


@dataclass
class Outcomes:
    """Evidence and outcomes of many scans, row by row.

    Attributes:
        twig, twig_there: Evidence and outcome of side runs, shapes [k, 5] and [k].
        node, node_there, length: The same of a sample of places on runs that are there, and their
        length.
        half: 0 or 1 by the scan's seed, for twigs and nodes.
    """

    twig: list[np.ndarray] = field(default_factory=list)
    twig_there: list[np.ndarray] = field(default_factory=list)
    node: list[np.ndarray] = field(default_factory=list)
    node_there: list[np.ndarray] = field(default_factory=list)
    half: tuple[list[int], list[int]] = field(default_factory=lambda: ([], []))


def skeletonised(case: ScanCase) -> tuple[Skeleton, float]:
    """The skeleton of a case in its file's frame, with no twig dropped; and the noise [m]."""
    settings = ReconstructSettings(**case.settings, twig_probability=0.0)
    up = np.array(settings.up, float)
    prepared = prepare(Cloud(case.points), 1.0, settings, up=up)
    if case.leaf is not None:
        prepared, _ = without_leaves(prepared)
    found = skeletonise(prepared.cloud.points, settings, up=up, camera=prepared.view is not None)
    if prepared.view is not None:
        found, _ = seen_skeleton(found, prepared)
    return found.skeleton.moved(found.skeleton.nodes + prepared.origin), found.noise


def collect(first: int, count: int, out: Path, kinds: Sequence[str] = _FIT_KINDS,
            ) -> list[Skeletonised]:
    """Skeletons of ``count`` seeds of each kind, including those in ``out``."""
    kept, source = out / "skeletons.jsonl", case_source()
    known = {(one.kind, one.seed): one for one in read_trials(Skeletonised, kept)
             if one.source == source}
    done = []
    for kind in kinds:
        for seed in range(first, first + count):
            one = known.get((kind, seed))
            if one is None:
                one, began = Skeletonised(kind, seed, source), time.perf_counter()
                try:
                    skeleton, one.noise = skeletonised(KINDS[kind](seed))
                    write_cylinders(skeleton, out / f"{kind}_{seed}.csv")
                except LimberError as error:
                    one.failure = str(error)
                one.seconds = time.perf_counter() - began
                keep(one, kept)
                print(f"{kind} {seed}: {one.seconds:.1f} s {one.failure}", flush=True)
            done.append(one)
    return done


def outcomes(done: list[Skeletonised], out: Path) -> Outcomes:
    """Evidence of each twig and of places on them, and whether they are there."""
    told = Outcomes()
    for one in done:
        if one.failure:
            continue
        case = KINDS[one.kind](one.seed)
        found = read_cylinders(out / f"{one.kind}_{one.seed}.csv")
        twig, node = evidence(found, case.points, one.noise)
        there, near_true, high = _there(seen_part(case.truth, case.points), found)
        told.twig.append(twig[1:])
        told.twig_there.append(there[1:])
        held = there[found.branch[high]]  # a node's own odds are those on a run that is there
        told.node.append(node[high[held]])
        told.node_there.append(near_true[held])
        for halves, number in zip(told.half, (len(there) - 1, int(held.sum())), strict=True):
            halves += [one.seed % 2] * number
    return told


def _there(truth: Skeleton, found: Skeleton) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which runs are there; for places on the axes, whether they are in true wood, and where."""
    _, right = fork_matches(truth, found)
    true_forks = found.forks()[right]
    runs = found.runs()
    there = np.ones(len(runs), bool)
    for run, members in enumerate(runs[1:], start=1):
        there[run] = members[0] in true_forks
    places, here = Dense.of(truth), Dense.of(found)
    away, near = cKDTree(places.points).query(here.points)
    inside = (away < np.maximum(places.radius[near], 0.001)) & ~doubled(found, here, near)
    return there, inside[::5], here.high[::5]


def fitted(evidence_rows: np.ndarray, there: np.ndarray, signs: tuple[int, ...]) -> np.ndarray:
    """Constant and slopes of a logistic function with the least mean loss."""
    system = np.column_stack([np.ones(len(there)), evidence_rows])
    side = np.where(there, 1.0, -1.0)

    def loss(odds: np.ndarray) -> tuple[float, np.ndarray]:
        margin = side * (system @ odds)
        slope = -side / (1 + np.exp(np.clip(margin, -500, 500)))
        value = np.logaddexp(0, -margin).mean() + _RIDGE * float(odds[1:] @ odds[1:]) / len(odds)
        return value, system.T @ slope / len(side) + 2 * _RIDGE / len(odds) * np.r_[0, odds[1:]]

    bounds = [(None, None), *((0, None) if sign > 0 else (None, 0) for sign in signs)]
    return minimize(loss, np.zeros(system.shape[1]), jac=True, bounds=bounds, method="L-BFGS-B").x


def bins(stated: np.ndarray, there: np.ndarray) -> str:
    """For each tenth of the stated probability: stated mean, actual mean, and count."""
    place = np.minimum((10 * stated).astype(int), 9)
    return "; ".join(
        f"{k / 10:.1f}: said {100 * stated[place == k].mean():.0f}, were "
        f"{100 * there[place == k].mean():.0f} of {int((place == k).sum())}"
        for k in np.unique(place))


def tell(name: str, rows: np.ndarray, there: np.ndarray, half: np.ndarray,
         signs: tuple[int, ...]) -> None:
    """Print the coefficients, and the accuracy of the fit to one half on the other."""
    odds = fitted(rows, there, signs)
    print(f"{name}: {len(there)}, {100 * there.mean():.1f} % there; odds "
          f"({', '.join(f'{value:.2f}' for value in odds)})")
    for own in (0, 1):
        one = fitted(rows[half == own], there[half == own], signs)
        stated = 1 / (1 + np.exp(-(one[0] + rows[half != own] @ one[1:])))
        print(f"  fitted to half {own}, on the other: {bins(stated, there[half != own])}")


def main(arguments: list[str] | None = None) -> int:
    """Collect, fit and print."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--first", type=int, required=True, help="first seed of each kind")
    parser.add_argument("--count", type=int, default=20, help="seeds of each kind")
    parser.add_argument("--out", type=Path, required=True, help="folder for the skeletons")
    parser.add_argument("--kinds", nargs="+", choices=_FIT_KINDS, default=_FIT_KINDS)
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    told = outcomes(collect(options.first, options.count, options.out, options.kinds), options.out)
    for name, rows, there, half, signs in (
            ("twigs", told.twig, told.twig_there, told.half[0], TWIG_SIGNS),
            ("places", told.node, told.node_there, told.half[1], NODE_SIGNS)):
        tell(name, np.vstack(rows), np.concatenate(there), np.array(half), signs)
    return 0


if __name__ == "__main__":
    sys.exit(main())
