"""Trains the classifier of leaf points, and measures it on each source that it was not trained on.

``python -m benchmarks.leaf_training --out DIR`` makes scans of each kind, in leaf and bare, keeps
their features in DIR (a stopped run continues), writes the trees of
:mod:`limber.geometry.cloud.leaves`, trained on all sources but those left out, and prints which
leaves are found in these. With other sources left out than Limber's it writes nothing. It needs
scikit-learn, which Limber itself does not; with 1.9 and no options it makes the trees of this
version, to the byte.
"""

import argparse
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.scan_cases import KINDS, ScanCase
from benchmarks.scan_probabilities import OWN
from benchmarks.worlds.sensors import ALL_AROUND, ONE_SIDED, Scene, strewn
from benchmarks.worlds.sources import SOURCES, WORLDS
from limber.geometry.cloud.cloud import Cloud, OwnFrame, thinned
from limber.geometry.cloud.leaves import TREES, find_leaves, in_context, point_spacing, surroundings
from limber.geometry.cloud.preparation import prepare
from limber.geometry.leaf_removal import leaf_mask
from limber.geometry.settings import ReconstructSettings
from limber.geometry.skeleton.skeletonise import FIT_POINT_LIMIT

_TREES, _LEAVES, _RATE, _LEAST = 50, 20, 0.2, 50  # number, ends, learning rate, points of an end
_SEEDS = range(9100, 9108)
_MOST, _SPARSE = 3000, 300  # most points of a scan that are learnt from; fewest of a thinned one
LEFT_OUT = ("weber-penn", "dichotomous")
"""Sources that the odds of Limber do not know."""


def like_leaves(seed: int, source: str, flat: bool) -> ScanCase:
    """A bare plant that looks like leaves: its twigs grow beside each other, as on a trellis, or
    are thinner than the noise and as close as the points."""
    rng = np.random.default_rng([seed, *source.encode()])
    plant = SOURCES[source](rng)
    plant = replace(plant, nodes=plant.nodes * [1.0, rng.uniform(0.0, 0.1) if flat else 1.0, 1.0])
    seen = (rng.choice((*ONE_SIDED, *ALL_AROUND)) if flat else strewn)(
        Scene.bare(plant), rng, 0.001 if flat else 0.001 * 5**rng.uniform())
    return ScanCase(source, seed, plant.skeleton, seen.points)


_CASES = WORLDS | {kind: KINDS[kind] for kind in ("leafy", "2-mm")} | {
    f"{source}:{kind}": partial(like_leaves, source=source, flat=kind == "flat")
    for kind in ("flat", "strewn") for source in SOURCES}


@dataclass(frozen=True)
class Labelled:
    """A prepared scan: points [m], shape [n, 3], features [n, f], and which are on leaves [n]."""

    kind: str
    points: np.ndarray
    features: np.ndarray
    leaf: np.ndarray
    source: str


def labelled(kind: str, seed: int, out: Path) -> Labelled:
    """A scan of a kind, from ``out`` if it is there; a quarter of the seeds are thinned."""
    file = out / f"{kind.replace(':', '_')}_{seed}.npz"
    if not file.is_file():
        case = _CASES[kind](seed)
        settings = ReconstructSettings(**case.settings)
        prepared = prepare(Cloud(case.points), 1.0, settings, up=np.array(settings.up, float))
        points = prepared.cloud.points
        points = points[thinned(points, FIT_POINT_LIMIT)]
        if seed % 4 == 3:
            rng = np.random.default_rng([seed, *kind.encode()])
            few = _SPARSE * (len(points) / _SPARSE)**rng.uniform()
            points = rng.permutation(points)[:round(few)]
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


def exported(name: str, model: Any) -> dict[str, np.ndarray]:
    """Trees of a name as arrays, which :mod:`limber.geometry.cloud.leaves` reads."""
    stages = [stage[0].nodes for stage in model._predictors]
    nodes, counts = np.concatenate(stages), np.array(list(map(len, stages)))
    own, end = np.concatenate(list(map(np.arange, counts))), nodes["is_leaf"].astype(bool)
    return {f"{name}_{key}": value for key, value in {
        "feature": np.where(end, 0, nodes["feature_idx"]).astype(np.int16),
        "threshold": nodes["num_threshold"].astype(np.float32),
        "low": np.where(end, own, nodes["left"]).astype(np.int16),
        "high": np.where(end, own, nodes["right"]).astype(np.int16),
        "value": nodes["value"].astype(np.float32), "first": np.cumsum(counts) - counts,
        "depth": np.array([int(stage["depth"].max()) for stage in stages]),
        "start": np.float64(np.ravel(model._baseline_prediction)[0])}.items()}


def tell(scan: Labelled, odds: np.ndarray) -> None:
    """Print the shares of leaf points missed and of wood taken, by log ``odds`` [n] of a leaf."""
    found = leaf_mask(find_leaves(scan.points, odds), len(odds))
    missed = 1 - found[scan.leaf].mean() if scan.leaf.any() else 0.0
    print(f"{scan.kind}: {missed:.1%} of the leaves' points missed, "
          f"{found[~scan.leaf].mean():.1%} of the wood's taken", flush=True)


def main(arguments: list[str] | None = None) -> None:
    """Make scans, train, write the trees, and measure them on the sources left out."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder for the features")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    scans = [labelled(kind, seed, options.out) for kind in _CASES for seed in _SEEDS]
    inside = [scan for scan in scans if scan.source not in LEFT_OUT]
    shape = trained(inside)
    # Of a scan that they learnt from, trees are surer than of another.
    others = {source: trained([scan for scan in inside if scan.source != source])
              for source in {scan.source for scan in scans}}
    scans = [replace(scan, features=in_context(scan.points, scan.features, others[
        scan.source].decision_function(scan.features))) for scan in scans]
    model = trained([scan for scan in scans if scan.source not in LEFT_OUT])
    np.savez_compressed(TREES, **exported("shape", shape), **exported("context", model))
    for scan in scans:
        if scan.source in LEFT_OUT:
            tell(scan, model.decision_function(scan.features))


if __name__ == "__main__":
    main()
