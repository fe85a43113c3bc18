"""Fit of a capture system's markers to their nominal positions on the branch at rest."""

from collections import Counter
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np

from limber.core.errors import InputError
from limber.core.files.reading import read_text
from limber.core.numerics.rigid import rigid_fit
from limber.recordings.tables import LENGTH_UNITS_M, same_label, scale_of, split_title

POOR_FIT_M = 5e-3
"""Residual of a rigid fit at a marker above which it is reported."""
COLLINEAR = 0.03
"""Ratio of extents across and along a line from which markers span a triangle."""


@dataclass(frozen=True)
class Registration:
    """From the capture frame to the branch's, ``x = rotation p + shift`` [m]; ``used``: indices of
    the recording's markers with a nominal position, ``residual``: distance of each from it at rest
    [m], shape [m] both."""

    rotation: np.ndarray
    shift: np.ndarray
    used: np.ndarray
    residual: np.ndarray
    warnings: tuple[str, ...] = ()

    @property
    def rms(self) -> float:
        """Root mean square of the residuals over the remaining degrees of freedom [m]."""
        freedom = max(3 * len(self.used) - 6, 1)
        return float(np.sqrt(np.sum(self.residual**2) / freedom))

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Transform points [m], shape [..., 3], to the branch's frame."""
        return points @ self.rotation.T + self.shift


def read_nominal(path: Path) -> tuple[list[str], np.ndarray]:
    """Read ``label,x_m,y_m,z_m`` (or another unit of length): labels, positions [m], shape [m, 3];
    InputError if the file is not in this format."""
    path = Path(path)
    lines = [line for line in read_text(path, "a table of the markers' nominal positions")
             .splitlines() if line.strip() and not line.startswith("#")]
    sign = next((sign for sign in ("\t", ";", ",") if lines and sign in lines[0]), ",")
    rows = [[part.strip().strip('"') for part in line.split(sign)] for line in lines]
    try:
        titles = [split_title(part) for part in rows[0][1:4]]
        if len(titles) != 3:
            raise ValueError("its first line does not have three columns of positions")
        scale = [scale_of(title, LENGTH_UNITS_M, "m", path) for title in titles]
        labels = [row[0] for row in rows[1:]]
        points = np.array([[float(part) for part in row[1:4]] for row in rows[1:]])
        if points.shape != (len(labels), 3) or not np.isfinite(points).all():
            raise ValueError("each marker needs three numbers")
        if doubled := [label for label, count in Counter(labels).items() if count > 1]:
            raise ValueError(f"{doubled[0]!r} has several rows")
    except (IndexError, ValueError) as error:
        raise InputError(f"{path} is not a table of markers ({error}).",
                         "The first line must be label,x_m,y_m,z_m. Each further line is one "
                         "marker.",
                         "Correct the file.") from error
    return labels, points * scale


def register(points: np.ndarray, labels: list[str], nominal_labels: list[str],
             nominal: np.ndarray, name: str) -> Registration:
    """Fit markers at rest in the capture frame [m], shape [n, 3], rigidly to their nominal
    positions [k, 3], paired by name; an outlier is excluded if three others agree. InputError if
    fewer than three are shared, one with a nominal position is missing, or they are on a line,
    mirrored, or mistaken for each other."""
    pairs = [(k, j) for k, label in enumerate(labels) for j, known in enumerate(nominal_labels)
             if same_label(label, known) and np.isfinite(points[k]).all()]
    if len(pairs) < 3:
        raise InputError(
            f"{name}: the recording has the markers {', '.join(labels)}. Nominal positions are "
            f"given for {', '.join(nominal_labels)}.",
            "A rigid fit needs three common markers that are in view at the start.",
            "Use the recording's labels in the table of nominal positions.")
    used = np.array([k for k, _ in pairs])
    target = nominal[[j for _, j in pairs]]
    messages = _unpaired(labels, nominal_labels, pairs, name)
    _require_body(target, name)
    _require_same_body(points[used], target, [labels[k] for k in used], name)
    inlier = _consistent(points[used], target)
    rotation, shift = rigid_fit(points[used][inlier], target[inlier])
    residual = np.linalg.norm(points[used] @ rotation.T + shift - target, axis=1)
    for k, off, good in zip(used, residual, inlier, strict=True):
        if not good or off > POOR_FIT_M:
            excluded = "" if good else " and was excluded from the rigid fit"
            messages.append(f"{name}: marker {labels[k]} is {off * 1e3:.1f} mm away from its "
                            f"nominal position{excluded}.")
    return Registration(rotation, shift, used, residual, tuple(messages))


