"""Figures of a plan: energy along both paths, and both paths over a slice of the energy field."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from limber.core.constants import PATH_COLOURS
from limber.core.numerics.rigid import principal_axes
from limber.planning.constraints.damage import DamageAlong
from limber.planning.cost import arc_lengths
from limber.planning.field.energy_field import EnergyField
from limber.planning.plan_file import PlanFile, PlanPath, read_plan
from limber.planning.search_files import CostToGo, read_trees
from limber.results.report.figures import damage_along_branch
from limber.results.report.section import chart
from limber.store import Branch

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LABELS = {"baseline": "shortest (length alone)", "plan": "gentle (deformation-aware)"}
_WIDTHS = {"baseline": 3.2, "plan": 1.5}  # both remain visible where they coincide
_FLAT = 1e-3  # a cost that changes less along the search shows only a line
_STILL = 1e-9  # [m] a path that is not longer has no length
_GRID = 160  # points of the slice on its longer side


def report_figures(branch: Branch, name: str) -> list[tuple["Figure", str]]:
    """Return the figures of plan ``name`` with their captions; none if the plan does not move."""
    plan = read_plan(branch.path(f"plans/{name}.json"))
    if plan.summary["plan"]["length_m"] <= _STILL:
        return []
    field = EnergyField.read(branch.path("energy.npz"))
    figures = [
        (along_paths(plan), "Energy above the rest shape (strain and weight), gripper force and "
                            "largest strain along both paths, on the full model. Dashed: energy "
                            "of the field that the planner used."),
        (paths_over_slice(field, plan, _tree_of(branch, name)),
         "Both paths over the energy field, in the plane that fits them best; white where the "
         "branch was not sampled. The cross is the rest pose. Grey: the search tree, "
         "projected onto that plane."),
    ]
    if moved := searched(plan.summary["convergence"]):
        figures.append((convergence(moved), "Cost of the best path so far over the planner's "
                                             "iterations, relative to the final cost."))
    if (plan.summary.get("certificate") or {}).get("levels"):
        if branch.has(f"plans/{name}-bound.npz"):
            bound = CostToGo.read(branch.path(f"plans/{name}-bound.npz"))
            if (drawn := paths_over_bound(field, bound, plan)) is not None:
                figures.append((drawn,
                                "Both paths over the lower bound on the cost from there to the "
                                "goal, in the same plane. Where a path could still be cheaper than "
                                "the gentle one, the bound is of such paths; elsewhere it is of "
                                "all paths, on coarser grids. The gentlest path follows its "
                                "steepest descent." + (
                                    " A metre costs as much as the limit on the length makes it."
                                    if plan.summary.get("detour") else "")))
        what = "Energy" if plan.summary.get("detour") else "Cost"
        within = " within the allowed length" if plan.summary.get("detour") else ""
        figures.append((certificate(plan),
                        f"{what} of the gentle path, and lower bound on the {what.lower()} of "
                        f"every path{within} on the energy field, as the grid of the certificate "
                        "is refined."))
    if branch.has(f"plans/{name}-damage.csv"):
        damage = DamageAlong.read(branch.path(f"plans/{name}-damage.csv"))
        figures.append((damage_along_branch(damage), (
            "Where the gentle path would damage the branch: the probability that the largest "
            "strain at a place, in any state of the motion, breaks it there. "
            if damage.probabilities is not None else
            "Where the gentle path strains the branch most. The strength is not known: give "
            "--break-tests or --wood for a probability of damage. ")
            + "The circle marks the largest strain."))
    if any(point["lower_bound_jm"] is not None
           for point in (plan.summary.get("detour") or {}).get("curve", ())):
        figures.append((trade_off(plan), "Energy against length of the gentlest paths for several "
                        "weights of distance. No path up to the allowed length is below the "
                        "dashed line; what is proven ends there."))
    return figures


def along_paths(plan: PlanFile) -> "Figure":
    """Draw energy, force and strain over the length of both paths."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 3.8), layout="constrained")
    axes = figure.subplots(1, 3)
    for key, path in _paths_of(plan).items():
        along = 1e3 * arc_lengths(path.poses[:, :3])
        style = {"color": PATH_COLOURS[key], "label": _LABELS[key], "lw": _WIDTHS[key]}
        axes[0].plot(along, 1e3 * path.energies, **style)
        if path.field_energies is not None:
            axes[0].plot(along, 1e3 * path.field_energies, "--", lw=1, color=PATH_COLOURS[key])
        axes[1].plot(along, path.force_sizes, **style)
        axes[2].plot(along, 100 * path.strains, **style)
    for axis, label in zip(axes, ("energy above rest [mJ]", "gripper force [N]",
                                  "largest strain [%]"), strict=True):
        axis.set(xlabel="along the path [mm]", ylabel=label)
        axis.grid(alpha=0.25)
    lines, labels = axes[1].get_legend_handles_labels()
    figure.legend(lines, labels, frameon=False, ncols=2, loc="outside upper left")
    return figure


