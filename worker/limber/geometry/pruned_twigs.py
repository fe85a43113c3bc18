"""Differences between mesh and plant: pruned twigs, and branches that touch."""

from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from limber.core.errors import MeshingError, Option
from limber.core.progress import Progress
from limber.geometry.settings import ReconstructSettings
from limber.geometry.skeleton.skeleton import Skeleton

_NAMED = 3  # branches and positions named one by one
_LEFT_OUT_MOST = 0.03  # fraction of the mass that the mesh may omit without asking


def leave_out_twigs(skeleton: Skeleton, settings: ReconstructSettings,
                    ) -> tuple[Skeleton, list[dict[str, Any]]]:
    """Prune thin side twigs and what they carry: the skeleton to mesh, and :func:`twig_mass` of
    each, which remains at its position."""
    keep = np.ones(skeleton.node_count, bool)
    masses: list[dict[str, Any]] = []
    for run, members in enumerate(skeleton.runs()[1:], start=1):
        own = members[1:]
        carried = not keep[members[0]]
        thin = float(np.median(skeleton.radius[own])) < settings.twig_radius
        if not (carried or thin):
            continue
        keep[own] = False
        masses.append(twig_mass(skeleton, run, settings.density, keep))
    return (skeleton, []) if keep.all() else (skeleton.subset(keep), masses)


def twig_mass(skeleton: Skeleton, run: int, density: float, keep: np.ndarray | None = None,
              ) -> dict[str, Any]:
    """Return the mass of a run that is not meshed, as a rod with ``inertia_kg_m2`` [3, 3] about its
    centre. ``attached_m`` is on the axis that carries it, ``branch`` its run in the skeleton."""
    members = skeleton.runs()[run]
    own, base = members[1:], members[0]
    while keep is not None and not keep[base]:
        base = skeleton.parent[base]
    up = skeleton.parent[own]
    vector = skeleton.nodes[own] - skeleton.nodes[up]
    length = np.linalg.norm(vector, axis=1)
    part = np.maximum(np.pi * skeleton.radius[own]**2 * length * density, 1e-300)
    middle = (skeleton.nodes[own] + skeleton.nodes[up]) / 2
    centre = np.average(middle, axis=0, weights=part)
    offset = middle - centre
    # Each piece is a slender rod: m (r r^T + l l^T / 12) with its middle r and its length l.
    second = np.einsum("k,ki,kj->ij", part, offset, offset) + np.einsum(
        "k,ki,kj->ij", part, vector, vector) / 12
    return {"mass_kg": float(part.sum()), "length_m": float(length.sum()),
            "centre_m": centre.tolist(), "attached_m": skeleton.nodes[base].tolist(),
            "inertia_kg_m2": (np.trace(second) * np.eye(3) - second).tolist(), "branch": run}


def report_pruned_twigs(masses: list[dict[str, Any]], meshed: float, settings: ReconstructSettings,
                        progress: Progress) -> None:
    """Report the pruned twigs, heaviest first, against the mass of the mesh ``meshed`` [kg].
    MeshingError if they hold over 3 % of the mass and the user did not accept that."""
    if not masses:
        return
    total = sum(m["mass_kg"] for m in masses)
    share = total / max(total + meshed, 1e-300)
    first = sorted(masses, key=lambda m: -m["mass_kg"])[:_NAMED]
    named = ", ".join(f"branch {m['branch']} ({1000 * m['length_m']:.0f} mm, "
                      f"{1000 * m['mass_kg']:.3g} g)" for m in first)
    more = f" and {len(masses) - _NAMED} more" if len(masses) > _NAMED else ""
    text = (f"{len(masses)} branches with a length of {sum(m['length_m'] for m in masses):.3g} m "
            f"and {100 * share:.1f} % of the mass are not in the mesh: {named}{more}.")
    asked = settings.leave_out or settings.twig_radius > 0
    if share > _LEFT_OUT_MOST and not asked:
        raise MeshingError(text, "Their weight would act on the branch, but they could neither "
                           "bend nor be grasped.", "Accept this (", Option("leave_out", True), "), "
                           "mesh with fTetWild (", Option("mesher", "ftetwild"), "), or correct "
                           "the skeleton there.")
    progress.warn(f"{text} Their mass is kept.")


def touching_runs(skeleton: Skeleton) -> list[dict[str, Any]]:
    """Pairs of ``branches`` [2] that touch without a fork between them, and where they overlap
    most, ``at_m`` [3]."""
    tree = cKDTree(skeleton.nodes)
    reach = 2 * float(skeleton.radius.max())
    pairs = tree.query_pairs(reach, output_type="ndarray").reshape(-1, 2)
    one, other = skeleton.branch[pairs[:, 0]], skeleton.branch[pairs[:, 1]]
    overlap = skeleton.radius[pairs].sum(axis=1) - np.linalg.norm(
        skeleton.nodes[pairs[:, 0]] - skeleton.nodes[pairs[:, 1]], axis=1)
    start = np.array([members[0] for members in skeleton.runs()])
    found: dict[tuple[int, int], tuple[float, np.ndarray]] = {}
    for pair in np.flatnonzero((one != other) & (overlap > 0)):
        low, high = sorted((int(one[pair]), int(other[pair])))
        key = low, high
        at = skeleton.nodes[pairs[pair]].mean(axis=0)
        # They overlap as expected around the fork that joins them, or from which both start.
        own = 3 * float(skeleton.radius[start[list(key)]].max())
        if np.linalg.norm(skeleton.nodes[start[list(key)]] - at, axis=1).min() < own:
            continue
        if key not in found or overlap[pair] > found[key][0]:
            found[key] = float(overlap[pair]), at
    return [{"branches": list(key), "at_m": at.tolist()}
            for key, (_, at) in sorted(found.items(), key=lambda item: -item[1][0])]


def touching_texts(handles: int, touching: list[dict[str, Any]]) -> list[str]:
    """Warnings about handles of a surface, where separate branches have merged."""
    if handles == 0:
        return []
    locations = "; ".join(
        f"branches {m['branches'][0]} and {m['branches'][1]} at ("
        + ", ".join(f"{v:.3f}" for v in m["at_m"]) + ")" for m in touching[:_NAMED])
    return [f"surface.ply has {handles} handle{'s' * (handles != 1)}: branches that are separate "
            f"in the skeleton touch and merge there{': ' + locations if locations else ''}. The "
            "swept mesh keeps them separate."]
