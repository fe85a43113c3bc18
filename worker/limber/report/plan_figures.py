"""Figures of a plan: energy along both paths, and both paths over a slice of the energy field."""

from typing import TYPE_CHECKING

import numpy as np

from limber.planning.cost import arc_lengths
from limber.planning.field.energy_field import EnergyField
from limber.planning.plan_file import PlanFile, Way, read_plan
from limber.store import Branch

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLOURS = {"baseline": "#c0504d", "plan": "#1f5fa8"}
_LABELS = {"baseline": "shortest (length alone)", "plan": "gentle (deformation-aware)"}
_GRID = 160  # points of the slice along its longer side


def report_figures(branch: Branch, name: str) -> list[tuple["Figure", str]]:
    """Return the figures of plan ``name`` with their captions."""
    plan = read_plan(branch.path(f"plans/{name}.json"))
    field = EnergyField.read(branch.path("energy.npz"))
    shown = [
        (along_paths(plan), "Energy above the hanging state (strain and weight), gripper force and "
                            "largest strain along both paths, on the full model; the energy of the "
                            "field that the planner saw is dashed."),
        (paths_over_slice(field, plan), "Both paths over the energy field, in the plane that "
                                        "fits them best; white where the branch was not sampled. "
                                        "The cross is the rest pose."),
        (convergence(plan), "Cost of the best path so far over the planner's iterations, relative "
                            "to the last."),
    ]
    if plan.summary.get("certificate"):
        shown.append((certificate(plan), "What the gentle path costs, and what no path on the "
                      "energy field costs less than, as the grid of the proof is refined."))
    if plan.summary.get("detour"):
        shown.append((trade_off(plan), "Energy against length of the gentlest paths for several "
                      "weights of distance; no path lies below the dashed line."))
    return shown


def along_paths(plan: PlanFile) -> "Figure":
    """Draw energy, force and strain over the length of both paths."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 3.6), layout="constrained")
    axes = figure.subplots(1, 3)
    for key, path in _ways(plan).items():
        along = 1e3 * arc_lengths(path.poses[:, :3])
        style = {"color": _COLOURS[key], "label": _LABELS[key]}
        axes[0].plot(along, 1e3 * path.energies, **style)
        if path.field_energies is not None:
            axes[0].plot(along, 1e3 * path.field_energies, "--", lw=1, color=_COLOURS[key])
        axes[1].plot(along, path.force_sizes, **style)
        axes[2].plot(along, 100 * path.strains, **style)
    for axis, label in zip(axes, ("energy above rest [mJ]", "gripper force [N]",
                                  "largest strain [%]"), strict=True):
        axis.set(xlabel="along the path [mm]", ylabel=label)
        axis.grid(alpha=0.25)
    axes[0].legend(frameon=False, fontsize=8)
    return figure


def paths_over_slice(field: EnergyField, plan: PlanFile) -> "Figure":
    """Draw both paths over the energy field in their common plane."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    paths = {key: way.poses[:, :3] for key, way in _ways(plan).items()}
    origin, across, up = _plane(np.concatenate(list(paths.values())))
    flat = {key: (path - origin) @ np.stack([across, up], axis=1) for key, path in paths.items()}
    rest = (field.rest - origin) @ np.stack([across, up], axis=1)
    x, y, energy = _slice(field, origin, across, up, np.concatenate([*flat.values(), rest[None]]))
    # As high as the slice needs at equal scales: paths are often long and flat.
    height = 6.2 * float(np.ptp(y) / max(np.ptp(x), 1e-9)) + 1.0
    figure = Figure(figsize=(8, float(np.clip(height, 2.8, 6.5))), layout="constrained")
    axis = figure.subplots()
    # Nearly all of the paths' range of energy, not the few stiff corners of the slice.
    top = max(1.5 * max(way.energies.max() for way in _ways(plan).values()), 1e-9)
    levels = MaxNLocator(14).tick_values(0.0, 1e3 * top)
    filled = axis.contourf(1e3 * x, 1e3 * y, np.ma.masked_invalid(1e3 * energy), levels=levels,
                           cmap="viridis", extend="max")
    figure.colorbar(filled, ax=axis, label="energy above rest [mJ]")
    for key, points in flat.items():
        axis.plot(*(1e3 * points.T), color="white", lw=4)
        axis.plot(*(1e3 * points.T), color=_COLOURS[key], lw=2, label=_LABELS[key])
        axis.plot(*(1e3 * points[-1]), "o", color=_COLOURS[key], mec="white")
    axis.plot(*(1e3 * flat["plan"][0]), "s", color="black", mec="white", label="start")
    axis.plot(*(1e3 * rest), "x", color="black", ms=9, mew=2, label="rest pose")
    axis.set(xlabel="in the plane, along the straight line [mm]", ylabel="upwards [mm]",
             aspect="equal")
    axis.legend(loc="best", fontsize=8, framealpha=0.85)
    return figure


