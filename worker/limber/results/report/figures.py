"""Figures of the report: scan, skeleton, mesh, samples, planners, loads, swing, execution."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from limber.core.constants import MARK_COLOURS
from limber.core.errors import InputError
from limber.core.files.reading import read_arrays, require_shapes
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.tets.tet_mesh import TetMesh
from limber.planning.compared_planners import BASELINE, COMPARED, ComparedTrial
from limber.planning.constraints.damage import DamageAlong
from limber.planning.field.energy_field import EnergyField
from limber.recordings.time_series import read_stream
from limber.results.findings import modulus_origin
from limber.results.motion_files import node_average, read_pc2
from limber.results.report.estimate_figures import AXIS_DOTS, AXIS_LINES, OBSERVED, SIMULATED
from limber.results.report.section import chart, draw_faces, two_views
from limber.store import Branch
from limber.store.loading import load_skeleton

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from limber.mechanics.loads.loaded_branch import NamedTarget

ORDER_COLOURS = ("#1f6f43", "#8a6d1d", "#6a4c93", "#7fb685", "#5d6a63")
_CLOUD = "#a9b3ad"
# Most points that are drawn; more only darken the picture and slow it.
_SHOWN_POINTS = 30_000


def scan_and_skeleton(branch: Branch, targets: "Sequence[NamedTarget]") -> "Figure":
    """Cloud, centreline tree, control points and targets, from the front and from the side."""
    skeleton = load_skeleton(branch)
    points = _cloud_points(branch)
    mesh = TetMesh.read(branch.path("mesh.vtu")) if branch.has("mesh.vtu") else None
    figure, views = two_views(points)
    for axis, first, _depth in views:
        axis.scatter(points[:, first], points[:, 2], s=1.0, color=_CLOUD, linewidths=0)
        _draw_tree(axis, skeleton, first)
        if mesh is not None and "control_point" in mesh.point_data:
            nodes = mesh.nodes[mesh.point_data["control_point"] >= 0]
            axis.scatter(nodes[:, first], nodes[:, 2], s=60, facecolors="none",
                         edgecolors=MARK_COLOURS["control_points"], linewidths=1.4, zorder=5)
        for target in targets:
            position = target.position
            axis.plot(position[first], position[2], marker="*", markersize=13,
                      color=MARK_COLOURS["targets"], markeredgecolor="#5c4300", zorder=6)
            axis.annotate(target.name, (position[first], position[2]), (7, 5), fontsize=9,
                          textcoords="offset points", zorder=6)
    return figure


def diameters(skeleton: Skeleton, compared: Sequence[Mapping[str, Any]]) -> "Figure":
    """Diameter along the main path with its interval, and caliper measurements."""
    from limber.geometry.skeleton.qsm_tables import diameters as along_path

    figure, axis = chart(9, 3.2, "distance from the root along the main path [m]",
                         "diameter [mm]", has_grid=True)
    path = skeleton.main_path()
    along = skeleton.arc_length[path]
    thick, sigma = 1e3 * along_path(skeleton, along).T
    colour = _order_colour(0)
    axis.plot(along, thick, color=colour, linewidth=1.4, label="scan")
    axis.fill_between(along, thick - 2 * sigma, thick + 2 * sigma, color=colour, alpha=0.15,
                      linewidth=0)
    if compared:
        axis.plot([row["along_m"] for row in compared],
                  [1e3 * row["measured_m"] for row in compared], "o", color=OBSERVED,
                  markersize=6, label="calipers")
        axis.legend(frameon=False)
    axis.set_ylim(bottom=0)
    return figure


def radii(branch: Branch) -> "Figure":
    """Radius and its uncertainty over the distance from the root, one colour per order."""
    skeleton = load_skeleton(branch)
    figure, axis = chart(9, 3.6, "distance from the root along the tree [m]", "radius [mm]",
                         has_grid=True)
    distance = skeleton.arc_length
    for run in skeleton.runs():
        own = run if skeleton.branch[run[0]] == skeleton.branch[run[-1]] else run[1:]
        colour = _order_colour(int(skeleton.order[own[-1]]))
        axis.plot(distance[own], 1e3 * skeleton.radius[own], color=colour, linewidth=1.2)
        sigma = skeleton.radius_sigma[own]
        if sigma.any():
            axis.fill_between(distance[own], 1e3 * (skeleton.radius[own] - 2 * sigma),
                              1e3 * (skeleton.radius[own] + 2 * sigma), color=colour, alpha=0.15,
                              linewidth=0)
    axis.set_ylim(bottom=0)
    return figure


def mesh_by_modulus(branch: Branch) -> "Figure":
    """The mesh's surface, shaded, coloured by Young's modulus; base and grasp patch marked."""
    import matplotlib.pyplot as plt
    from matplotlib.colors import LogNorm, Normalize

    mesh = TetMesh.read(branch.path("mesh.vtu"))
    faces, young = _coloured_faces(mesh)
    spread = young.max() / young.min()
    low, high = (young.min(), young.max()) if spread > 1.001 else (0.0, 1.5 * young.max())
    norm = (LogNorm if spread > 10 else Normalize)(low / 1e6, high / 1e6)
    figure, views = two_views(mesh.nodes)
    corners = mesh.nodes[faces]
    for axis, first, depth in views:
        colours = plt.get_cmap("viridis")(norm(young / 1e6))
        colours[:, :3] *= _shade(corners, depth)[:, None]
        draw_faces(axis, corners, colours, first, depth)
        for name, colour in (("fixed", MARK_COLOURS["base"]), ("grasp", MARK_COLOURS["grasp"])):
            marked = mesh.nodes[np.asarray(mesh.point_data.get(name, [])).nonzero()[0]]
            axis.scatter(marked[:, first], marked[:, 2], s=3, color=colour, zorder=4)
    title = f"Young's modulus ({modulus_origin(branch)})"
    if spread > 1.001:
        scale = plt.cm.ScalarMappable(norm, "viridis")
        figure.colorbar(scale, ax=figure.axes, label=f"{title} [MPa]", shrink=0.7)
    else:
        figure.suptitle(f"{title} {young.mean() / 1e6:.4g} MPa everywhere", fontsize=10)
    return figure


def pull(recording: Any) -> "Figure":
    """Force on the branch and displacement of the grasp over time."""
    import matplotlib.pyplot as plt

    time = recording.times
    figure, (upper, lower) = plt.subplots(2, 1, figsize=(9, 5), sharex=True, layout="constrained")
    moved = recording.poses[:, :3] - recording.poses[0, :3]
    for column, (name, line) in enumerate(AXIS_LINES.items()):
        style = {"color": OBSERVED, "ls": line, "marker": AXIS_DOTS[name], "ms": 3, "label": name}
        upper.plot(time, recording.wrenches[:, column], **style)
        lower.plot(time, 1e3 * moved[:, column], **style)
    upper.set(ylabel="force on the branch [N]")
    lower.set(ylabel="displacement of the grasp [mm]", xlabel="time [s]")
    for axis in (upper, lower):
        axis.grid(alpha=0.25)
    upper.legend(ncols=3, frameon=False, loc="lower left", bbox_to_anchor=(0, 1))
    return figure


def motion(time: np.ndarray, energies: np.ndarray, kinetic: np.ndarray, force: np.ndarray,
           ) -> "Figure":
    """Energies [J] and grasp force [N] [n, 3] of a simulated motion over time [s]."""
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 3.8), layout="constrained")
    left.plot(time, 1e3 * energies, color=SIMULATED, label="strain")
    if kinetic.any():
        left.plot(time, 1e3 * kinetic, "--", color=SIMULATED, label="kinetic")
    left.set(xlabel="time [s]", ylabel="energy [mJ]")
    for (name, line), column in zip(AXIS_LINES.items(), force.T, strict=True):
        right.plot(time, column, line, color=SIMULATED, label=name)
    right.set(xlabel="time [s]", ylabel="force on the grasp [N]")
    for axis in (left, right):
        axis.grid(alpha=0.25)
        axis.legend(ncols=3, frameon=False, loc="lower left", bbox_to_anchor=(0, 1))
    return figure


def energy_samples(positions: np.ndarray, energies: np.ndarray, forces: np.ndarray) -> "Figure":
    """Energy [J] and force [N] of the sampled grasps over their distance from rest, the first."""
    import matplotlib.pyplot as plt

    distance = 1e3 * np.linalg.norm(positions - positions[0], axis=1)
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 3.8))
    left.scatter(distance, 1e3 * energies, s=9, color=SIMULATED)
    left.set(xlabel="displacement of the grasp [mm]", ylabel="strain energy [mJ]")
    force = np.linalg.norm(forces, axis=1)
    right.scatter(distance, force, s=9, color=SIMULATED)
    right.set(xlabel="displacement of the grasp [mm]", ylabel="force [N]")
    for axis in (left, right):
        axis.set_ylim(bottom=0)
        axis.grid(alpha=0.25)
    return figure


def _draw_tree(axis: Any, skeleton: Skeleton, first: int) -> None:
    from matplotlib.collections import LineCollection

    child = np.flatnonzero(skeleton.parent >= 0)
    ends = np.stack([skeleton.nodes[skeleton.parent[child]], skeleton.nodes[child]], axis=1)
    colours = [_order_colour(int(order)) for order in skeleton.order[child]]
    axis.add_collection(LineCollection(ends[:, :, [first, 2]], colors=colours, linewidths=1.3,
                                       zorder=3))


def _order_colour(order: int) -> str:
    return ORDER_COLOURS[min(order, len(ORDER_COLOURS) - 1)]


def _cloud_points(branch: Branch) -> np.ndarray:
    from limber.geometry.io.clouds import read_cloud

    points = read_cloud(branch.path("cloud.ply")).points
    return points[:: max(1, len(points) // _SHOWN_POINTS)]


def _coloured_faces(mesh: TetMesh) -> tuple[np.ndarray, np.ndarray]:
    """Boundary faces and the modulus of the tetrahedra behind them, from nodal averages."""
    faces = mesh.surface_faces()
    return faces, (node_average(mesh) @ mesh.cell_data["young"])[faces].mean(axis=1)


def _shade(corners: np.ndarray, depth: int) -> np.ndarray:
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1)
    facing = np.abs(normal[:, depth]) / np.where(length > 0, length, 1.0)
    return 0.45 + 0.55 * facing


# The paper's last figure: paths of two planners, coloured by the energy at their waypoints.

_SHOWN = (BASELINE, "D-RRT*, not smoothed", "eikonal")
_SHELL = 600  # poses of the field drawn behind the paths


def planner_figure(field: EnergyField, trials: Sequence[ComparedTrial]) -> "Figure":
    """Draw the paths of each planner in a separate view, over the field's energy."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.0 * len(_SHOWN), 4.2), layout="constrained")
    behind = field.region.draw(_SHELL, np.random.default_rng(0))
    energies = 1e3 * field.energy(behind)
    most = float(np.quantile(energies, 0.95))
    for number, name in enumerate(_SHOWN):
        axes = figure.add_subplot(1, len(_SHOWN), number + 1, projection="3d")
        axes.scatter(*behind.T, c=energies, s=3, alpha=0.12, vmin=0.0, vmax=most, cmap="viridis")
        for trial in trials:
            if (path := trial.paths.get(name)) is None:
                continue
            axes.plot(*path.T, color="black", lw=0.6)
            dots = axes.scatter(*path.T, c=1e3 * field.energy(path), s=12, vmin=0.0, vmax=most,
                                cmap="viridis", depthshade=False)
        axes.set(title=COMPARED[name], xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
        axes.set_aspect("equal")
        axes.locator_params(nbins=4)
    figure.colorbar(dots, ax=figure.axes, label="deformation energy [mJ]", shrink=0.7)
    return figure


# The picture of where a planned path would damage the branch.

_LEAST = 1e-4  # probabilities below look alike


def damage_along_branch(damage: DamageAlong) -> "Figure":
    """Draw the branch's axes from the front and the side, coloured by the probability of damage, or
    by the largest strain if the strength is not known. The worst place is marked."""
    from matplotlib.collections import LineCollection
    from matplotlib.colors import LogNorm, Normalize

    values, label = 100.0 * damage.strains, "largest strain along the path [%]"
    norm: Normalize = Normalize(0.0, max(float(values.max()), 1e-9))
    if damage.probabilities is not None:
        values, label = 100.0 * damage.probabilities, "probability of damage here [%]"
        norm = LogNorm(100.0 * _LEAST, 100.0, clip=True)
    child = np.flatnonzero(damage.parents >= 0)
    ends = damage.nodes[np.stack([damage.parents[child], child], axis=1)]
    figure, views = two_views(damage.nodes)
    worst = damage.nodes[int(np.argmax(damage.strains))]
    for axis, across, _ in views:
        lines = LineCollection(ends[:, :, [across, 2]], cmap="inferno_r", norm=norm, linewidths=4.0,
                               capstyle="round")
        lines.set_array(values[child])
        axis.add_collection(lines)
        axis.plot(worst[across], worst[2], "o", mfc="none", mec="black", ms=14)
        axis.autoscale_view()
    figure.colorbar(lines, ax=[axis for axis, _, _ in views], label=label)
    return figure


# Figures of wind, snow, fruit and cuts that act on a branch.

def bent_branch(mesh: TetMesh, frames: Path) -> "Figure":
    """Draw the branch as scanned (grey) and under the loads of ``frames/load-NAME.pc2``, coloured
    by its largest strain in the ``.npz`` beside it; InputError if they are damaged or belong to
    another mesh."""
    import matplotlib.pyplot as plt

    nodes, corners = np.unique(mesh.surface_faces(), return_inverse=True)
    corners = corners.reshape(-1, 3)
    positions, _, _ = read_pc2(frames)
    values = read_arrays(frames.with_suffix(".npz"), "the fields of a motion")
    arrays = {**values, "positions": positions}
    require_shapes(frames, arrays, {"positions": (2, len(nodes), 3),
                                    "principal_strain": (2, len(nodes))}, "the frames of a load")
    strain = 100 * arrays["principal_strain"][1][corners].mean(axis=1)
    shades = plt.get_cmap("inferno")
    largest = max(float(strain.max()), 1e-9)
    norm = plt.Normalize(0.0, largest)
    figure, views = two_views(positions.reshape(-1, 3))
    grey = np.tile((0.8, 0.8, 0.8, 1.0), (len(corners), 1))
    for axis, across, depth in views:
        for state, colours in zip(positions, (grey, shades(0.9 * norm(strain))), strict=True):
            draw_faces(axis, state[corners], colours, across, depth)
    scale = plt.cm.ScalarMappable(plt.Normalize(0.0, largest / 0.9), shades)
    bar = figure.colorbar(scale, ax=figure.axes, label="largest principal strain [%]", shrink=0.7)
    bar.ax.set_ylim(0.0, largest)
    return figure


def strain_along_path(along: np.ndarray) -> "Figure":
    """Draw the largest strain of each piece of the main path: its ends from the root [m] and the
    largest principal strain, [n, 3]."""
    from matplotlib.figure import Figure

    from_m, to_m, strain = along.T
    figure = Figure(figsize=(6.0, 3.2), layout="constrained")
    axes = figure.add_subplot()
    axes.bar(from_m, 100 * strain, to_m - from_m, align="edge", edgecolor="white")
    axes.set(xlabel="distance from the root along the main path [m]", ylabel="largest strain [%]")
    axes.spines[["top", "right"]].set_visible(False)
    return figure


# The figure of a free swing that was fitted.

def along_path(seen: np.ndarray, simulated: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the displacement [m] along its path of the marker with the largest swing, observed
    (NaN if not) and simulated, shape [n] each, from those of all markers, [n, markers, 3]."""
    most = int(np.argmax(np.ptp(simulated, axis=0).max(axis=1)))
    direction = np.linalg.svd(simulated[:, most] - simulated[:, most].mean(axis=0))[2][0]
    return seen[:, most] @ direction, simulated[:, most] @ direction


def swing_over_time(times: np.ndarray, seen: np.ndarray, simulated: np.ndarray) -> "Figure":
    """Draw observed and simulated displacement of the marker with the largest swing."""
    from limber.results.report.estimate_figures import OBSERVED, SIMULATED

    figure, axes = chart(5.2, 3.0, "time [s]", "displacement [mm]")
    seen, simulated = along_path(seen, simulated)
    axes.plot(times, 1e3 * seen, ".", ms=4, color=OBSERVED, label="observed")
    axes.plot(times, 1e3 * simulated, color=SIMULATED, label="simulated")
    axes.legend(frameon=False)
    return figure


# The figure of an execution by a robot: the measured force against the predicted one.

_MOST_POINTS = 1500
_GAP_SECONDS = 0.5
_NAMES = [*(f"{kind}_f{axis}_n" for kind in ("smooth", "expected") for axis in "xyz"),
          *(f"expected_{entry}_n2" for entry in ("xx", "yy", "zz"))]


def force_along_path(path: Path) -> "Figure":
    """Draw the measured force (smoothed), and the predicted one with its 95 % interval; InputError
    if the log is damaged, or predicts no force."""
    from matplotlib.figure import Figure

    log = read_stream(path)
    missing = [name for name in _NAMES if name not in log.columns]
    if missing:
        raise InputError(f"{path} has no column {missing[0]}.",
                         "It is not the log of an execution.",
                         "Execute the plan again.")
    table = log.values[:, [log.columns.index(name) for name in _NAMES]]
    known = np.isfinite(table).all(axis=1)
    if not known.any():
        raise InputError(f"{path} has no predicted force.",
                         "The execution did not predict the force on the branch.",
                         "Execute the plan again.")
    known = np.flatnonzero(known)
    known = known[::max(1, len(known) // _MOST_POINTS)]
    times, table = log.times[known] - log.times[known[0]], table[known]
    # The line is interrupted where no force was predicted.
    after = np.flatnonzero(np.diff(times) > _GAP_SECONDS) + 1
    times, table = np.insert(times, after, np.nan), np.insert(table, after, np.nan, axis=0)
    felt, expected, variances = table[:, :3], table[:, 3:6], table[:, 6:]
    figure = Figure(figsize=(9.0, 5.2), layout="constrained")
    for axes, column, name in zip(figure.subplots(3, 1, sharex=True), range(3), "xyz", strict=True):
        half = 1.96 * np.sqrt(np.maximum(variances[:, column], 0.0))
        axes.fill_between(times, expected[:, column] - half, expected[:, column] + half,
                          color=SIMULATED, alpha=0.2, lw=0)
        axes.plot(times, expected[:, column], color=SIMULATED, label="predicted, 95 % interval")
        axes.plot(times, felt[:, column], ".", ms=2, color=OBSERVED, label="measured")
        axes.set_ylabel(f"force {name} [N]")
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.25)
        if name == "x":
            axes.legend(frameon=False, ncols=2)
    axes.set_xlabel("time since the robot started [s]")
    return figure
