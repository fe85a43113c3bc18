"""Scores skeletons of the scans in this folder: python score.py RESULTS, which has NAME.swc each.

An SWC file has a line for each node: number, type, x, y, z, radius, number of the parent (-1: the
root), in metres and in the scan's frame; with a radius of 0 only axes are scored. Wood that the
scan does not show is not in the truth. Needs numpy and scipy. This file is free of rights (CC0).
"""

import sys
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

NEAR = 0.010
"""An axis is right within this, or within the true radius where that is more [m]."""
STEP = 0.001
"""Axes are compared at points so far apart [m]."""


def read_swc(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return segments [m], shape [k, 2, 3], and their radii [m], shape [k]."""
    rows = [line.split() for line in path.read_text(encoding="utf-8").splitlines()
            if line.strip() and not line.startswith("#")]
    table = np.array([[float(field) for field in row[:7]] for row in rows])
    place = {int(number): k for k, number in enumerate(table[:, 0])}
    ends = [(place[int(row[6])], k) for k, row in enumerate(table) if int(row[6]) in place]
    low, high = np.array(ends).reshape(-1, 2).T
    return np.stack([table[low, 2:5], table[high, 2:5]], axis=1), table[high, 5]


def points_along(segments: np.ndarray, radii: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points every STEP of the segments, shape [n, 3], and their radii, shape [n]."""
    length = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    count = np.maximum(np.round(length / STEP).astype(int), 1)
    share = np.concatenate([(np.arange(n) + 0.5) / n for n in count])[:, None]
    low, high = (np.repeat(segments[:, end], count, axis=0) for end in (0, 1))
    return low + share * (high - low), np.repeat(radii, count)


def compared(true: Path, found: Path) -> dict[str, float]:
    """Return the fractions of true axes found and of found axes that are true, length and volume
    over the truth, and the median error of the radius."""
    sides = [read_swc(path) for path in (true, found)]
    (there, radius), (here, own) = (points_along(*side) for side in sides)
    length, other = (np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
                     for segments, _ in sides)
    away, place = cKDTree(there).query(here)
    right = away < np.maximum(radius[place], NEAR)
    reached = cKDTree(here).query(there)[0] < np.maximum(radius, NEAR)
    has_radii = bool(own.max() > 0) and bool(right.any())
    return {"found": float(reached.mean()), "own": float(right.mean()),
            "length": float(other.sum() / length.sum()),
            "radius": float(np.median(own[right] / radius[place][right])) - 1.0
            if has_radii else np.nan,
            "volume": float((sides[1][1] ** 2 * other).sum() / (sides[0][1] ** 2 * length).sum())
            if has_radii else np.nan}


def main(results: Path, truth: Path) -> None:
    """Print a line for each kind of scan: medians over its scans, and how many had no result."""
    kinds: dict[str, list[dict[str, float] | None]] = {}
    for true in sorted(truth.glob("*.swc")):
        found = results / true.name
        kinds.setdefault(true.stem.rpartition("_")[0], []).append(
            compared(true, found) if found.is_file() else None)
    print(f"{'kind':34}{'scans':>6}{'none':>6}{'found':>8}{'own':>8}{'length':>9}{'radius':>9}"
          f"{'volume':>9}")
    for kind, each in kinds.items():
        done = [one for one in each if one is not None]
        middle = {key: np.median([one[key] for one in done]) for key in done[0]} if done else {}
        print(f"{kind:34}{len(each):6}{len(each) - len(done):6}" + "".join(
            f"{middle.get(key, np.nan) - shift:{form}}" for key, shift, form in (
                ("found", 0, "8.0%"), ("own", 0, "8.0%"), ("length", 1, "+9.1%"),
                ("radius", 0, "+9.1%"), ("volume", 1, "+9.1%"))))


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), Path(__file__).parent / "truth")
