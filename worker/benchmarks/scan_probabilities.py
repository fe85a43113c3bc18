"""Fits the probabilities that skeletons state to the outcomes on scans with truth.

``python -m benchmarks.scan_probabilities --first SEED --count N --out DIR`` reconstructs N scans of
each kind of the bench `scans` and of the worlds with no twig dropped, keeps the skeletons in DIR (a
stopped run continues), and fits the logistic models of twigs, nodes and bridges: by likelihood,
slopes held to their sign and weakly to 0. Each source in turn is left out of the fit, and what the
fit says of it is compared with the outcome, in tenths of the stated probability.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from benchmarks.scan_cases import KINDS, ScanCase
from benchmarks.scan_scores import Dense, bridges_right, doubled, fork_matches, seen_part
from benchmarks.trials import Budget, Trial, go_on, sound
from benchmarks.worlds.sources import BARE_VIEWS, SOURCES, WORLDS
from limber.core.errors import LimberError
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.cloud.preparation import prepare
from limber.geometry.io.skeletons import read_cylinders, write_cylinders
from limber.geometry.leaf_removal import without_leaves
from limber.geometry.reconstruction import seen_skeleton
from limber.geometry.settings import ReconstructSettings
from limber.geometry.skeleton.confidence import PLACED, evidence
from limber.geometry.skeleton.joining import bridge_evidence
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.skeleton.skeletonise import skeletonise

SIGNS = {"twigs": (1,), "nodes": (-1, -1, -1), "bridges": (1, -1, -1)}
MOST = {"twigs": PLACED}
"""Most of what is said; 1 for those not named."""
OWN = "own"
"""Source of the kinds of the project's own generator."""
_RIDGE = 0.002  # of a slope's square, against the mean loss: weak
_FIT_KINDS = (*(kind for kind in KINDS if kind != "leafy"), *(
    f"{source}:{view}" for view in BARE_VIEWS for source in SOURCES))


@dataclass
class Outcomes:
    """Evidence [k, columns], outcome [k] and source [k] of twigs, nodes or bridges."""

    evidence: list[np.ndarray] = field(default_factory=list)
    there: list[np.ndarray] = field(default_factory=list)
    source: list[str] = field(default_factory=list)

    def add(self, evidence: np.ndarray, there: np.ndarray, source: str) -> None:
        self.evidence.append(evidence)
        self.there.append(there)
        self.source += [source] * len(there)


def skeletonised(case: ScanCase) -> tuple[Skeleton, float, float, list[dict]]:
    """The skeleton of a case in its file's frame, with no twig dropped; the noise [m], the root's
    probability, and the bridges.
    """
    settings = ReconstructSettings(**case.settings)
    up = np.array(settings.up, float)
    prepared = prepare(Cloud(case.points), 1.0, settings, up=up)
    if case.leaf is not None:
        prepared, _ = without_leaves(prepared)
    found = skeletonise(prepared.cloud.points, settings, up=up, view=prepared.view,
                        twig_probability=0.0)
    if prepared.view is not None:
        found, _ = seen_skeleton(found, prepared)
    found = found.moved(lambda points: points + prepared.origin)
    return found.skeleton, found.noise, found.root_probability, found.bridges


def _collected(task: tuple[str, int], out: Path) -> dict[str, Any]:
    """Evidence of one case besides its skeleton, which is in ``KIND_SEED.csv``."""
    skeleton, noise, _, bridges = skeletonised((KINDS | WORLDS)[task[0]](task[1]))
    write_cylinders(skeleton, _file(task, out))
    return {"noise": noise, "bridges": bridges}


def _file(task: tuple[str, int], out: Path) -> Path:
    return out / f"{task[0].replace(':', '_')}_{task[1]}.csv"


def outcomes(done: list[Trial], out: Path) -> dict[str, Outcomes]:
    """Evidence of each twig, of places on them and of bridges, and the outcomes."""
    told = {name: Outcomes() for name in SIGNS}
    for one in sound(done):
        kind, seed = one.task
        case = (KINDS | WORLDS)[kind](seed)
        source = kind.split(":")[0] if ":" in kind else OWN
        found, truth = read_cylinders(_file(one.task, out)), seen_part(case.truth, case.points)
        twig, node = evidence(found, case.points, one["noise"])
        there, near_true, high = _there(truth, found)
        told["twigs"].add(twig[1:], there[1:], source)
        held = there[found.branch[high]]  # a node's own odds are those on a run that is there
        told["nodes"].add(node[high[held]], near_true[held], source)
        told["bridges"].add(np.array([bridge_evidence(*(bridge[name] for name in (
            "price", "length", "thickness", "rival_price"))) for bridge in one["bridges"]]).reshape(
                -1, 3), bridges_right(one["bridges"], truth), source)
    return told