def convergence(plan: PlanFile) -> "Figure":
    """Draw the cost of the best path over iterations, both relative to their last."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 3.2), layout="constrained")
    axis = figure.subplots()
    for key, history in plan.summary["convergence"].items():
        if history:
            cost = np.array([entry["cost"] for entry in history])
            axis.plot([entry["iteration"] for entry in history], cost / cost[-1],
                      color=_COLOURS[key], label=_LABELS[key])
    axis.set(xlabel="iterations", ylabel="cost / final cost")
    axis.grid(alpha=0.25)
    axis.legend(frameon=False)
    return figure


def certificate(plan: PlanFile) -> "Figure":
    """Draw how the lower and the upper bound on the best path's cost close, grid by grid."""
    from matplotlib.figure import Figure

    levels = plan.summary["certificate"]["levels"]
    figure = Figure(figsize=(6, 3.2), layout="constrained")
    axis = figure.subplots()
    spacing = 1e3 * np.array([level["spacing_m"] for level in levels])
    lower, upper = (np.array([level[name] for level in levels], float)
                    for name in ("lower", "upper"))
    axis.fill_between(spacing, lower, upper, color=_COLOURS["plan"], alpha=0.15,
                      label="the best path lies here")
    axis.plot(spacing, upper, "o-", color=_COLOURS["plan"], label="best path found")
    axis.plot(spacing, lower, "o--", color=_COLOURS["plan"], label="no path is cheaper: proven")
    axis.set(xscale="log", xlabel="cells of the grid [mm]", ylabel="cost", ylim=(0.0, None))
    axis.invert_xaxis()
    axis.set_xticks(spacing, [f"{value:.2g}" for value in spacing])
    axis.minorticks_off()
    axis.grid(alpha=0.25)
    axis.legend(frameon=False, fontsize=8)
    return figure


def trade_off(plan: PlanFile) -> "Figure":
    """Draw energy against length of the gentlest paths, and below which no path is."""
    from matplotlib.figure import Figure

    detour = plan.summary["detour"]
    curve = sorted(detour["curve"], key=lambda point: point["length_m"])
    length = 1e3 * np.array([point["length_m"] for point in curve])
    energy = 1e3 * np.array([point["energy_integral_jm"] for point in curve])
    span = np.linspace(1e3 * detour["shortest_m"], max(length.max(), 1e3 * detour["longest_m"]), 80)
    bounded = [point for point in curve if point["lower_bound_jm"] is not None]
    lines = [1e3 * point["lower_bound_jm"] - point["metre_jm"] * span for point in bounded]
    floor = np.maximum(np.max(lines, axis=0), 0.0)
    figure = Figure(figsize=(6, 3.6), layout="constrained")
    axis = figure.subplots()
    # A path that is allowed to be longer may be any shorter one: the curve only falls.
    best = np.minimum.accumulate(energy)
    axis.fill_between(span, floor, np.interp(span, length, best), where=span >= length.min(),
                      color=_COLOURS["plan"], alpha=0.15, label="the best lies here")
    axis.plot(span, floor, "--", color=_COLOURS["plan"], lw=1, label="proven bound")
    axis.plot(length, energy, "o-", color=_COLOURS["plan"], ms=4, label="gentlest found")
    axis.axvline(1e3 * detour["longest_m"], color="black", lw=1, ls=":", label="length allowed")
    axis.set(xlabel="length of the path [mm]", ylabel="energy over length [mJ m]", ylim=(0.0, None))
    axis.grid(alpha=0.25)
    axis.legend(frameon=False, fontsize=8)
    return figure


def _ways(plan: PlanFile) -> dict[str, Way]:
    return {"baseline": plan.baseline, "plan": plan.plan}


def _plane(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return origin and two axes of the plane that fits points best, the second upwards."""
    origin = points.mean(axis=0)
    _, _, directions = np.linalg.svd(points - origin, full_matrices=False)
    normal = directions[2]
    # A plane of paths is seldom horizontal; where it is, any second axis does.
    up = np.array([0.0, 0.0, 1.0]) - normal[2] * normal
    up = up / np.linalg.norm(up) if np.linalg.norm(up) > 0.2 else directions[1]
    return origin, np.cross(up, normal), up


def _slice(field: EnergyField, origin: np.ndarray, across: np.ndarray, up: np.ndarray,
           shown: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    low, high = shown.min(axis=0), shown.max(axis=0)
    margin = 0.25 * (high - low).max()
    x, y = (np.linspace(low[k] - margin, high[k] + margin, _GRID) for k in range(2))
    points = (origin + x[None, :, None] * across + y[:, None, None] * up).reshape(-1, 3)
    energy = field.energy(points)
    energy[~field.region.contains(points)] = np.nan
    return x, y, energy.reshape(_GRID, _GRID)