def paths_over_slice(field: EnergyField, plan: PlanFile,
                     tree: tuple[np.ndarray, np.ndarray] | None = None) -> "Figure":
    """Draw both paths, and a search tree, over the energy field in the paths' common plane."""
    from matplotlib.collections import LineCollection

    view = _View.of(field, plan)
    energy = field.energy(view.points)
    energy[~field.region.contains(view.points)] = np.nan
    figure, axis = view.figure()
    # Nearly all of the paths' energy range, without the few stiff corners of the slice.
    top = max(1.5 * max(path.energies.max() for path in _paths_of(plan).values()), 1e-9)
    view.fill(figure, axis, 1e3 * energy, 1e3 * top, "energy above rest [mJ]", "viridis")
    if tree is not None:
        nodes, parents = 1e3 * view.flat(tree[0]), tree[1]
        axis.add_collection(LineCollection(
            np.stack([nodes[1:], nodes[parents[1:]]], axis=1), colors="#dddddd", linewidths=0.4,
            alpha=0.7), autolim=False)
    view.draw_paths(axis)
    return figure


def paths_over_bound(field: EnergyField, bound: CostToGo, plan: PlanFile) -> "Figure | None":
    """Draw both paths over the least cost of any path to the goal, in their common plane; None if
    the bound is zero there."""
    view = _View.of(field, plan)
    cost = bound.at(view.points)
    cost[~field.region.contains(view.points)] = np.nan
    known = cost[np.isfinite(cost)]
    top = float(known.max(initial=0.0))
    if top <= _FLAT * (plan.summary["certificate"].get("upper_bound") or 0.0):
        return None
    figure, axis = view.figure()
    view.fill(figure, axis, cost, top, "lower bound on the cost to the goal", "cividis", lines=True)
    view.draw_paths(axis)
    return figure