def _there(truth: Skeleton, found: Skeleton) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which runs are there; for places on the axes, whether they are in true wood, and where."""
    there = np.concatenate([[True], fork_matches(truth, found)[1]])
    places, here = Dense.of(truth), Dense.of(found)
    away, near = cKDTree(places.points).query(here.points)
    inside = (away < np.maximum(places.radius[near], 0.001)) & ~doubled(found, here, near)
    return there, inside[::5], here.high[::5]


def fitted(evidence_rows: np.ndarray, there: np.ndarray, signs: tuple[int, ...],
           most: float = 1.0) -> np.ndarray:
    """Constant and slopes of a logistic function, times ``most``, with the least mean loss."""
    system = np.column_stack([np.ones(len(there)), evidence_rows])

    def loss(odds: np.ndarray) -> tuple[float, np.ndarray]:
        share = _share(system @ odds)
        stated = np.clip(most * share, 1e-12, 1 - 1e-12)
        slope = np.where(there, share - 1, most * share * (1 - share) / (1 - stated))
        value = -np.log(np.where(there, stated, 1 - stated)).mean() + _RIDGE * float(
            odds[1:] @ odds[1:]) / len(odds)
        return value, system.T @ slope / len(there) + 2 * _RIDGE / len(odds) * np.r_[0, odds[1:]]

    bounds = [(None, None), *((0, None) if sign > 0 else (None, 0) for sign in signs)]
    return minimize(loss, np.zeros(system.shape[1]), jac=True, bounds=bounds, method="L-BFGS-B").x


def _share(odds: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(np.clip(-odds, -500, 500)))


def bins(stated: np.ndarray, there: np.ndarray) -> str:
    """For each tenth of the stated probability: stated mean, actual mean, and count."""
    place = np.minimum((10 * stated).astype(int), 9)
    return "; ".join(
        f"{k / 10:.1f}: said {100 * stated[place == k].mean():.0f}, were "
        f"{100 * there[place == k].mean():.0f} of {int((place == k).sum())}"
        for k in np.unique(place))


def tell(name: str, told: Outcomes, left_out: Sequence[str]) -> None:
    """Print the coefficients, and the accuracy of fits without a source on that source."""
    rows, there = np.vstack(told.evidence), np.concatenate(told.there)
    source = np.array(told.source)
    signs, most = SIGNS[name], MOST.get(name, 1.0)
    inside = ~np.isin(source, left_out)
    odds = fitted(rows[inside], there[inside], signs, most)
    print(f"{name}: {inside.sum()}, {100 * there[inside].mean():.1f} % there; odds "
          f"({', '.join(f'{value:.2f}' for value in odds)})")
    every = np.zeros(len(there))
    for one in np.unique(source):
        own = source == one
        fit = odds if one in left_out else fitted(rows[inside & ~own], there[inside & ~own], signs,
                                                  most)
        every[own] = most * _share(fit[0] + rows[own] @ fit[1:])
        print(f"  {one}, left out: {bins(every[own], there[own])}")
    print(f"  all, each left out: {bins(every, there)}")


def main(arguments: list[str] | None = None) -> int:
    """Collect, fit and print."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--first", type=int, required=True, help="first seed of each kind")
    parser.add_argument("--count", type=int, default=20, help="seeds of each kind")
    parser.add_argument("--out", type=Path, required=True, help="folder for the skeletons")
    parser.add_argument("--left-out", nargs="+", default=["weber-penn"],
                        help="sources that the printed coefficients are not fitted to")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    tasks = [(kind, seed) for seed in range(options.first, options.first + options.count)
             for kind in _FIT_KINDS]
    done = go_on("skeletons", tasks, partial(_collected, out=options.out), ("geometry",),
                 options.out / "trials.jsonl", Budget(600.0), catch=LimberError)
    for name, told in outcomes(done, options.out).items():
        tell(name, told, options.left_out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
