"""Trains the classifier of leaf points, and measures it on each source that it was not trained on.

``python -m benchmarks.leaf_training --out DIR`` makes scans of each kind, in leaf and bare, keeps
their features in DIR (a stopped run continues), writes the trees of
:mod:`limber.geometry.cloud.leaves`, trained on all sources but those left out, and prints which
leaves are found in these. With other sources left out than Limber's it writes nothing. It needs
scikit-learn, which Limber itself does not; with 1.9 and no options it makes the trees of this
version, to the byte.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.scan_cases import KINDS
from benchmarks.scan_probabilities import OWN
from benchmarks.worlds.sources import BARE_VIEWS, SOURCES, WORLDS
from limber.geometry.cloud.cloud import Cloud, OwnFrame, thinned
from limber.geometry.cloud.leaves import TREES, leaves_by_odds, point_spacing, surroundings
from limber.geometry.cloud.preparation import prepare
from limber.geometry.leaf_removal import leaf_mask
from limber.geometry.settings import ReconstructSettings
from limber.geometry.skeleton.skeletonise import FIT_POINT_LIMIT

_KINDS = (*(f"{source}:leafy" for source in SOURCES), "leafy",
          *(f"{source}:{view}" for view in BARE_VIEWS for source in SOURCES), "2-mm")
_TREES, _LEAVES, _RATE, _LEAST = 50, 20, 0.2, 50  # number, ends, learning rate, points of an end
_MOST = 1500  # points of a scan that are learnt from
LEFT_OUT = ("weber-penn", "dichotomous")
"""Sources that the odds of Limber do not know."""


@dataclass(frozen=True)
class Labelled:
    """A prepared scan: points [m], shape [n, 3], features [n, f], and which are on leaves [n]."""

    kind: str
    points: np.ndarray
    features: np.ndarray
    leaf: np.ndarray
    source: str


def labelled(kind: str, seed: int, out: Path) -> Labelled:
    """A scan of a kind, from ``out`` if it is there."""
    file = out / f"{kind.replace(':', '_')}_{seed}.npz"
    if not file.is_file():
        case = (KINDS | WORLDS)[kind](seed)
        settings = ReconstructSettings(**case.settings)
        prepared = prepare(Cloud(case.points), 1.0, settings, up=np.array(settings.up, float))
        points = prepared.cloud.points
        points = points[thinned(points, FIT_POINT_LIMIT)]
        own = OwnFrame.of(points)
        points = points[own.order]
        truth = np.zeros(len(case.points), bool) if case.leaf is None else case.leaf
        leaf = truth[cKDTree(case.points).query(points + prepared.origin)[1]]
        np.savez_compressed(file, points=points, leaf=leaf, features=surroundings(
            own.coordinates, point_spacing(own.coordinates)))
    with np.load(file) as kept:
        return Labelled(kind, kept["points"], kept["features"], kept["leaf"],
                        kind.split(":", maxsplit=1)[0] if ":" in kind else OWN)


def trained(scans: list[Labelled]) -> Any:
    """A gradient-boosted classifier, learnt from as many points of each scan."""
    from sklearn.ensemble import HistGradientBoostingClassifier

    rng = np.random.default_rng(0)
    chosen = [rng.choice(len(scan.leaf), min(_MOST, len(scan.leaf)), replace=False)
              for scan in scans]
    model = HistGradientBoostingClassifier(
        max_iter=_TREES, learning_rate=_RATE, max_leaf_nodes=_LEAVES, min_samples_leaf=_LEAST,
        l2_regularization=1.0, early_stopping=False)
    return model.fit(
        np.vstack([scan.features[rows] for scan, rows in zip(scans, chosen, strict=True)]),
        np.concatenate([scan.leaf[rows] for scan, rows in zip(scans, chosen, strict=True)]))


def exported(model: Any) -> dict[str, np.ndarray]:
    """The trees as arrays, which :mod:`limber.geometry.cloud.leaves` reads."""
    stages = [stage[0].nodes for stage in model._predictors]
    nodes, counts = np.concatenate(stages), np.array(list(map(len, stages)))
    own, end = np.concatenate(list(map(np.arange, counts))), nodes["is_leaf"].astype(bool)
    return {"feature": np.where(end, 0, nodes["feature_idx"]).astype(np.int16),
            "threshold": nodes["num_threshold"].astype(np.float32),
            "low": np.where(end, own, nodes["left"]).astype(np.int16),
            "high": np.where(end, own, nodes["right"]).astype(np.int16),
            "value": nodes["value"].astype(np.float32), "first": np.cumsum(counts) - counts,
            "depth": np.array([int(stage["depth"].max()) for stage in stages]),
            "start": np.float64(_prior(model))}


def _prior(model: Any) -> float:
    return float(np.ravel(model._baseline_prediction)[0])


def tell(scan: Labelled, model: Any) -> None:
    """Print the shares of leaf points missed and of wood taken by a classifier."""
    odds = model.decision_function(scan.features)
    found = leaf_mask(leaves_by_odds(scan.points, odds, point_spacing(scan.points), _prior(model)),
                      len(odds))
    missed = 1 - found[scan.leaf].mean() if scan.leaf.any() else 0.0
    print(f"{scan.kind}: {missed:.1%} of the leaves' points missed, "
          f"{found[~scan.leaf].mean():.1%} of the wood's taken", flush=True)


def main(arguments: list[str] | None = None) -> None:
    """Make scans, train, write the trees, and measure them on the sources left out."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--first", type=int, default=9100, help="first seed of each kind")
    parser.add_argument("--count", type=int, default=3, help="seeds of each kind")
    parser.add_argument("--out", type=Path, required=True, help="folder for the features")
    parser.add_argument("--left-out", nargs="+", default=LEFT_OUT)
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    scans = [labelled(kind, seed, options.out) for kind in _KINDS
             for seed in range(options.first, options.first + options.count)]
    model = trained([scan for scan in scans if scan.source not in options.left_out])
    if tuple(options.left_out) == LEFT_OUT:
        np.savez_compressed(TREES, **exported(model))
    for scan in scans:
        if scan.source in options.left_out:
            tell(scan, model)


if __name__ == "__main__":
    main()