@dataclass(frozen=True)
class _View:
    """The plane that best fits both paths, a grid of points in it, and the paths on it [m]."""

    origin: np.ndarray
    axes: np.ndarray
    x: np.ndarray
    y: np.ndarray
    paths: dict[str, np.ndarray]
    rest: np.ndarray

    @classmethod
    def of(cls, field: EnergyField, plan: PlanFile) -> "_View":
        paths = {key: path.poses[:, :3] for key, path in _paths_of(plan).items()}
        origin, across, up = _plane(np.concatenate(list(paths.values())))
        axes = np.stack([across, up])
        flat = {key: (path - origin) @ axes.T for key, path in paths.items()}
        rest = (field.rest - origin) @ axes.T
        points = np.concatenate([*flat.values(), rest[None]])
        low, high = points.min(axis=0), points.max(axis=0)
        margin = 0.25 * (high - low).max()
        x, y = (np.linspace(low[k] - margin, high[k] + margin, _GRID) for k in range(2))
        return cls(origin, axes, x, y, flat, rest)

    @property
    def points(self) -> np.ndarray:
        """Points of the grid [m], shape [n, 3]."""
        across, up = self.axes
        return (self.origin + self.x[None, :, None] * across
                + self.y[:, None, None] * up).reshape(-1, 3)

    def flat(self, points: np.ndarray) -> np.ndarray:
        """Return points [n, 3] projected onto the plane [m], [n, 2]."""
        return (points - self.origin) @ self.axes.T

    def figure(self) -> tuple["Figure", "Axes"]:
        from matplotlib.figure import Figure

        # Figure height that the slice needs at equal scales: paths are often long and flat.
        height = 6.2 * float(np.ptp(self.y) / max(np.ptp(self.x), 1e-9)) + 1.0
        figure = Figure(figsize=(8, float(np.clip(height, 2.8, 6.5))), layout="constrained")
        axis = figure.subplots()
        axis.set(xlabel="in the plane, along the straight line [mm]", ylabel="upwards [mm]",
                 aspect="equal")
        return figure, axis

    def fill(self, figure: "Figure", axis: "Axes", values: np.ndarray, top: float, label: str,
             colours: str, *, lines: bool = False) -> None:
        """Fill the plane with ``values`` at the grid's points up to ``top``; NaN stays white."""
        from matplotlib.ticker import MaxNLocator

        levels = MaxNLocator(14).tick_values(0.0, top)
        masked = np.ma.masked_invalid(values.reshape(_GRID, _GRID))
        filled = axis.contourf(1e3 * self.x, 1e3 * self.y, masked, levels=levels, cmap=colours,
                               extend="max")
        if lines:
            axis.contour(1e3 * self.x, 1e3 * self.y, masked, levels=levels, colors="white",
                         linewidths=0.4)
        figure.colorbar(filled, ax=axis, label=label)

    def draw_paths(self, axis: "Axes") -> None:
        for points in self.paths.values():
            axis.plot(*(1e3 * points.T), color="white", lw=6)
        for key, points in self.paths.items():
            axis.plot(*(1e3 * points.T), color=PATH_COLOURS[key], lw=1.2 * _WIDTHS[key],
                      label=_LABELS[key])
            axis.plot(*(1e3 * points[-1]), "o", color=PATH_COLOURS[key], mec="white")
        axis.plot(*(1e3 * self.paths["plan"][0]), "s", color="black", mec="white", label="start")
        axis.plot(*(1e3 * self.rest), "x", color="black", ms=9, mew=2, label="rest pose")
        axis.set(xlim=1e3 * self.x[[0, -1]], ylim=1e3 * self.y[[0, -1]])
        axis.figure.legend(loc="outside upper left", ncols=4, fontsize=8, frameon=False)


def _tree_of(branch: Branch, name: str) -> tuple[np.ndarray, np.ndarray] | None:
    """Return nodes [m] and parents of the planner's tree, else of RRT*'s; None if not kept."""
    trees = read_trees(branch.path(file)) if branch.has(file := f"plans/{name}-trees.csv") else {}
    return trees.get("D-RRT*", trees.get("RRT*"))


def searched(histories: Mapping[str, Sequence[Mapping[str, Any]]]) -> dict[str, np.ndarray]:
    """Return iterations and cost divided by the final cost, [n, 2], of the searches that improved.
    """
    found = {}
    for key, history in histories.items():
        # A coarse first grid may have no path yet.
        known = np.array([[entry["iteration"], entry["cost"]] for entry in history
                          if entry["cost"] is not None], float).reshape(-1, 2)
        if len(known) and np.ptp(known[:, 1]) > _FLAT * abs(known[-1, 1]):
            found[key] = known / [1.0, known[-1, 1]]
    return found