def _unpaired(labels: list[str], nominal_labels: list[str], pairs: list[tuple[int, int]],
              name: str) -> list[str]:
    """State which markers have no nominal position; InputError if one with a nominal position is
    not in the recording, or not visible at its start."""
    missing = [label for j, label in enumerate(nominal_labels) if j not in {j for _, j in pairs}]
    if missing:
        raise InputError(
            f"{name}: {', '.join(missing)} has a nominal position, but is not in the recording's "
            f"first frame. That frame has {', '.join(labels)}.",
            "A marker that is missing or has another name would be ignored without notice.",
            "Correct its name in the table of nominal positions, or remove it from the table.")
    unknown = [label for k, label in enumerate(labels) if k not in {k for k, _ in pairs}]
    if not unknown:
        return []
    return [f"{name}: {', '.join(unknown)} has no nominal position and was discarded."]


def _require_body(target: np.ndarray, name: str) -> None:
    """Raises InputError if markers are on a line: a rotation about it would be undetermined."""
    extent = np.linalg.svd(target - target.mean(axis=0), compute_uv=False)
    if extent[1] < max(COLLINEAR * extent[0], 1e-4):
        raise InputError(f"{name}: the markers' nominal positions lie on a line.",
                         "The rotation of the recording about that line cannot be determined.",
                         "Use at least one marker off the line, so that three span a triangle.")


def _require_same_body(points: np.ndarray, target: np.ndarray, labels: list[str],
                       name: str) -> None:
    """Raises InputError if markers fit once they are mirrored, or two of them are exchanged."""
    rms = float(np.sqrt(np.mean(_residuals(points, target)**2)))
    if rms <= POOR_FIT_M:
        return
    mirrored = float(np.sqrt(np.mean(_residuals(points * [1.0, 1.0, -1.0], target)**2)))
    if mirrored < min(rms / 3, POOR_FIT_M):
        raise InputError(
            f"{name}: the markers fit their nominal positions to {1e3 * mirrored:.1f} mm when "
            f"mirrored, and to {1e3 * rms:.0f} mm as they are.",
            "One axis has the wrong sign in the recording or in the table.",
            "Check the signs and the order of the axes (x, y, z right-handed).")
    for first, second in combinations(range(len(points)), 2):
        order = np.arange(len(points))
        order[[first, second]] = second, first
        swapped = float(np.sqrt(np.mean(_residuals(points, target[order])**2)))
        if swapped < min(rms / 3, POOR_FIT_M):
            raise InputError(
                f"{name}: {labels[first]} and {labels[second]} fit to {1e3 * swapped:.1f} mm when "
                f"they are exchanged, and to {1e3 * rms:.0f} mm as they are named.",
                "Their names are swapped in the recording or in the table.",
                "Exchange their names in the table of nominal positions.")


def _residuals(points: np.ndarray, target: np.ndarray) -> np.ndarray:
    rotation, shift = rigid_fit(points, target)
    return np.linalg.norm(points @ rotation.T + shift - target, axis=1)


def _consistent(points: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Whether each marker agrees with the others; one that triples the residual does not."""
    keep = np.ones(len(points), bool)
    while keep.sum() > 4:
        rms = np.sqrt(np.mean(_residuals(points[keep], target[keep])**2))
        without = []
        for k in np.flatnonzero(keep):
            rest = keep.copy()
            rest[k] = False
            without.append((np.sqrt(np.mean(_residuals(points[rest], target[rest])**2)), k))
        best, worst = min(without)
        if rms < POOR_FIT_M or best > rms / 3:
            break
        keep[worst] = False
    return keep
