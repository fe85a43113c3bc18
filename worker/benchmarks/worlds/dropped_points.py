"""Points that a reconstruction did not use as wood, and the twigs that went with them."""

import json
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.scan_cases import ScanCase
from limber.core.alignment import Alignment
from limber.geometry.io.clouds import read_points
from limber.geometry.skeleton.radii.fit_kernels import nearest_cylinders

_SAME = 1e-4  # [m] between a point and its copy in a file of single precision
_FEW = 8  # points of a twig, under which nothing is lost with it
_MOST = 0.5  # of a twig's points, that are dropped with it


def dropped_points(case: ScanCase, branch: Path) -> dict[str, float]:
    """Fractions of wood's points called leaf or dropped before; twigs mostly lost so; leaves kept.

    Args:
        case: The case.
        branch: Folder of its reconstruction.
    """
    cloud = read_points(branch / "cloud.ply")
    alignment = Alignment.model_validate(json.loads((branch / "branch.json").read_text())[
        "alignment"])
    away, near = cKDTree(alignment.undo(cloud.points)).query(case.points)
    called = np.asarray(cloud.attributes.get("leaf", np.zeros(len(cloud)))) > 0
    gone = away > _SAME
    leaf = ~gone & called[near]
    wood = np.ones(len(gone), bool) if case.leaf is None else ~case.leaf
    run = case.truth.branch[nearest_cylinders(case.truth, case.points[wood])[0]]
    total = np.bincount(run)
    lost = np.bincount(run, (gone | leaf)[wood], len(total))
    return {"called_leaf": float(leaf[wood].mean()), "gone": float(gone[wood].mean()),
            "twigs_lost": int(((total >= _FEW) & (lost > _MOST * total)).sum())}