def convergence(histories: dict[str, np.ndarray]) -> "Figure":
    """Draw the cost of the best path over iterations, both relative to their final values."""
    figure, axis = chart(6, 3.2, "iterations", "cost / final cost", has_grid=True)
    for key, history in histories.items():
        axis.plot(*history.T, color=PATH_COLOURS[key], label=_LABELS[key])
    axis.legend(frameon=False)
    return figure


def certificate(plan: PlanFile) -> "Figure":
    """Draw how the lower and upper bounds on the best path's cost converge, grid by grid."""
    levels = plan.summary["certificate"]["levels"]
    of_energy = plan.summary["certificate"].get("quantity") == "energy_integral_jm"
    figure, axis = chart(6, 3.2, "cell size of the grid [mm]",
                         "energy along the path [J m]" if of_energy else "cost", has_grid=True)
    spacing = 1e3 * np.array([level["spacing_m"] for level in levels])
    lower, upper = (np.array([level[name] for level in levels], float)
                    for name in ("lower", "upper"))
    axis.fill_between(spacing, lower, upper, color=PATH_COLOURS["plan"], alpha=0.15,
                      label="range of the best path")
    axis.plot(spacing, upper, "o-", color=PATH_COLOURS["plan"], label="best path found")
    axis.plot(spacing, lower, "o--", color=PATH_COLOURS["plan"], label="proven lower bound")
    axis.set(xscale="log", ylim=(0.0, None))
    axis.invert_xaxis()
    axis.set_xticks(spacing, [f"{value:.2g}" for value in spacing])
    axis.minorticks_off()
    axis.legend(frameon=False, fontsize=8)
    return figure


def trade_off(plan: PlanFile) -> "Figure":
    """Draw energy against length of the gentlest paths, and the limit below which no path exists.
    """
    detour = plan.summary["detour"]
    curve = sorted(detour["curve"], key=lambda point: point["length_m"])
    length = 1e3 * np.array([point["length_m"] for point in curve])
    energy = 1e3 * np.array([point["energy_integral_jm"] for point in curve])
    # Bounds are of paths within the allowed length.
    span = np.linspace(1e3 * detour["shortest_m"], 1e3 * detour["longest_m"], 200)
    bounded = [point for point in curve if point["lower_bound_jm"] is not None]
    lines = [1e3 * point["lower_bound_jm"] - point["metre_jm"] * span for point in bounded]
    floor = np.maximum(np.max(lines, axis=0), 0.0)
    figure, axis = chart(6, 3.6, "length of the path [mm]", "energy along the path [mJ m]",
                         has_grid=True)
    # Paths within a length include the shorter ones: the best known one changes in steps.
    best = np.minimum.accumulate(energy)
    known = best[np.maximum(np.searchsorted(length, span + 1e-6, side="right") - 1, 0)]
    axis.fill_between(span, floor, np.maximum(known, floor), color=PATH_COLOURS["plan"], alpha=0.15,
                      label="range of the best path")
    axis.plot(span, floor, "--", color=PATH_COLOURS["plan"], lw=1, label="proven bound")
    axis.plot(length, energy, "o-", color=PATH_COLOURS["plan"], ms=4, label="gentlest found")
    axis.axvline(1e3 * detour["longest_m"], color="black", lw=1, ls=":", label="allowed length")
    axis.set_ylim(0.0, None)
    axis.legend(frameon=False, fontsize=8)
    return figure


def _paths_of(plan: PlanFile) -> dict[str, PlanPath]:
    return {"baseline": plan.baseline, "plan": plan.plan}


def _plane(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return origin and two axes of the plane that best fits the points, the second axis upwards.
    """
    origin = points.mean(axis=0)
    directions = principal_axes(points)
    normal = directions[2]
    # A plane of paths is rarely horizontal; if it is, any second axis will do.
    up = np.array([0.0, 0.0, 1.0]) - normal[2] * normal
    up = up / np.linalg.norm(up) if np.linalg.norm(up) > 0.2 else directions[1]
    return origin, np.cross(up, normal), up
