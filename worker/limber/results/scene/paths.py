"""Paths to a goal in a scene: points, poses, energies, search trees and the goal."""

from typing import Any

import numpy as np

from limber.core.files.tables import read_columns
from limber.planning.plan_file import read_plan_summary
from limber.planning.search_files import read_trees
from limber.results.findings import PATH_NAMES, SAME, remarks_on
from limber.results.scene.arrays import SceneData
from limber.results.scene.colours import colour_scale, colours_of
from limber.results.scene.graphs import energy_graph
from limber.results.scene.rods import add_rods
from limber.store import Branch

_POSITION = ("x_m", "y_m", "z_m")
_TREES = {"D-RRT*": "plan", "RRT*": "baseline"}  # name of the path of each tree
_ROTATION = ("rx_rad", "ry_rad", "rz_rad")


def add_plan(data: SceneData, branch: Branch, plan: str | None) -> str | None:
    """Add the paths of ``plan``, by default the newest, and its goal; return its name.

    Raises:
        BranchFolderError: the plan does not exist or is damaged.
    """
    plans = [key.split(":", 1)[1] for key in branch.manifest.stages if key.startswith("plan:")]
    data.info["plans"] = plans
    if plan is None:
        if not plans:
            return None
        plan = max(plans, key=lambda name: branch.manifest.stages[f"plan:{name}"].finished)
    summary = read_plan_summary(
        branch.require(f"plans/{plan}.json", f"plan --name {plan}"))
    for key, name in (("plan", plan), ("baseline", f"{plan}-baseline")):
        if not branch.has(f"plans/{name}.csv"):
            continue
        table = read_columns(branch.path(f"plans/{name}.csv"), _POSITION, "the table of a path")
        _add_path(data, key, table)
        data.info["paths"][key] = {"title": PATH_NAMES[key],
                                   "note": _path_note(summary.get(key) or {})}
    gap = (summary.get("certificate") or {}).get("gap_percent")
    if gap is not None and "plan" in data.info["paths"]:
        data.info["paths"]["plan"]["note"] += f", at most {gap:.1f} % above the least cost"
    _add_trees(data, branch, plan)
    _add_energy_scale(data)
    data.info["plan"] = plan
    data.info["goal"] = _goal(summary, data.arrays.get("path:plan"))
    saved, added = summary.get("energy_saved_percent"), summary.get("length_added_percent")
    if saved is not None and added is not None:
        data.info["notes"].append(
            "no shorter path was found" if max(abs(saved), abs(added)) < SAME else
            f"energy {round(-saved):+d} %, length {round(added):+d} % against the shortest path")
    if legs := summary.get("legs"):
        data.info["notes"].append("motion: " + ", ".join(
            f"{leg['name']} {leg['duration_s']:.0f} s" for leg in legs))
    if beyond := remarks_on(summary).get("peak_strain"):
        data.info["notes"].append(f"strain, {beyond}")
    return plan


def _add_path(data: SceneData, key: str, table: dict[str, np.ndarray]) -> None:
    positions = np.column_stack([table[name] for name in _POSITION])
    data.arrays[f"path:{key}"] = positions
    if all(name in table for name in _ROTATION):
        data.arrays[f"path_pose:{key}"] = np.column_stack(
            [positions, *(table[name] for name in _ROTATION)])
    for column, name in (("energy_j", "energy"), ("force_n", "force"), ("strain", "strain")):
        if column in table:
            data.arrays[f"path_{name}:{key}"] = table[column]


def _add_trees(data: SceneData, branch: Branch, plan: str) -> None:
    """Add the search trees; a user may have deleted their file, which is large."""
    data.info["trees"] = {}
    if not branch.has(f"plans/{plan}-trees.csv"):
        return
    trees = read_trees(branch.path(f"plans/{plan}-trees.csv"))
    for planner, key in _TREES.items():
        if planner in trees:
            data.arrays[f"tree:{key}"], data.arrays[f"tree_parent:{key}"] = trees[planner]
            data.info["trees"][key] = {"title": planner, "node_count": len(trees[planner][0])}


def _add_energy_scale(data: SceneData) -> None:
    """Colour all paths by energy on one scale, so that they can be compared."""
    energies = {key: data.arrays[f"path_energy:{key}"] for key in data.info["paths"]
                if f"path_energy:{key}" in data.arrays}
    if energies:
        scale = colour_scale(np.concatenate(list(energies.values())), "energy along the path",
                             "J", "inferno")
        data.info["path_energy"] = scale
        size = float(np.ptp(data.arrays["vertices"], axis=0).max())
        for key, values in energies.items():
            data.arrays[f"path_color:{key}"] = colours_of(values, scale)
            points = data.arrays[f"path:{key}"]
            along = np.arange(len(points) - 1)
            add_rods(data, key, f"{data.info['paths'][key]['title']} path by energy", points,
                     np.column_stack([along, along + 1]), 0.005 * size, values, scale)
        data.info["graphs"]["energy"] = energy_graph({
            key: (data.info["paths"][key]["title"], data.arrays[f"path:{key}"], values)
            for key, values in energies.items()})


def _path_note(summary: dict[str, Any]) -> str:
    parts = []
    if summary.get("length_m") is not None:
        parts.append(f"{100 * summary['length_m']:.1f} cm")
    if summary.get("energy_sum_nmm") is not None:
        total = summary["energy_sum_nmm"]
        parts.append(f"{total:.0f} N mm" if abs(total) >= 100 else f"{total:.3g} N mm")
    return ", ".join(parts)


def _goal(summary: dict[str, Any], path: np.ndarray | None) -> dict[str, Any] | None:
    """Return what must reach the goal region, its centre [m], and its radius [m] or None."""
    goal = summary.get("goal") or {}
    centre, radius = goal.get("position_m"), goal.get("tolerance_m")
    if centre is None:
        if path is None:
            return None
        centre = path[-1]
    return {"kind": goal.get("kind", "grasp"), "radius_m": radius,
            "centre_m": [float(value) for value in centre[:3]]}
